"""Sequences to train filters on: pieces of random drives through given maps, each in a world of its own.

The paths are planned on the host once; everything that a robot senses on them (unknown obstacles, missing structure,
scans, odometry) is drawn anew on the device for every batch.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from dsom_jax import checks
from dsom_jax.lidar import LidarConfig, LidarNoise, observe
from dsom_jax.occupancy import OccupancyGrid
from dsom_jax.raycast import RaycastConfig, cast_rays, make_tables
from dsom_jax.simulate.drive import DriveConfig, measure_odometry
from dsom_jax.simulate.obstacles import add_obstacles, remove_structure
from dsom_jax.simulate.paths import drive, roads
from dsom_jax.training.buildings import make_pool, random_poses
from dsom_jax.types import Array, Key


@dataclass(frozen=True)
class SequenceConfig:
    """What the sequences are like.

    Attributes:
        lidar: the sensor; every ``beam_step``-th beam is cast.
        beam_step: see ``lidar``.
        drives: paths planned in each map.
        length: updates of each path.
        window: updates of a sequence, over which gradients are propagated.
        obstacles, removed: most unknown obstacles, and most missing pieces of structure, near one sequence.
        noise: largest standard deviation of the ranges, metres.
        dropout, short: largest probabilities of a beam without return, and of one cut short.
        drive: how the robot moves, its odometry, and how far from the path the world may differ from the map.
    """

    lidar: LidarConfig = LidarConfig()
    beam_step: int = 3
    drives: int = 200
    length: int = 140
    window: int = 8
    obstacles: int = 12
    removed: int = 3
    noise: float = 0.05
    dropout: float = 0.02
    short: float = 0.05
    drive: DriveConfig = field(default_factory=DriveConfig)

    def __post_init__(self) -> None:
        checks.count(self, "beam_step drives length")
        checks.count(self, "window", 2)
        checks.within(self, "window", 2, self.length, f"must not exceed length = {self.length}")
        checks.count(self, "obstacles removed", 0)
        checks.not_negative(self, "noise")
        checks.share(self, "dropout short")


class PathPool(NamedTuple):
    """Paths through M maps of one resolution, padded to a common shape.

    Attributes:
        occupied, free: (M, H, W) bool.
        poses: (N, T, 3) in the frame of the path's own map: metres from its lower-left corner, radians.
        where: (N,) number of the map.
    """

    occupied: Array
    free: Array
    poses: Array
    where: Array


class Window(NamedTuple):
    """A sequence of L updates.

    Attributes:
        where: () number of the map.
        ranges: (L, B) metres, REP-117.
        odometry: (L, 3) base frame; row 0 is zero.
        poses: (L, 3) truth, frame of the map.
        strays: (S, 3) poses anywhere in free space, for particles that are wrong altogether.
    """

    where: Array
    ranges: Array
    odometry: Array
    poses: Array
    strays: Array


def plan_paths(seed: int, grids: Sequence[OccupancyGrid], config: SequenceConfig) -> PathPool:
    """Random drives in each of ``grids``; a function of the seed. They differ from those of ``make_synthetic``."""
    maps = make_pool(list(grids), 1)
    step = (config.drive.update_min_d, config.drive.update_min_a)
    paths, where = [], []
    for number, grid in enumerate(grids):
        network = roads(grid)
        for n in range(config.drives):
            # A sequence of numbers seeds another stream than any single one does.
            rng = np.random.default_rng((seed, number, n))
            paths.append(drive(network, rng, int(rng.integers(len(network.cells))), config.length, step))
            where.append(number)
    return PathPool(*maps, jnp.asarray(np.stack(paths), jnp.float32), jnp.asarray(where, jnp.int32))


def make_windows(
    key: Key, pool: PathPool, config: SequenceConfig, resolution: float, count: int, strays: int
) -> Window:
    """``count`` sequences with ``strays`` stray poses each, leaves (count, ...)."""

    # One after the other: rays of several worlds would all wait for the last one.
    return jax.lax.map(lambda k: make_window(k, pool, config, resolution, strays), jax.random.split(key, count))


def make_window(key: Key, pool: PathPool, config: SequenceConfig, resolution: float, strays: int) -> Window:
    """One sequence: a piece of a random path, and what the robot senses on it."""
    k_path, k_start, k_world, k_scan, k_odometry, k_stray = jax.random.split(key, 6)
    path = jax.random.randint(k_path, (), 0, pool.where.shape[0])
    start = jax.random.randint(k_start, (), 0, config.length - config.window + 1)
    poses = jax.lax.dynamic_slice(pool.poses, (path, start, jnp.int32(0)), (1, config.window, 3))[0]
    where = pool.where[path]
    grid = OccupancyGrid(pool.occupied[where], pool.free[where], jnp.zeros(3), resolution)
    ranges = _sense(k_scan, spoil_world(k_world, grid, poses, config), poses, config)
    before = jnp.concatenate([poses[:1], poses[:-1]])
    odometry = measure_odometry(k_odometry, before, poses, config.drive.odometry)
    return Window(where, ranges, odometry, poses, random_poses(k_stray, grid.free, resolution, strays))


def spoil_world(key: Key, grid: OccupancyGrid, poses: Array, config: SequenceConfig) -> OccupancyGrid:
    """The map with unknown obstacles put in and structure removed near ``poses`` (L, 3), the path left free."""
    k_added, k_removed, k_add, k_remove = jax.random.split(key, 4)
    distance = path_distance(grid, poses)
    keep = distance <= max(config.drive.margin, 1.5 * grid.resolution)
    near = distance <= config.drive.near
    if config.removed:
        count = jax.random.randint(k_removed, (), 0, config.removed + 1)
        grid = remove_structure(k_remove, grid, count, max_count=config.removed, where=near)
    if not config.obstacles:
        return grid
    count = jax.random.randint(k_added, (), 0, config.obstacles + 1)
    where = near & ~keep & grid.free
    return add_obstacles(k_add, grid, count, max_count=config.obstacles, where=where, keep=keep)


def path_distance(grid: OccupancyGrid, poses: Array) -> Array:
    """(H, W) metres from the centre of each cell to the nearest of ``poses`` (L, 3), in the grid's frame."""
    x, y = ((jnp.arange(n) + 0.5) * grid.resolution for n in (grid.shape[1], grid.shape[0]))
    squared = (x - poses[:, 0, None])[:, None, :] ** 2 + (y - poses[:, 1, None])[:, :, None] ** 2
    return jnp.sqrt(squared.min(0))


def _sense(key: Key, world: OccupancyGrid, poses: Array, config: SequenceConfig) -> Array:
    """Noisy scans (L, B) at ``poses``, the noise of each sequence its own."""
    k_amount, k_observe = jax.random.split(key)
    lidar, r = config.lidar.every(config.beam_step), jax.random.uniform(k_amount, (3,))
    amounts = {"sigma": config.noise * r[0], "dropout": config.dropout * r[1], "short": config.short * r[2]}
    tables = make_tables(world, RaycastConfig("exact", max_skip=15), lidar.range_max)
    return observe(k_observe, cast_rays(tables, poses, lidar), lidar, LidarNoise(**amounts))  # type: ignore[arg-type]
