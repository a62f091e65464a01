"""Portable graymaps P2 and P5, 8 and 16 bit. OpenCV ignores the maximum value of P5 headers, map_server does not."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from dsom_jax.errors import UserError

HEADER = re.compile(rb"(P[25])" + rb"(?:\s|#[^\n]*\n)+(\d+)" * 3 + rb"(?:#[^\n]*)?\s")
"""Magic number, width, height, maximum value; comments between them; one white space before the pixels."""


def decode_pgm(content: bytes, path: Path) -> np.ndarray:
    """Brightness (H, W) in [0, 1], first row at the top."""
    header = HEADER.match(content)
    width, height, maximum = (int(v) for v in header.groups()[1:]) if header else (0, 0, 0)
    if not header or width < 1 or height < 1 or not 1 <= maximum < 65536:
        raise UserError(f"{path}: broken pgm header; it must say P2 or P5, width, height and maximum value")
    pixels = _pixels(header.group(1), content[header.end() :], width * height, maximum)
    if pixels is None:
        raise UserError(f"{path}: holds fewer than {width} x {height} pixels; the file is cut off, export it again")
    return np.minimum(pixels.reshape(height, width) / maximum, 1.0)


def _pixels(magic: bytes, body: bytes, count: int, maximum: int) -> np.ndarray | None:
    """Flat pixel values, None if there are fewer than ``count``."""
    if magic == b"P5":
        # 16-bit samples are big-endian.
        kind = np.dtype(">u2" if maximum > 255 else "u1")
        return np.frombuffer(body, kind, count).astype(float) if len(body) >= count * kind.itemsize else None
    try:
        values = np.array(re.sub(rb"#[^\n]*", b"", body).split()[:count], float)
    except ValueError:
        return None
    return values if len(values) == count else None


def encode_pgm(pixels: np.ndarray) -> bytes:
    """P5 file of pixels (H, W) uint8, first row at the top."""
    return b"P5\n%d %d\n255\n" % (pixels.shape[1], pixels.shape[0]) + np.ascontiguousarray(pixels, np.uint8).tobytes()
