"""Section III-B of the paper written as loops."""

from __future__ import annotations

import math

import numpy as np


def ground_truth(
    pose: tuple[float, float, float], shape: tuple[int, int], headings: int, resolution: float
) -> np.ndarray:
    """GT (H, W, K): a 7 x 7 Gaussian of 3 cells around the pose's cell, shared by the two nearest orientations."""
    x, y, theta = pose
    row, column = int(y // resolution), int(x // resolution)
    plane = np.zeros(shape)
    for i in range(max(0, row - 3), min(shape[0], row + 4)):
        for j in range(max(0, column - 3), min(shape[1], column + 4)):
            plane[i, j] = math.exp(-((i - row) ** 2 + (j - column) ** 2) / (2 * 3.0**2))
    step = 2 * math.pi / headings
    place = (theta + math.pi) / step
    low = math.floor(place)
    turn = np.zeros(headings)
    turn[low % headings] += 1 - (place - low)
    turn[(low + 1) % headings] += place - low
    truth = plane[..., None] * turn
    return truth / truth.sum()
