"""Slow ray caster: every ray against every occupied cell as a box, in float64."""

from __future__ import annotations

import numpy as np


def cast(occupied: np.ndarray, x: float, y: float, angle: float) -> tuple[float, float]:
    """Distance in cells from (x, y) to the first occupied cell along ``angle``, inf for none, and the clearance.

    The clearance is the least distance between the ray, up to its end, and a corner of an occupied cell: within
    rounding of a corner nobody can say on which side a ray passes. Outside of the map nothing is seen.
    """
    height, width = occupied.shape
    if not (0 <= x < width and 0 <= y < height) or not np.isfinite(angle):
        return np.inf, np.inf
    i, j = np.nonzero(occupied)
    d = np.array([np.cos(angle), np.sin(angle)])
    low, high = np.stack([j - x, i - y], -1), np.stack([j + 1 - x, i + 1 - y], -1)
    with np.errstate(divide="ignore", invalid="ignore"):
        near, far = np.minimum(low / d, high / d), np.maximum(low / d, high / d)
    inside = (low <= 0) & (high >= 0)  # a ray parallel to an axis is within the slab for ever, or never
    near = np.where(d == 0, np.where(inside, -np.inf, np.inf), near).max(-1)
    far = np.where(d == 0, np.where(inside, np.inf, -np.inf), far).min(-1)
    hits = np.maximum(near, 0.0)[(near < far) & (far > 0)]
    reach = hits.min() if hits.size else np.inf
    return float(reach), _clearance(low, high, d, reach)


def _clearance(low: np.ndarray, high: np.ndarray, d: np.ndarray, reach: float) -> float:
    corners = np.concatenate([np.stack([a[:, 0], b[:, 1]], -1) for a in (low, high) for b in (low, high)])
    along, across = corners @ d, np.abs(corners @ np.array([-d[1], d[0]]))
    across = across[(along > -0.01) & (along < reach + 0.01)]
    return float(across.min()) if across.size else np.inf


def scan(
    occupied: np.ndarray, resolution: float, origin: tuple[float, float, float], sensor: np.ndarray, angles: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Ranges in metres and clearances in cells of beams ``angles`` from a sensor pose (3,) in the map frame."""
    c, s = np.cos(origin[2]), np.sin(origin[2])
    dx, dy = sensor[0] - origin[0], sensor[1] - origin[1]
    x, y = (c * dx + s * dy) / resolution, (c * dy - s * dx) / resolution
    results = [cast(occupied, x, y, sensor[2] - origin[2] + angle) for angle in angles]
    return np.array([r for r, _ in results]) * resolution, np.array([c for _, c in results])
