"""Clips: pieces of logs that lie on a map, each joined to the next one as a kidnapping."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import jax.numpy as jnp
import numpy as np

from dsom_jax.data import RawLog
from dsom_jax.data.cut import splice, thin, to_episode
from dsom_jax.data.suite import Suite
from dsom_jax.errors import UserError
from dsom_jax.lidar import LidarConfig
from dsom_jax.occupancy import OccupancyGrid, is_free
from dsom_jax.protocol.plan import ProtocolPlan


def windows(log: RawLog, grid: OccupancyGrid, plan: ProtocolPlan) -> Iterator[np.ndarray]:
    """Indices (T,) of pieces of a log that overlap by half, have a reference throughout, and lie on the map."""
    if log.reference is None:
        return
    used = thin(log)
    poses = log.reference[used]
    known = np.isfinite(poses).all(-1)
    free = np.asarray(is_free(grid, jnp.asarray(poses, jnp.float32)))
    for start in range(0, len(used) - plan.updates + 1, max(plan.updates // 2, 1)):
        piece = slice(start, start + plan.updates)
        if known[piece].all() and free[piece].mean() >= plan.on_map:
            yield used[piece]


def rounded_mount(lidar: LidarConfig) -> LidarConfig:
    """A lidar whose mount, which logs tell only through their poses, is rounded to a millimetre and a milliradian."""
    x, y, yaw = (round(value, 3) for value in lidar.mount)
    return replace(lidar, mount=(x, y, yaw))


def choose(plan: ProtocolPlan, logs: list[RawLog], name: str, grid: OccupancyGrid) -> Suite:
    """``plan.clips`` pieces of all logs, evenly spread, each joined to the next by a kidnapping."""
    found = [(log, rows) for log in logs for rows in windows(log, grid, plan)]
    if len(found) < plan.clips:
        raise UserError(
            f"{name}: {len(found)} clips of {plan.updates} updates have their reference on free cells of this map, "
            f"{plan.clips} are wanted; check the pose of the map, the reference, updates and on_map"
        )
    chosen = [found[n] for n in np.linspace(0, len(found) - 1, plan.clips).round().astype(int)]
    if len({rounded_mount(log.lidar) for log, _ in chosen}) > 1:
        raise UserError(f"{name}: the logs are of different lidars; give one configuration for each")
    clips = [to_episode(log, rows) for log, rows in chosen]
    drives = [splice(clip, after) for clip, after in zip(clips, [*clips[1:], clips[0]], strict=True)]
    return Suite(f"{plan.name}, {name}", chosen[0][0].lidar, (), tuple((name, grid, drive) for drive in drives))
