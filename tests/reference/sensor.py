"""Observation models beam by beam, with Python's own floats."""

from __future__ import annotations

import math

import numpy as np


def gauss(d: float, sigma: float) -> float:
    """Normal density at ``d``."""
    return math.exp(-(d * d) / (2 * sigma * sigma)) / (sigma * math.sqrt(2 * math.pi))


def score(observed: list[float], expected: list[float], alpha: float, beta: float, sigma: float, top: float) -> float:
    """Eq 15; NaN and -inf readings do not count, no return on both sides is no difference."""
    total = 0.0
    for o, p in zip(observed, expected, strict=True):
        if math.isnan(o) or o == -math.inf:
            continue
        if o == math.inf and p == math.inf:
            hit = gauss(0.0, sigma)
        elif o == math.inf or p == math.inf:
            hit = 0.0
        else:
            hit = gauss(o - p, sigma)
        total += (alpha * hit + beta / top) ** 3
    return total


def beam_log(
    o: float, p: float, z_hit: float, z_short: float, z_max: float, z_rand: float, sigma: float, top: float
) -> float:
    """Log-likelihood of one reading ``o`` where the map says ``p``."""
    if math.isnan(o) or o == -math.inf:
        return 0.0
    if o == math.inf:
        return math.log(z_max + z_rand / top + (z_hit if p == math.inf else 0.0))
    reach = min(p, top)
    value = z_rand / top
    if p != math.inf:
        value += z_hit * gauss(o - p, sigma)
    if o < reach:
        value += z_short / max(reach, sigma)
    return math.log(value)


def field_log(
    occupied: np.ndarray,
    resolution: float,
    ends: list[tuple[float, float]],
    z_hit: float,
    z_rand: float,
    sigma: float,
    cut: float,
    top: float,
) -> float:
    """Sum of log-likelihoods of end points (x, y), grid frame, metres: distances of cell centres, bilinear between."""
    total = 0.0
    for x, y in ends:
        nearest = between(occupied, x / resolution - 0.5, y / resolution - 0.5, cut / resolution) * resolution
        total += math.log(z_hit * gauss(nearest, sigma) + z_rand / top)
    return total


def between(occupied: np.ndarray, j: float, i: float, cut: float) -> float:
    """Cells to the nearest occupied one, interpolated between the four centres around (i, j); edges extended."""
    i, j = min(max(i, 0.0), occupied.shape[0] - 1), min(max(j, 0.0), occupied.shape[1] - 1)
    total = 0.0
    for row, down in ((math.floor(i), 1 - i % 1), (math.floor(i) + 1, i % 1)):
        for column, along in ((math.floor(j), 1 - j % 1), (math.floor(j) + 1, j % 1)):
            walls = zip(*np.nonzero(occupied), strict=True)
            total += down * along * min(cut, min(math.hypot(r - row, c - column) for r, c in walls))
    return total
