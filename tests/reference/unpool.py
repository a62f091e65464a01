"""Slow, obvious versions of 2 x 2 max pooling with indices and of its inverse."""

from __future__ import annotations

import numpy as np


def max_pool(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Maxima (H/2, W/2, C) of x (H, W, C) and their place 2 * row + column; ties go to the first."""
    h, w, c = x.shape[0] // 2, x.shape[1] // 2, x.shape[2]
    pooled, index = np.zeros((h, w, c), x.dtype), np.zeros((h, w, c), np.int8)
    for i in range(h):
        for j in range(w):
            for n in range(c):
                window = x[2 * i : 2 * i + 2, 2 * j : 2 * j + 2, n].ravel()
                index[i, j, n] = np.argmax(window)
                pooled[i, j, n] = window[index[i, j, n]]
    return pooled, index


def max_unpool(x: np.ndarray, index: np.ndarray) -> np.ndarray:
    """Entries of x (h, w, C) at the places that ``index`` names, zero elsewhere: (2h, 2w, C)."""
    h, w, c = x.shape
    out = np.zeros((2 * h, 2 * w, c), x.dtype)
    for i in range(h):
        for j in range(w):
            for n in range(c):
                row, column = divmod(int(index[i, j, n]), 2)
                out[2 * i + row, 2 * j + column, n] = x[i, j, n]
    return out
