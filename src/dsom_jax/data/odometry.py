"""Odometry at the stamps of the scans."""

from __future__ import annotations

import numpy as np

from dsom_jax.data import se2
from dsom_jax.data.log import Report

MAX_GAP = 1.0
"""Seconds without odometry that are not bridged by interpolation."""
MAX_OVERHANG = 0.2
"""Seconds before the first or after the last odometry for which that one is used."""


def odometry_at(rows: np.ndarray, stamps: np.ndarray, report: Report) -> np.ndarray:
    """Poses (N, 3) at ``stamps`` (N,) from rows (M, 4) = (stamp, x, y, theta); NaN outside of them and in long gaps."""
    sound = np.isfinite(rows).all(-1)
    if not sound.all():
        report.add("odometry messages that are not finite dropped", count=int((~sound).sum()))
        rows = rows[sound]
    if not len(rows):
        return np.full((len(stamps), 3), np.nan)
    times, first = np.unique(rows[:, 0], return_index=True)
    poses = se2.interpolate(times, rows[first, 1:], stamps)
    after = np.clip(np.searchsorted(times, stamps), 1, max(len(times) - 1, 1))
    gaps = np.diff(times, append=times[-1])[after - 1]
    inside = (stamps >= times[0]) & (stamps <= times[-1])
    near = (stamps >= times[0] - MAX_OVERHANG) & (stamps <= times[-1] + MAX_OVERHANG)
    known = np.where(inside, gaps <= MAX_GAP, near)
    if not known.all():
        spans = [f"{s.min():.3f} to {s.max():.3f} s" for s in (times, stamps)]
        covered = f"odometry from {spans[0]}, scans from {spans[1]}"
        report.add("scans without odometry near their stamp", covered, int((~known).sum()))
    return np.where(known[:, None], poses, np.nan)
