"""Keep the memory of one step for the next."""

from __future__ import annotations

import ctypes
import sys

_MMAP_MAX, _TRIM_THRESHOLD = -4, -1


def keep_freed_memory() -> bool:
    """Tell glibc to hold on to freed memory; True if it agreed. Costs nothing elsewhere.

    A training step needs gigabytes of scratch memory. glibc maps such blocks afresh at every step, and zeroing their
    pages takes as long as the arithmetic: with this an elementwise operation on 32 MB takes 3 ms in place of 30.
    """
    if not sys.platform.startswith("linux"):
        return False
    try:
        mallopt = ctypes.CDLL("libc.so.6").mallopt
    except (OSError, AttributeError):
        return False
    return bool(mallopt(_MMAP_MAX, 0) and mallopt(_TRIM_THRESHOLD, 2**31 - 1))
