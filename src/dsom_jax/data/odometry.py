"""Odometry at the stamps of the scans, whatever gave it: a topic, /tf, a file. Jumps and resets are taken out of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dsom_jax.data import se2
from dsom_jax.data.log import Report

_MAX_GAP = 1.0
"""Seconds without odometry that are not bridged by interpolation."""
MAX_OVERHANG = 0.2
"""Seconds before the first or after the last odometry for which that one is used."""
_FAR = 1e7
"""Metres beyond which a position is none."""
SLACK, FAST = (0.1, 0.2), (2.0, 3.0)
"""A step of more than SLACK + 3 x what is usual in this odometry (at least FAST) per second is no motion: m, rad."""


@dataclass(frozen=True)
class Odometry:
    """Poses of the base in a frame that drifts.

    Attributes:
        rows: (M, 4) float64 (stamp, x, y, theta), by stamp, each stamp once, all finite.
        breaks: (K,) stamps of the rows before which the odometry had jumped; the motion there is zero.
    """

    rows: np.ndarray
    breaks: np.ndarray

    def at(self, stamps: np.ndarray) -> np.ndarray:
        """Poses (N, 3) at ``stamps`` (N,); NaN outside of the rows and in long gaps."""
        if not len(self.rows):
            return np.full((len(stamps), 3), np.nan)
        times = self.rows[:, 0]
        poses = se2.interpolate(times, self.rows[:, 1:], stamps)
        after = np.clip(np.searchsorted(times, stamps), 1, max(len(times) - 1, 1))
        gaps = np.diff(times, append=times[-1])[after - 1]
        inside = (stamps >= times[0]) & (stamps <= times[-1])
        near = (stamps >= times[0] - MAX_OVERHANG) & (stamps <= times[-1] + MAX_OVERHANG)
        return np.where(np.where(inside, gaps <= _MAX_GAP, near)[:, None], poses, np.nan)

    def broken(self, stamps: np.ndarray) -> np.ndarray:
        """(N,) bool: scans between which and the scan before them, by stamp, the odometry jumped."""
        order = np.argsort(stamps, kind="stable")
        marked = np.zeros(len(stamps), bool)
        after = np.searchsorted(stamps[order], self.breaks)
        marked[order[after[(after > 0) & (after < len(stamps))]]] = True
        return marked


def mended(rows: np.ndarray, report: Report) -> Odometry:
    """Rows (M, 4) = (stamp, x, y, theta) without what is no number, and without jumps, which are reported.

    A single row beside the way is dropped; where the poses go on elsewhere, as after a reset, they are carried over so
    that the motion across the jump is zero.
    """
    sound = np.isfinite(rows).all(-1) & (np.abs(rows[:, 1:3]) < _FAR).all(-1)
    if not sound.all():
        report.add("odometry messages that are not finite dropped", count=int((~sound).sum()))
    rows = rows[sound]
    rows = rows[np.unique(rows[:, 0], return_index=True)[1]]
    if len(rows) < 3:
        return Odometry(rows, np.zeros(0))
    limit = _limits(rows)
    strays = _strays(rows, limit)
    if strays.any():
        report.add("odometry messages far from their neighbours dropped", _where(rows[strays][0]), int(strays.sum()))
        rows = rows[~strays]
    jumps = np.flatnonzero(_beyond(rows[:-1], rows[1:], limit, _period(rows))) + 1
    for k in jumps:
        report.add("jumps or resets of the odometry taken as no motion", _where(rows[k]))
    return Odometry(_joined(rows, jumps), rows[jumps, 0])


def _where(row: np.ndarray) -> str:
    """Time and place for a note."""
    return f"at {row[0]:.3f} s to ({row[1]:.2f}, {row[2]:.2f}) m"


def _limits(rows: np.ndarray) -> np.ndarray:
    """(2,) m/s and rad/s that are more than three times what this odometry does when it moves."""
    steps = _steps(rows[:-1], rows[1:]) / np.maximum(np.diff(rows[:, 0]), _period(rows))[:, None]
    usual = [np.quantile(s[s > 1e-3], 0.9) if (s > 1e-3).any() else 0.0 for s in steps.T]
    return np.maximum(3 * np.array(usual), FAST)


def _period(rows: np.ndarray) -> float:
    """Seconds between two rows, usually. Stamps jitter, so that less between two of them means nothing."""
    return float(np.median(np.diff(rows[:, 0])))


def _steps(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(M, 2) metres and radians between rows."""
    return np.stack([np.hypot(*(b[:, 1:3] - a[:, 1:3]).T), np.abs(se2.wrap(b[:, 3] - a[:, 3]))], axis=-1)


def _beyond(a: np.ndarray, b: np.ndarray, limit: np.ndarray, period: float) -> np.ndarray:
    """(M,) bool: what lies between rows is more than motion."""
    return (_steps(a, b) > np.array(SLACK) + limit * np.maximum(b[:, :1] - a[:, :1], period)).any(-1)


def _strays(rows: np.ndarray, limit: np.ndarray) -> np.ndarray:
    """(M,) bool: rows beside the way between the row before and the row after."""
    strays = np.zeros(len(rows), bool)
    before, row, after = rows[:-2], rows[1:-1], rows[2:]
    out, back, past = (_beyond(a, b, limit, _period(rows)) for a, b in ((before, row), (row, after), (before, after)))
    strays[1:-1] = out & back & ~past
    return strays


def _joined(rows: np.ndarray, jumps: np.ndarray) -> np.ndarray:
    """Rows whose parts between ``jumps`` are moved rigidly, each onto the end of the part before."""
    if not len(jumps):
        return rows
    parts = [part[:, 1:] for part in np.split(rows, jumps)]
    joined = parts[:1]
    for part in parts[1:]:
        joined.append(se2.compose(joined[-1][-1], se2.relative(part[0], part)))
    return np.column_stack([rows[:, 0], np.concatenate(joined)])


def odometry_at(rows: np.ndarray, stamps: np.ndarray, report: Report) -> tuple[np.ndarray, np.ndarray]:
    """Poses (N, 3) at ``stamps`` (N,) from rows (M, 4) as they were recorded, NaN where they do not tell; and where
    they jumped (N,), as :meth:`Odometry.broken` says."""
    odometry = mended(rows, report)
    poses = odometry.at(stamps)
    report_uncovered(odometry, stamps, poses, report)
    return poses, odometry.broken(stamps)


def report_uncovered(odometry: Odometry, stamps: np.ndarray, poses: np.ndarray, report: Report) -> None:
    """Note scans without odometry."""
    missing = np.isnan(poses).any(-1)
    if missing.any() and len(odometry.rows):
        spans = [f"{s.min():.3f} to {s.max():.3f} s" for s in (odometry.rows[:, 0], stamps)]
        covered = f"odometry from {spans[0]}, scans from {spans[1]}"
        report.add("scans without odometry near their stamp", covered, int(missing.sum()))
