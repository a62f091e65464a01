"""Trajectories as TUM text: ``stamp x y z qx qy qz qw`` a line, seconds and metres; poses here are (x, y, yaw)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from dsom_jax.atomic import write_atomic
from dsom_jax.data import se2
from dsom_jax.data.files import FAR, MB, check_near, read_lines
from dsom_jax.data.log import RawLog, Report
from dsom_jax.errors import UserError


@dataclass(frozen=True)
class Trajectory:
    """Timed poses.

    Attributes:
        stamps: (N,) float64 seconds, ascending.
        poses: (N, 3) float64 (m, m, rad).
    """

    stamps: np.ndarray
    poses: np.ndarray


def yaw_of(quaternion: np.ndarray) -> np.ndarray:
    """Heading (...) of quaternions (..., 4) = (x, y, z, w), radians; roll and pitch do not matter."""
    quaternion = np.asarray(quaternion, float)
    # Written so that the quaternion need not be normalised, only small enough for its squares to be numbers.
    largest = np.abs(quaternion).max(-1, keepdims=True)
    x, y, z, w = np.moveaxis(quaternion / np.where((largest > 0) & np.isfinite(largest), largest, 1.0), -1, 0)
    return np.arctan2(2 * (w * z + x * y), w * w + x * x - y * y - z * z)


def load_tum(path: str | Path) -> Trajectory:
    """Trajectory of a TUM file; comments and empty lines are skipped, rows are sorted by stamp."""
    rows = []
    for number, line in enumerate(read_lines(path, "trajectory", 64 * MB), start=1):
        words = line.split("#")[0].replace(",", " ").split()
        if words:
            rows.append(_row(path, number, words))
    if not rows:
        raise UserError(f"{path}: holds no pose; each line must be 'stamp x y z qx qy qz qw'")
    table = np.array(rows)
    table = table[np.argsort(table[:, 0], kind="stable")]
    far = np.abs(table[:, 1:3]).max(axis=1) > FAR
    if far.any():
        x, y = table[far][0, 1:3].tolist()
        check_near(path, (x, y), "take the same offset from it and from the origin of the map")
    turns = table[:, 4:8] / np.abs(table[:, 4:8]).max(axis=1, keepdims=True)
    return Trajectory(table[:, 0], np.column_stack([table[:, 1:3], yaw_of(turns)]))


def _row(path: str | Path, number: int, words: list[str]) -> list[float]:
    """The eight numbers of a line."""
    try:
        row = [float(word) for word in words]
    except ValueError:
        row = []
    if len(row) != 8 or not np.isfinite(row).all() or not any(row[4:]):
        raise UserError(f"{path}: line {number}: must be 'stamp x y z qx qy qz qw' with a quaternion that is not zero")
    return row


def save_tum(path: str | Path, stamps: np.ndarray, poses: np.ndarray) -> None:
    """Write poses (N, 3) at ``stamps`` (N,) atomically; nanoseconds and micrometres are kept."""
    rows = (
        f"{t:.9f} {x:.6f} {y:.6f} 0 0 0 {np.sin(yaw / 2):.9f} {np.cos(yaw / 2):.9f}\n"
        for t, (x, y, yaw) in zip(np.asarray(stamps, float), np.asarray(poses, float), strict=True)
    )
    write_atomic(path, "".join(rows).encode())


def associate(trajectory: Trajectory, stamps: np.ndarray, tolerance: float = 0.01, max_gap: float = 1.0) -> np.ndarray:
    """Poses (M, 3) of a trajectory at ``stamps`` (M,), NaN where it does not tell.

    The pose of the nearest stamp within ``tolerance`` seconds; failing that, the interpolation between the neighbours
    if they are at most ``max_gap`` seconds apart.
    """
    stamps = np.asarray(stamps, float)
    after = np.clip(np.searchsorted(trajectory.stamps, stamps), 1, max(len(trajectory.stamps) - 1, 1))
    after = np.minimum(after, len(trajectory.stamps) - 1)
    before = np.maximum(after - 1, 0)
    near_before = np.abs(stamps - trajectory.stamps[before]) <= np.abs(trajectory.stamps[after] - stamps)
    nearest = np.where(near_before, before, after)
    close = np.abs(trajectory.stamps[nearest] - stamps) <= tolerance
    between = (trajectory.stamps[before] <= stamps) & (stamps <= trajectory.stamps[after])
    bridged = between & (trajectory.stamps[after] - trajectory.stamps[before] <= max_gap)
    poses = np.where(bridged[:, None], se2.interpolate(trajectory.stamps, trajectory.poses, stamps), np.nan)
    return np.where(close[:, None], trajectory.poses[nearest], poses)


def one_pose_a_stamp(trajectory: Trajectory, path: str | Path, report: Report) -> Trajectory:
    """The trajectory without stamps at which it is in several places (5 cm, 1 deg); UserError if there are many.

    That is what becomes of stamps that are printed with too few digits: one pose of many would be taken for all.
    """
    first = np.searchsorted(trajectory.stamps, trajectory.stamps)
    apart = np.abs(se2.relative(trajectory.poses[first], trajectory.poses))
    elsewhere = (apart > [0.05, 0.05, np.radians(1)]).any(-1)
    torn = np.isin(trajectory.stamps, trajectory.stamps[elsewhere])
    if torn.sum() > max(2, len(torn) // 20):
        raise UserError(
            f"{path}: {torn.sum()} of {len(torn)} poses share their stamp with a pose elsewhere (first at "
            f"{trajectory.stamps[torn][0]:.3f} s); write the stamps with all their digits, at least 3 after the point"
        )
    if torn.any():
        kind = "poses of the reference dropped that share their stamp with a pose elsewhere"
        report.add(kind, f"at {trajectory.stamps[torn][0]:.3f} s", int(torn.sum()))
    return Trajectory(trajectory.stamps[~torn], trajectory.poses[~torn])


def with_reference(log: RawLog, path: str | Path, tolerance: float = 0.01, max_gap: float = 1.0) -> RawLog:
    """The log with the reference trajectory of a TUM file; it is an error if no scan finds its pose."""
    trajectory = one_pose_a_stamp(load_tum(path), path, log.report)
    poses = associate(trajectory, log.stamps, tolerance, max_gap)
    missing = int(np.isnan(poses).any(-1).sum())
    if missing == len(log):
        raise UserError(
            f"{path}: no pose within {tolerance} s of any scan: it covers {trajectory.stamps[0]:.3f} to "
            f"{trajectory.stamps[-1]:.3f} s, {log.path} covers {log.stamps.min():.3f} to {log.stamps.max():.3f} s; "
            "both must use the same clock"
        )
    if missing:
        log.report.add("scans without a reference pose", count=missing)
    return replace(log, reference=poses)
