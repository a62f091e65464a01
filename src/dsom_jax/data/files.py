"""The one reader of files: regular ones only, no more of them than their kind needs, and every refusal in one line."""

from __future__ import annotations

import bz2
import errno
import io
import logging
import math
import os
import stat
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from gzip import GzipFile
from pathlib import Path

import numpy as np

from dsom_jax.errors import UserError

MB = 1_000_000
LINE, LINES, PACKED = MB, 10_000_000, 200
"""Most bytes of a line of text, most lines, and most bytes that a byte of a packed text may stand for."""
POINTERS = {
    b"version https://git-lfs.github.com/spec/": ("a git-LFS pointer", "run `git lfs pull` where it comes from"),
    b"/annex/objects/": ("a git-annex pointer", "run `git annex get` where it comes from"),
    b"<!DOCTYPE html": ("a web page", "download the file itself (its raw form)"),
}
"""What stands in a file in place of the file."""


def read_bytes(path: str | Path, what: str, most: int = 256 * MB) -> bytes:
    """Content of a regular file of at most ``most`` bytes; ``what`` names its role in the error."""
    try:
        # A pipe without a writer would be waited for.
        handle = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    except (OSError, ValueError) as error:
        raise _unreadable(path, what, error) from None
    try:
        if not stat.S_ISREG(mode := os.fstat(handle).st_mode):
            kind = "a directory" if stat.S_ISDIR(mode) else "a device or a pipe"
            raise UserError(f"{path}: is {kind}, not a {what}; give the file itself")
        with open(handle, "rb", closefd=False) as file:
            content = file.read(most + 1)  # not by its stated size: files of /proc state none
    except OSError as error:
        raise _unreadable(path, what, error) from None
    finally:
        os.close(handle)
    if len(content) > most:
        raise UserError(f"{path}: is larger than {most / MB:g} MB, the limit for a {what}; check that it is one")
    for magic, (kind, fix) in POINTERS.items():
        if content.startswith(magic):
            raise UserError(f"{path}: is {kind}, not the {what} itself; {fix}")
    return content


def check_file(path: str | Path, what: str) -> None:
    """UserError unless ``path`` is a regular file that can be read and no pointer to one: for libraries that open it
    themselves."""
    try:
        mode = os.stat(path).st_mode
    except (OSError, ValueError) as error:
        raise _unreadable(path, what, error) from None
    if stat.S_ISDIR(mode) or not stat.S_ISREG(mode) or os.stat(path).st_size < 1000:
        read_bytes(path, what)
    elif not os.access(path, os.R_OK):
        raise _unreadable(path, what, PermissionError(errno.EACCES, os.strerror(errno.EACCES)))


def check_path(path: str | Path, what: str) -> None:
    """UserError for a name that no file can have, and for a file in a folder that may not be entered; one that is not
    there passes, whoever opens it will say so."""
    try:
        mode = os.stat(path).st_mode
    except (FileNotFoundError, NotADirectoryError):
        return
    except (OSError, ValueError) as error:
        raise _unreadable(path, what, error) from None
    if stat.S_ISDIR(mode) and not os.access(path, os.R_OK | os.X_OK):
        raise _unreadable(path, what, PermissionError(errno.EACCES, os.strerror(errno.EACCES)))


def _unreadable(path: str | Path, what: str, error: OSError | ValueError) -> UserError:
    """Why a path cannot be opened; ValueErrors are those of names that hold a NUL."""
    number = error.errno if isinstance(error, OSError) else None
    if number in (errno.ENOENT, errno.ENOTDIR):
        return UserError(f"{path}: no such {what}; check the path")
    if number is None or number == errno.ENAMETOOLONG:
        name = f"{'...' * (len(str(path)) > 60)}{str(path)[-60:]}"
        return UserError(f"{name}: no file has such a name ({len(str(path))} characters); check the path of the {what}")
    return UserError(f"{path}: cannot read the {what} ({os.strerror(number)}); check its permissions")


def read_text(path: str | Path, what: str, most: int = 64 * MB) -> str:
    """Text of a file in UTF-8."""
    try:
        return read_bytes(path, what, most).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise UserError(f"{path}: not text in UTF-8 (byte {error.start}); save the {what} as UTF-8") from None


def read_lines(path: str | Path, what: str, most: int = 512 * MB) -> list[str]:
    """Text lines of a file, plain or packed by gzip or bzip2; bytes that are no text are replaced."""
    content = read_bytes(path, what, most)
    kind, stream = _unpacked(content)
    lines: list[str] = []
    size = 0
    try:
        while line := stream.readline(LINE + 1):
            size += len(line)
            if len(line) > LINE or len(lines) >= LINES:
                raise UserError(
                    f"{path}: line {len(lines) + 1} is one too many or too long for a {what}, check the file"
                )
            if size > most or (kind and size > MB and size > PACKED * len(content)):
                raise UserError(f"{path}: unpacks to more than a {what} holds (limit: {most / MB:g} MB); unpack it")
            # Only these end a line here; str.splitlines knows seven more.
            lines.append(line.decode(errors="replace").rstrip("\r\n"))
    except (OSError, EOFError, ValueError, zlib.error):
        raise UserError(f"{path}: broken {kind} file; copy or download it again") from None
    return lines


def _unpacked(content: bytes) -> tuple[str, io.BufferedIOBase | io.BytesIO]:
    """Kind of packing, empty for none, and the text as a stream that unpacks no more than is read."""
    if content.startswith(b"\x1f\x8b"):
        return "gzip", io.BufferedReader(GzipFile(fileobj=io.BytesIO(content)))
    if content.startswith(b"BZh"):
        return "bzip2", bz2.BZ2File(io.BytesIO(content))
    return "", io.BytesIO(content)


def read_arrays(source: str | Path | bytes, what: str, most: int = 512 * MB) -> dict[str, np.ndarray]:
    """Arrays of an npz file (or of its content) that unpack to at most ``most`` bytes; none of them holds objects."""
    name, kind = (what, "readable") if isinstance(source, bytes) else (f"{source}", f"a {what}")
    content = source if isinstance(source, bytes) else read_bytes(source, what)
    try:
        unpacked = sum(entry.file_size for entry in zipfile.ZipFile(io.BytesIO(content)).infolist())
        if unpacked > most:
            raise UserError(f"{name}: unpacks to {unpacked / MB:.0f} MB, the limit is {most / MB:g} MB")
        with np.load(io.BytesIO(content), allow_pickle=False) as stored:
            return {key: stored[key] for key in stored.files}
    except UserError:
        raise
    except Exception as error:
        # zipfile, zlib and numpy raise a dozen unrelated kinds for damaged files.
        raise UserError(f"{name}: not {kind} ({error}); it is damaged, make it again") from None


@contextmanager
def hushed(*names: str) -> Iterator[None]:
    """Keep what the named loggers have to say off the screen: what matters of it is raised as well."""
    before = {name: logging.getLogger(name).level for name in names}
    for name in names:
        logging.getLogger(name).setLevel(logging.CRITICAL + 1)
    try:
        yield
    finally:
        for name, level in before.items():
            logging.getLogger(name).setLevel(level)


FAR = 1e5
"""Metres from the origin of the map frame where float32 still tells poses a centimetre apart."""
CELLS = 100_000_000
"""Most cells of a map: 500 m x 500 m at 0.05 m."""


def check_near(path: str | Path, position: tuple[float, float], fix: str) -> None:
    """UserError for a map that lies so far from the origin of its frame that single precision would blur poses."""
    if not max(map(abs, position)) <= FAR:
        place = ", ".join(f"{v:.0f}" if math.isfinite(v) and abs(v) < 1e9 else f"{v:.3g}" for v in position)
        raise UserError(f"{path}: lies at ({place}) m in the map frame, too far for single precision; {fix}")
