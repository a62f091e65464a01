"""How far the robot turned between two scans, from the scans alone: what clocks and angles are checked by."""

from __future__ import annotations

import math

import numpy as np

FASTEST = 4.0
"""rad/s that a robot is taken to turn at most."""
WIDEST = math.pi / 3
"""Radians between two scans that are searched at most."""
BEAMS = 360
"""Scans are thinned to about so many beams."""
_MOST = 4000
"""Pairs of scans that are compared; of longer logs those in the middle."""


def turns(ranges: np.ndarray, stamps: np.ndarray, increment: float, range_max: float) -> np.ndarray:
    """(N - 1,) radians turned counter-clockwise between consecutive scans (N, B); NaN where they do not tell.

    The shift of the beams at which the two scans differ least, in the logarithm of the ranges and cut off, so that
    neither far walls nor what has moved counts for much; between shifts a parabola tells. The driven way averages out
    over the directions. Scans that cover a whole turn are shifted in a circle.
    """
    step = max(1, ranges.shape[1] // BEAMS)
    profile = np.log(np.clip(np.nan_to_num(ranges[:, ::step], nan=-1.0, posinf=range_max), -1.0, range_max).clip(0.02))
    known = ~np.isnan(ranges[:, ::step]) & (ranges[:, ::step] > 0)
    bin, beams = increment * step, profile.shape[1]
    circle = abs(ranges.shape[1] * increment) > 2 * math.pi - 1.5 * abs(increment)
    gap = float(np.median(np.diff(stamps))) if len(stamps) > 1 else 0.1
    reach = int(min(max(FASTEST * abs(gap), 0.1), WIDEST) / abs(bin)) + 1
    reach = min(reach, beams // 3)
    if reach < 1 or len(ranges) < 2:
        return np.full(max(len(ranges) - 1, 0), np.nan)
    costs = np.stack([_difference(profile, known, shift, circle) for shift in range(-reach, reach + 1)])
    best = np.clip(costs.argmin(axis=0), 1, 2 * reach - 1)
    pair = np.arange(costs.shape[1])
    low, middle, high = (costs[best + k, pair] for k in (-1, 0, 1))
    bend = low - 2 * middle + high
    with np.errstate(invalid="ignore", divide="ignore"):
        part = np.clip(np.where(bend > 0, 0.5 * (low - high) / bend, 0.0), -1, 1)
    # Scans without features differ equally at every shift.
    told = np.isfinite(costs).all(axis=0) & (middle < 0.7 * np.median(costs, axis=0))
    return np.where(told, -(best - reach + part) * bin, np.nan)


def _difference(profile: np.ndarray, known: np.ndarray, shift: int, circle: bool) -> np.ndarray:
    """(N - 1,) mean difference of each scan and the next one, whose beams are moved by ``shift``."""
    later, seen = np.roll(profile[1:], -shift, axis=1), np.roll(known[1:], -shift, axis=1)
    if not circle:
        seen = seen.copy()
        seen[:, seen.shape[1] - shift if shift > 0 else 0 : None if shift > 0 else -shift] = False
    both = seen & known[:-1]
    apart = np.minimum(np.abs(later - profile[:-1]), 0.3)
    with np.errstate(invalid="ignore", divide="ignore"):
        share = np.where(both, apart, 0.0).sum(axis=1) / both.sum(axis=1)
    return np.where(both.sum(axis=1) >= 0.3 * profile.shape[1], share, np.nan)


def middle_of(count: int) -> slice:
    """The scans of a log of ``count`` that are compared."""
    start = max(0, (count - _MOST) // 2)
    return slice(start, start + _MOST)
