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
    """Sum of log-likelihoods of end points that lie exactly on cell centres (x, y), grid frame, metres."""
    total = 0.0
    for x, y in ends:
        nearest = cut
        for i, j in zip(*np.nonzero(occupied), strict=True):
            gap = math.hypot((j + 0.5) * resolution - x, (i + 0.5) * resolution - y)
            nearest = min(nearest, gap)
        total += math.log(z_hit * gauss(nearest, sigma) + z_rand / top)
    return total
