"""From a log to episodes: which scans are used, how they are cut into segments, and how a kidnapping is made."""

from __future__ import annotations

import math
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np

from dsom_jax.data import se2
from dsom_jax.data.log import RawLog
from dsom_jax.episode import Episode
from dsom_jax.errors import UserError


def thin(log: RawLog, update_min_d: float = 0.25, update_min_a: float = 0.2) -> np.ndarray:
    """Indices (M,) of the scans that a filter uses, as in nav2_amcl: the first, and each one at which the odometry has
    moved ``update_min_d`` metres or turned ``update_min_a`` radians since the last used scan, or jumped."""
    if update_min_d < 0 or update_min_a < 0:
        raise UserError(f"update_min_d = {update_min_d}, update_min_a = {update_min_a}: must not be negative")
    poses = log.odometry.tolist()
    broken = np.zeros(len(log), bool) if log.broken is None else log.broken
    used = [0] if len(log) else []
    for n in range(1, len(log)):
        if far_enough(poses[used[-1]], poses[n], update_min_d, update_min_a) or broken[n]:
            used.append(n)
    return np.array(used, int)


def far_enough(
    a: Sequence[float] | np.ndarray, b: Sequence[float] | np.ndarray, update_min_d: float, update_min_a: float
) -> bool:
    """Whether odometry that went from pose ``a`` (3,) to ``b`` has moved or turned enough for an update."""
    turned = abs((b[2] - a[2] + np.pi) % (2 * np.pi) - np.pi)
    return bool(math.hypot(b[0] - a[0], b[1] - a[1]) >= update_min_d or turned >= update_min_a)


def to_episode(log: RawLog, indices: np.ndarray) -> Episode:
    """Episode of the scans ``indices`` (T,): body-frame increments between them, stamps from the first on."""
    indices = np.asarray(indices, int)
    poses = log.odometry[indices]
    odometry = np.zeros_like(poses)
    odometry[1:] = se2.relative(poses[:-1], poses[1:])
    unknown = np.full(poses.shape, np.nan)
    return Episode(
        ranges=jnp.asarray(log.ranges[indices], jnp.float32),
        odometry=jnp.asarray(odometry, jnp.float32),
        poses=jnp.asarray(unknown if log.reference is None else log.reference[indices], jnp.float32),
        kidnapped=jnp.zeros(len(indices), bool),
        stamps=jnp.asarray(log.stamps[indices] - log.stamps[indices[0]], jnp.float32),
    )


def segment_indices(
    log: RawLog,
    count: int,
    steps_per_segment: int | None = None,
    update_min_d: float = 0.25,
    update_min_a: float = 0.2,
) -> np.ndarray:
    """Scans (S, T) of ``count`` segments of equally many updates.

    Without ``steps_per_segment`` the thinned log is cut into contiguous pieces of floor(total / S) updates. With it,
    segments of that length (at most the whole log) start evenly spaced over the log and may overlap.
    """
    used = thin(log, update_min_d, update_min_a)
    if count < 1:
        raise UserError(f"segments = {count}: give at least 1")
    if steps_per_segment is not None and steps_per_segment < 2:
        raise UserError(f"steps_per_segment = {steps_per_segment}: give at least 2")
    if steps_per_segment is None and len(used) < 2 * count:
        raise UserError(f"{log.path}: {len(used)} updates are too few for segments = {count}; give fewer segments")
    length = len(used) // count if steps_per_segment is None else min(steps_per_segment, len(used))
    last = len(used) - length if steps_per_segment is not None else (count - 1) * length
    starts = np.rint(np.linspace(0, last, count)).astype(int)
    return used[starts[:, None] + np.arange(length)]


def without_repeats(rows: np.ndarray) -> np.ndarray:
    """Segments (S, T) that differ: a log shorter than S segments would count one drive several times."""
    return rows[np.unique(rows[:, 0], return_index=True)[1]]


def segments(
    log: RawLog,
    count: int,
    steps_per_segment: int | None = None,
    update_min_d: float = 0.25,
    update_min_a: float = 0.2,
) -> list[Episode]:
    """The log as ``count`` episodes of equal length, see :func:`segment_indices`."""
    rows = segment_indices(log, count, steps_per_segment, update_min_d, update_min_a)
    return [to_episode(log, row) for row in rows]


def splice(a: Episode, b: Episode) -> Episode:
    """A kidnapping: the robot drives ``a`` and then, without noticing, is carried to the start of ``b``."""
    if a.ranges.shape[1] != b.ranges.shape[1]:
        raise UserError(f"cannot splice scans of {a.ranges.shape[1]} and {b.ranges.shape[1]} beams; use one lidar")
    pause = a.stamps[-1] - a.stamps[-2] if a.stamps.shape[0] > 1 else jnp.float32(1.0)
    return Episode(
        ranges=jnp.concatenate([a.ranges, b.ranges]),
        odometry=jnp.concatenate([a.odometry, b.odometry.at[0].set(0.0)]),
        poses=jnp.concatenate([a.poses, b.poses]),
        kidnapped=jnp.concatenate([a.kidnapped, b.kidnapped.at[0].set(True)]),
        stamps=jnp.concatenate([a.stamps, a.stamps[-1] + pause + b.stamps - b.stamps[0]]),
    )
