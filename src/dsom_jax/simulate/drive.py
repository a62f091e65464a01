"""A simulated drive through a map that is not quite right: ``make_synthetic`` gives the map and an episode."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from scipy import ndimage

from dsom_jax import checks
from dsom_jax.episode import Episode
from dsom_jax.errors import UserError
from dsom_jax.geometry import relative
from dsom_jax.lidar import LidarConfig, LidarNoise, observe
from dsom_jax.motion import OdometryMotion
from dsom_jax.occupancy import OccupancyGrid, cell_index
from dsom_jax.raycast import RaycastConfig, cast_rays, make_tables
from dsom_jax.simulate.obstacles import add_obstacles, remove_structure
from dsom_jax.simulate.paths import Roads, drive, roads
from dsom_jax.types import Array, Key

SPEED, TURN_RATE = 0.5, 0.8
"""Metres and radians per second of the simulated robot; only the stamps depend on them."""

_add = jax.jit(add_obstacles, static_argnames=("count",))
_remove = jax.jit(remove_structure, static_argnames=("count",))


@dataclass(frozen=True)
class DriveConfig:
    """A drive in phases; between two phases the robot is carried elsewhere, unseen by its odometry.

    Attributes:
        updates: number of updates in each phase.
        update_min_d: metres between updates.
        update_min_a: radians between updates, whichever comes first.
        kidnap_distance: the robot is carried at least this far, metres.
        obstacles: unknown obstacles along the path.
        removed: pieces of the map's structure along the path that are not there.
        near: how far from the path the two lie at most, metres.
        margin: how far obstacles stay off the path, metres.
        lidar: the sensor.
        lidar_noise: its imperfections.
        odometry: noise of the increments, as a motion model: about 5 % of the way and 10 % of turns.
    """

    updates: tuple[int, ...] = (70, 70)
    update_min_d: float = 0.5
    update_min_a: float = 0.3
    kidnap_distance: float = 8.0
    obstacles: int = 20
    removed: int = 4
    near: float = 3.0
    margin: float = 0.35
    lidar: LidarConfig = field(default_factory=LidarConfig)
    lidar_noise: LidarNoise = field(default_factory=lambda: LidarNoise(sigma=0.03))
    odometry: OdometryMotion = field(
        default_factory=lambda: OdometryMotion(0.01, 0.001, 0.0025, 0.001, min_xy=0.005, min_theta=0.002)
    )

    def __post_init__(self) -> None:
        if not self.updates or min(self.updates) < 2:
            raise ValueError(f"updates = {self.updates}: each phase needs at least 2 updates")
        checks.positive(self, "update_min_d update_min_a")
        checks.count(self, "obstacles removed", 0)
        checks.not_negative(self, "kidnap_distance near margin")


def make_synthetic(
    seed: int, grid: OccupancyGrid, config: DriveConfig = DriveConfig()
) -> tuple[OccupancyGrid, Episode]:
    """The true world of a drive through the map ``grid``, and the episode; the same seed gives the same drive."""
    k_world, k_scan, k_odometry = jax.random.split(jax.random.key(seed), 3)
    poses, before, kidnapped = _plan(np.random.default_rng(seed), grid, config)
    world = true_world(k_world, grid, poses, config)
    ranges = _sense(k_scan, world, poses, config)
    odometry = measure_odometry(k_odometry, before, poses, config.odometry)
    return world, Episode(ranges, odometry, poses, kidnapped, stamps(before, poses))


def _plan(rng: np.random.Generator, grid: OccupancyGrid, config: DriveConfig) -> tuple[Array, Array, Array]:
    """Poses (T, 3) of the updates, poses (T, 3) where the odometry's increments start, and kidnappings (T,).

    An increment starts at the previous update; after a kidnapping it starts where the robot was put down.
    """
    network = roads(grid)
    step = (config.update_min_d, config.update_min_a)
    phases: list[np.ndarray] = []
    for updates in config.updates:
        start = rng.integers(len(network.cells)) if not phases else _put_down(network, rng, phases[-1][-1], config)
        phases.append(drive(network, rng, int(start), updates + bool(phases), step))
    arrived = [phases[0], *(phase[1:] for phase in phases[1:])]
    started = [phases[0][:1], phases[0][:-1], *(phase[:-1] for phase in phases[1:])]
    kidnapped = np.concatenate([(np.arange(len(phase)) == 0) & (n > 0) for n, phase in enumerate(arrived)])
    poses, before = (grid.from_grid(jnp.asarray(np.concatenate(p), jnp.float32)) for p in (arrived, started))
    return poses, before, jnp.asarray(kidnapped)


def _put_down(network: Roads, rng: np.random.Generator, last: np.ndarray, config: DriveConfig) -> int:
    """A random cell at least ``kidnap_distance`` from the pose ``last``, with half a metre to spare for the drive."""
    away = np.hypot(*(network.centres() - last[:2]).T)
    far = np.flatnonzero(away >= config.kidnap_distance + config.update_min_d)
    if not len(far):
        raise UserError(
            f"the map has no free place {config.kidnap_distance:g} m away to carry the robot to; "
            "lower kidnap_distance, or give one phase of updates"
        )
    return int(rng.choice(far))


def true_world(key: Key, grid: OccupancyGrid, poses: Array, config: DriveConfig) -> OccupancyGrid:
    """The map with obstacles put in and structure removed near the path of ``poses`` (T, 3), the path left free."""
    i, j = (np.asarray(index) for index in cell_index(grid, poses))
    path = np.zeros(grid.shape, bool)
    path[i, j] = True
    distance = ndimage.distance_transform_edt(~path) * grid.resolution
    keep = distance <= max(config.margin, 1.5 * grid.resolution)
    near = distance <= config.near
    k_add, k_remove = jax.random.split(key)
    where = near & ~keep & np.asarray(grid.free)
    world = _remove(k_remove, grid, config.removed, where=jnp.asarray(near))
    return _add(k_add, world, config.obstacles, where=jnp.asarray(where), keep=jnp.asarray(keep))


def _sense(key: Key, world: OccupancyGrid, poses: Array, config: DriveConfig) -> Array:
    """Noisy scans (T, B) of the true world."""
    return _scan(key, world, poses, config.lidar, config.lidar_noise)


@partial(jax.jit, static_argnames=("lidar", "noise"))
def _scan(key: Key, world: OccupancyGrid, poses: Array, lidar: LidarConfig, noise: LidarNoise) -> Array:
    tables = make_tables(world, RaycastConfig("exact"), lidar.range_max)
    return observe(key, cast_rays(tables, poses, lidar), lidar, noise)


@partial(jax.jit, static_argnames=("noise",))
def measure_odometry(key: Key, before: Array, poses: Array, noise: OdometryMotion) -> Array:
    """Noisy increments (T, 3) between poses ``before`` and ``poses`` in the base frame; row 0 is zero."""
    increments = relative(before, poses)
    # After a kidnapping the increment is the drive since the robot was put down: nothing gives the carrying away.
    keys = jax.random.split(key, len(increments))

    def normals(key: Key) -> Array:
        # Two draws with the first two of four keys: the frozen suites were made so.
        k_parts, k_floor, _, _ = jax.random.split(key, 4)
        return jnp.concatenate([jax.random.normal(k_parts, (3,)), jax.random.normal(k_floor, (2,))])

    return jax.vmap(noise.moved, (None, 0, 0))(jnp.zeros(3), increments, jax.vmap(normals)(keys)).at[0].set(0.0)


def stamps(before: Array, poses: Array) -> Array:
    """(T,) seconds since the start, at constant speed."""
    moves = relative(before, poses)
    return jnp.cumsum(jnp.hypot(moves[:, 0], moves[:, 1]) / SPEED + jnp.abs(moves[:, 2]) / TURN_RATE)
