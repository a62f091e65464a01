"""Reading whole files, with clear errors."""

from __future__ import annotations

import bz2
import gzip
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from dsom_jax.errors import UserError


def read_bytes(path: str | Path, what: str) -> bytes:
    """Content of a file; ``what`` names its role in the error."""
    try:
        return Path(path).read_bytes()
    except FileNotFoundError:
        raise UserError(f"{path}: no such {what}; check the path") from None
    except IsADirectoryError:
        raise UserError(f"{path}: is a directory, not a {what}; give the file itself") from None
    except OSError as error:
        raise UserError(f"{path}: cannot read the {what} ({error.strerror}); check its permissions") from None


def read_lines(path: str | Path, what: str) -> list[str]:
    """Text lines of a file, plain or packed by gzip or bzip2; bytes that are no text are replaced."""
    content = read_bytes(path, what)
    for magic, kind, unpack in ((b"\x1f\x8b", "gzip", gzip.decompress), (b"BZh", "bzip2", bz2.decompress)):
        if content.startswith(magic):
            try:
                content = unpack(content)
            except (OSError, EOFError, ValueError, zlib.error):
                raise UserError(f"{path}: broken {kind} file; copy or download it again") from None
    return content.decode(errors="replace").splitlines()


def read_yaml(path: str | Path, what: str) -> dict[str, Any]:
    """Mapping stored in a YAML file."""
    try:
        document = yaml.safe_load(read_bytes(path, what))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        mark = getattr(error, "problem_mark", None)
        where = f" at line {mark.line + 1}" if mark else ""
        raise UserError(f"{path}: not valid YAML{where}; the {what} must be a list of 'field: value' lines") from None
    if not isinstance(document, Mapping):
        raise UserError(f"{path}: holds no fields; the {what} must be a list of 'field: value' lines")
    return {str(key): value for key, value in document.items()}


FAR = 1e5
"""Metres from the origin of the map frame where float32 still tells poses a centimetre apart."""


def check_near(path: str | Path, position: tuple[float, float], fix: str) -> None:
    """UserError for a map that lies so far from the origin of its frame that single precision would blur poses."""
    if max(map(abs, position)) > FAR:
        x, y = position
        raise UserError(f"{path}: lies at ({x:.0f}, {y:.0f}) m in the map frame, too far for single precision; {fix}")
