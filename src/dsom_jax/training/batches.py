"""Batches made on the device: a building, unknown obstacles in it, and scans that see them, which the map does not."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import jax
import jax.numpy as jnp

from dsom_jax import checks
from dsom_jax.lidar import LidarConfig, LidarNoise, observe
from dsom_jax.nn.config import DSOMConfig
from dsom_jax.nn.panorama import finer_ranges
from dsom_jax.nn.polar import Conditions
from dsom_jax.occupancy import OccupancyGrid
from dsom_jax.raycast import RaycastConfig, cast_rays, make_tables
from dsom_jax.simulate.obstacles import add_obstacles, remove_structure
from dsom_jax.training.buildings import WorldSource, random_poses
from dsom_jax.types import Array, Key

_PIECES = 24
"""Bearings of a full turn between which shifts of misplaced walls are interpolated."""


@dataclass(frozen=True)
class ScanConfig:
    """What the simulated scans are like; every scan draws its own values within these.

    Attributes:
        beams: of the full turn that is cast.
        range_max: metres.
        reach_min: shortest maximal range drawn, metres.
        fov_min: narrowest field of view drawn, radians.
        fov_max: widest field of view, radians.
        limited: probability that a scan has a shorter reach, and likewise a narrower view.
        thinning: at most every so many-th beam is kept.
        sigma: largest standard deviation of the ranges, metres.
        dropout: largest probability of a beam without return.
        short: largest probability of a beam cut short by something unknown.
        obstacles: least and largest number of unknown obstacles per 43 m x 43 m.
        depth: least and largest distance behind the mapped edge of a wall at which the beams of a scan end, metres;
            coarse cells of real maps begin before their walls.
        deep: probability that a scan has such a depth.
        bare: probability that the map of a procedural building shows its walls only, as floor plans do.
        removed: least and largest number of pieces of mapped structure per 43 m x 43 m that are not there.
        misplaced: standard deviation, metres, by which walls stand elsewhere than the map says, piece by piece.
    """

    beams: int = 360
    range_max: float = 10.0
    reach_min: float = 5.0
    fov_min: float = math.pi
    fov_max: float = 2 * math.pi
    limited: float = 0.3
    thinning: int = 5
    sigma: float = 0.05
    dropout: float = 0.05
    short: float = 0.1
    obstacles: tuple[int, int] = (0, 40)
    depth: tuple[float, float] = (-0.1, 0.35)
    deep: float = 0.5
    bare: float = 0.2
    removed: tuple[int, int] = (0, 0)
    misplaced: float = 0.0

    def __post_init__(self) -> None:
        checks.count(self, "beams thinning")
        checks.positive(self, "range_max reach_min fov_min")
        checks.within(self, "reach_min", 0, self.range_max, f"must not exceed range_max = {self.range_max!r} m")
        checks.within(self, "fov_max", 0, 2 * math.pi + 1e-6, "give radians, at most a full turn")
        checks.within(self, "fov_min", 0, self.fov_max + 1e-6, f"must not exceed fov_max = {self.fov_max!r} rad")
        checks.not_negative(self, "sigma misplaced")
        checks.share(self, "limited dropout short deep bare")
        checks.low_high(self, "obstacles removed", 0)
        checks.low_high(self, "depth")

    @property
    def lidar(self) -> LidarConfig:
        """The lidar that is cast, a full turn."""
        return LidarConfig(self.beams, -math.pi, 2 * math.pi / self.beams, 0.0, self.range_max)


def plain_scans(config: ScanConfig) -> ScanConfig:
    """Full scans with little noise; the map lacks only 20 obstacles per 43 m x 43 m."""
    quiet = replace(config, sigma=0.02, dropout=0.0, short=0.0, deep=0.0)
    return replace(quiet, limited=0.0, thinning=1, obstacles=(20, 20), bare=0.0, removed=(0, 0), misplaced=0.0)


PLAIN = plain_scans(ScanConfig())
"""The scans that checkpoints are judged by: one full turn, 20 unknown obstacles per 43 m x 43 m."""


class Batch(NamedTuple):
    """N buildings with S scans each.

    Attributes:
        occupied: (N, H, W) bool, the map without the obstacles, at the network's scale.
        free: (N, H, W) bool, where probability may go.
        ranges: (N, S, B) metres; NaN for beams that the scan does not have.
        conditions: reach and gap (N, S) of the scans.
        poses: (N, S, 3) in the grid's frame (metres from its lower-left corner, radians).
        views: what would be seen from where in maps that were finer, (N, H/2, W/2, A) metres; None for others.
    """

    occupied: Array
    free: Array
    ranges: Array
    conditions: Conditions
    poses: Array
    views: Array | None = None


def random_conditions(key: Key, config: ScanConfig) -> tuple[Conditions, Array]:
    """Conditions of one scan and which of its beams (B,) exist: a window of view, thinned."""
    r = jax.random.uniform(key, (6,))
    short = config.reach_min + (config.range_max - config.reach_min) * r[1]
    reach = jnp.where(r[0] < config.limited, short, config.range_max)
    narrow = config.fov_min + (config.fov_max - config.fov_min) * r[3]
    fov = jnp.where(r[2] < config.limited, narrow, config.fov_max)
    step = 1 + jnp.floor(r[4] * config.thinning).astype(jnp.int32)
    beam = jnp.arange(config.beams)
    shifted = (beam + jnp.floor(r[5] * config.beams).astype(jnp.int32)) % config.beams
    present = (shifted <= fov / (2 * math.pi) * config.beams) & (beam % step == 0)
    return Conditions(reach, step * (2 * math.pi / config.beams)), present


def random_noise(key: Key, config: ScanConfig) -> LidarNoise:
    """Imperfections of one scan."""
    r = jax.random.uniform(key, (3,))
    values = {"sigma": config.sigma * r[0], "dropout": config.dropout * r[1] ** 2, "short": config.short * r[2] ** 2}
    return LidarNoise(**values)  # type: ignore[arg-type]  # traced numbers


def random_depth(key: Key, config: ScanConfig) -> Array:
    """How far behind the mapped edge of walls the beams of one scan end (), metres."""
    r = jax.random.uniform(key, (2,))
    return jnp.where(r[0] < config.deep, config.depth[0] + (config.depth[1] - config.depth[0]) * r[1], 0.0)


def misplace(key: Key, ranges: Array, sigma: float) -> Array:
    """Ranges (B,) of a full turn to walls that stand elsewhere, by ``sigma`` metres that vary with the bearing."""
    shifts = sigma * jax.random.normal(key, (_PIECES,))
    where = jnp.arange(ranges.size) * (_PIECES / ranges.size)
    return jnp.maximum(ranges + jnp.interp(where, jnp.arange(_PIECES), shifts, period=_PIECES), 0.0)


def spoil_scan(key: Key, ranges: Array, config: ScanConfig) -> tuple[Array, Conditions]:
    """A clean scan (B,) with noise, reach, view and thinning of its own."""
    k_conditions, k_noise, k_observe, k_depth = jax.random.split(key, 4)
    ranges = jnp.maximum(ranges + random_depth(k_depth, config), 0.0)
    if config.misplaced:
        ranges = misplace(jax.random.fold_in(k_depth, 1), ranges, config.misplaced)
    conditions, present = random_conditions(k_conditions, config)
    ranges = observe(k_observe, ranges, config.lidar, random_noise(k_noise, config))
    ranges = jnp.where(ranges < conditions.reach, ranges, jnp.inf)
    return jnp.where(present, ranges, jnp.nan), conditions


def disturbed(keys: tuple[Key, Key], grid: OccupancyGrid, config: ScanConfig) -> OccupancyGrid:
    """The world ``grid`` with unknown obstacles (their number by the first key), and without some of its structure."""
    k_number, k_obstacles = keys
    area = grid.size[0] * grid.size[1] / 43.0**2
    (fewest, most_gone), (least, most) = (
        [round(n * area) for n in both] for both in (config.removed, config.obstacles)
    )
    if most_gone:
        k_gone, k_which = jax.random.split(jax.random.fold_in(k_number, 1))
        gone = jax.random.randint(k_gone, (), fewest, most_gone + 1)
        grid = remove_structure(k_which, grid, gone, max_count=most_gone)
    number = jax.random.randint(k_number, (), least, most + 1)
    return add_obstacles(k_obstacles, grid, number, max_count=most) if most else grid


def make_scans(key: Key, grid: OccupancyGrid, config: ScanConfig, count: int) -> tuple[Array, Conditions, Array]:
    """Scans (S, B), their conditions (S,) and poses (S, 3) in one building furnished with unknown obstacles."""
    k_number, k_obstacles, k_poses, k_scans = jax.random.split(key, 4)
    seen = disturbed((k_number, k_obstacles), grid, config)
    poses = random_poses(k_poses, seen.free, grid.resolution, count)
    tables = make_tables(seen, RaycastConfig("exact"), config.range_max)
    clean = cast_rays(tables, grid.from_grid(poses), config.lidar)
    ranges, conditions = jax.vmap(lambda k, r: spoil_scan(k, r, config))(jax.random.split(k_scans, count), clean)
    return ranges, conditions, poses


def make_batch(
    key: Key, source: WorldSource, config: ScanConfig, worlds: int, scans: int, model: DSOMConfig | None = None
) -> Batch:
    """``worlds`` buildings of ``source`` with ``scans`` scans each; ``model`` says what views of finer maps are."""

    def one(key: Key) -> tuple[Batch, OccupancyGrid | None]:
        k_world, k_scans = jax.random.split(key)
        shown, seen, given = source(k_world)
        return Batch(shown.occupied, shown.free, *make_scans(k_scans, seen, config, scans)), given

    batch, given = jax.vmap(one)(jax.random.split(key, worlds))
    if given is None or model is None or not model.panorama:
        return batch
    shape = (batch.free.shape[1], batch.free.shape[2])
    # One map after the other: rays of a batch of maps would all wait for the last one.
    views = jax.lax.map(lambda one: finer_ranges(one, model, shape, given.resolution), given.occupied)
    return batch._replace(views=views)
