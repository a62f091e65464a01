"""Grid localization's motion update, cell by cell: each hands its belief to the new cells around its target."""

from __future__ import annotations

import itertools
import math

import numpy as np


def hat(distance: float) -> float:
    """Quadratic B-spline."""
    distance = abs(distance)
    if distance <= 0.5:
        return 0.75 - distance**2
    return 0.5 * (1.5 - distance) ** 2 if distance <= 1.5 else 0.0


def predict(belief, free, odometry, resolution, slip):
    """Belief (H, W, K), zero off ``free`` (H, W), after a body-frame increment; none enters cells that are not free."""
    height, width, headings = belief.shape
    turn = 2 * math.pi / headings
    new = np.zeros_like(belief)
    moves = [(1 - slip, 1.0), (slip / 2, -1.0)]
    for i, j, k in itertools.product(*map(range, belief.shape)):
        theta = -math.pi + k * turn
        x = math.cos(theta) * odometry[0] - math.sin(theta) * odometry[1]
        y = math.sin(theta) * odometry[0] + math.cos(theta) * odometry[1]
        landed = np.zeros((height, width))
        for share, factor in moves:
            to_i, to_j = i + factor * y / resolution, j + factor * x / resolution
            for a, b in itertools.product(range(height), range(width)):
                landed[a, b] += share * hat(a - to_i) * hat(b - to_j)
        landed[i, j] += slip / 2
        to_k = k + odometry[2] / turn
        for c in range(headings):
            off = (c - to_k + headings / 2) % headings - headings / 2
            new[:, :, c] += belief[i, j, k] * landed * hat(off)
    return new * free[..., None]
