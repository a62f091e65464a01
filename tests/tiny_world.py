"""A room that looks different from everywhere, 6 m x 5 m, and a drive through it, for filters and proposals."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import numpy as np

from dsom_jax.episode import Episode
from dsom_jax.geometry import compose
from dsom_jax.lidar import LidarConfig
from dsom_jax.occupancy import OccupancyGrid, from_cells
from dsom_jax.raycast import MapTables, RaycastConfig, cast_rays, make_tables

LIDAR = LidarConfig(beams=32, angle_increment=2 * math.pi / 32, range_max=5.0)
ORIGIN = (2.0, -1.0, 0.4)
cast = jax.jit(cast_rays, static_argnums=2)


def cells() -> np.ndarray:
    """(20, 24) bool: four walls, a nook, a pillar and a cupboard."""
    occupied = np.zeros((20, 24), bool)
    occupied[[0, -1]] = occupied[:, [0, -1]] = True
    occupied[1:9, 7:9] = True
    occupied[13:15, 4:6] = True
    occupied[14:19, 18:20] = True
    return occupied


def grid() -> OccupancyGrid:
    """The room at 0.25 m per cell, its building turned by 0.4 rad."""
    return from_cells(cells(), resolution=0.25, origin=ORIGIN)


def tables() -> MapTables:
    """Exact rays."""
    return make_tables(grid(), RaycastConfig("exact"), LIDAR.range_max)


def drive(steps: int = 10) -> Episode:
    """An arc through the room without noise; ``odometry`` is exact."""
    odometry = np.tile(np.array([0.15, 0.0, 0.12], np.float32), (steps, 1))
    odometry[0] = 0.0
    poses = [np.asarray(grid().from_grid(jnp.array([3.1, 2.3, 0.3])))]
    for step in odometry[1:]:
        poses.append(np.asarray(compose(jnp.asarray(poses[-1]), jnp.asarray(step))))
    poses = jnp.asarray(np.stack(poses))
    ranges = cast(tables(), poses, LIDAR)
    return Episode(ranges, jnp.asarray(odometry), poses, jnp.zeros(steps, bool), jnp.arange(steps, dtype=jnp.float32))
