"""Batches made on the device: a building, unknown obstacles in it, and scans that see them, which the map does not."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp

from dsom_jax import checks
from dsom_jax.lidar import LidarConfig, LidarNoise, observe
from dsom_jax.nn.polar import Conditions
from dsom_jax.occupancy import OccupancyGrid
from dsom_jax.raycast import RaycastConfig, cast_rays, make_tables
from dsom_jax.simulate.obstacles import add_obstacles
from dsom_jax.simulate.worlds import WorldConfig, make_world
from dsom_jax.types import Array, Key

T = TypeVar("T")


class Building(NamedTuple):
    """What the map shows and what a lidar sees; free space of ``seen`` is part of that of ``shown``."""

    shown: OccupancyGrid
    seen: OccupancyGrid


WorldSource = Callable[[Key], Building]
"""Draws a building; :func:`procedural_source`, :func:`crop_source` or :func:`mixed_source`."""


@dataclass(frozen=True)
class ScanConfig:
    """What the simulated scans are like; every scan draws its own values within these.

    Attributes:
        beams: of the full turn that is cast.
        range_max: metres.
        reach_min: shortest maximal range drawn, metres.
        fov_min: narrowest field of view drawn, radians.
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
    """

    beams: int = 360
    range_max: float = 10.0
    reach_min: float = 5.0
    fov_min: float = math.pi
    limited: float = 0.3
    thinning: int = 5
    sigma: float = 0.05
    dropout: float = 0.05
    short: float = 0.1
    obstacles: tuple[int, int] = (0, 40)
    depth: tuple[float, float] = (-0.1, 0.35)
    deep: float = 0.5
    bare: float = 0.2

    def __post_init__(self) -> None:
        checks.count(self, "beams thinning")
        checks.positive(self, "range_max reach_min fov_min")
        checks.within(self, "reach_min", 0, self.range_max, f"must not exceed range_max = {self.range_max!r} m")
        checks.within(self, "fov_min", 0, 2 * math.pi + 1e-6, "give radians, at most a full turn")
        checks.not_negative(self, "sigma")
        checks.share(self, "limited dropout short deep bare")
        checks.interval(self, "obstacles", 0)
        checks.interval(self, "depth")

    @property
    def lidar(self) -> LidarConfig:
        """The lidar that is cast, a full turn."""
        return LidarConfig(self.beams, -math.pi, 2 * math.pi / self.beams, 0.0, self.range_max)


def plain(config: ScanConfig) -> ScanConfig:
    """Full scans with little noise; the map lacks only 20 obstacles per 43 m x 43 m."""
    quiet = replace(config, sigma=0.02, dropout=0.0, short=0.0, deep=0.0)
    return replace(quiet, limited=0.0, thinning=1, obstacles=(20, 20), bare=0.0)


PLAIN = plain(ScanConfig())
"""The scans that checkpoints are judged by: one full turn, 20 unknown obstacles per 43 m x 43 m."""


class Batch(NamedTuple):
    """N buildings with S scans each.

    Attributes:
        occupied: (N, H, W) bool, the map without the obstacles.
        free: (N, H, W) bool, where probability may go.
        ranges: (N, S, B) metres; NaN for beams that the scan does not have.
        conditions: reach and gap (N, S) of the scans.
        poses: (N, S, 3) in the grid's frame (metres from its lower-left corner, radians).
    """

    occupied: Array
    free: Array
    ranges: Array
    conditions: Conditions
    poses: Array


def random_poses(key: Key, free: Array, resolution: float, count: int) -> Array:
    """Poses (count, 3) uniform over the free cells (H, W), in the grid's frame."""
    k_cell, k_offset = jax.random.split(key)
    # Inverse of the cumulative count: picks the n-th free cell, never one that is not free.
    cumulative = jnp.cumsum(free.ravel(), dtype=jnp.int32)
    rank = jax.random.randint(k_cell, (count,), 0, jnp.maximum(cumulative[-1], 1))
    cell = jnp.searchsorted(cumulative, rank, side="right")
    u = jax.random.uniform(k_offset, (count, 3))
    x = (cell % free.shape[1] + u[:, 0]) * resolution
    y = (cell // free.shape[1] + u[:, 1]) * resolution
    return jnp.stack([x, y, (2 * u[:, 2] - 1) * jnp.pi], axis=-1)


def random_conditions(key: Key, config: ScanConfig) -> tuple[Conditions, Array]:
    """Conditions of one scan and which of its beams (B,) exist: a window of view, thinned."""
    r = jax.random.uniform(key, (6,))
    short = config.reach_min + (config.range_max - config.reach_min) * r[1]
    reach = jnp.where(r[0] < config.limited, short, config.range_max)
    narrow = config.fov_min + (2 * math.pi - config.fov_min) * r[3]
    fov = jnp.where(r[2] < config.limited, narrow, 2 * math.pi)
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


def spoil_scan(key: Key, ranges: Array, config: ScanConfig) -> tuple[Array, Conditions]:
    """A clean scan (B,) with noise, reach, view and thinning of its own."""
    k_conditions, k_noise, k_observe, k_depth = jax.random.split(key, 4)
    ranges = jnp.maximum(ranges + random_depth(k_depth, config), 0.0)
    conditions, present = random_conditions(k_conditions, config)
    ranges = observe(k_observe, ranges, config.lidar, random_noise(k_noise, config))
    ranges = jnp.where(ranges < conditions.reach, ranges, jnp.inf)
    return jnp.where(present, ranges, jnp.nan), conditions


def make_scans(key: Key, grid: OccupancyGrid, config: ScanConfig, count: int) -> tuple[Array, Conditions, Array]:
    """Scans (S, B), their conditions (S,) and poses (S, 3) in one building furnished with unknown obstacles."""
    k_number, k_obstacles, k_poses, k_scans = jax.random.split(key, 4)
    area = grid.size[0] * grid.size[1] / 43.0**2
    least, most = (round(number * area) for number in config.obstacles)
    number = jax.random.randint(k_number, (), least, most + 1)
    seen = add_obstacles(k_obstacles, grid, number, max_count=most) if most else grid
    poses = random_poses(k_poses, seen.free, grid.resolution, count)
    tables = make_tables(seen, RaycastConfig("exact"), config.range_max)
    clean = cast_rays(tables, grid.from_grid(poses), config.lidar)
    ranges, conditions = jax.vmap(lambda k, r: spoil_scan(k, r, config))(jax.random.split(k_scans, count), clean)
    return ranges, conditions, poses


def make_batch(key: Key, source: WorldSource, config: ScanConfig, worlds: int, scans: int) -> Batch:
    """``worlds`` buildings of ``source`` with ``scans`` scans each."""

    def one(key: Key) -> Batch:
        k_world, k_scans = jax.random.split(key)
        shown, seen = source(k_world)
        return Batch(shown.occupied, shown.free, *make_scans(k_scans, seen, config, scans))

    return jax.vmap(one)(jax.random.split(key, worlds))


def procedural_source(world: WorldConfig, bare: float) -> WorldSource:
    """Procedural buildings; with probability ``bare`` the map lacks all that is not a wall."""
    empty = replace(world, furniture=0.0, pillars=0.0, shelves=0.0)

    def draw(key: Key) -> Building:
        k_world, k_bare = jax.random.split(key)
        seen = make_world(k_world, world)
        if not bare:
            return Building(seen, seen)
        return Building(choose(jax.random.uniform(k_bare) < bare, make_world(k_world, empty), seen), seen)

    return draw


def mixed_source(first: WorldSource, second: WorldSource, share: float) -> WorldSource:
    """``first`` with probability ``share``, else ``second``."""

    def draw(key: Key) -> Building:
        k_which, k_first, k_second = jax.random.split(key, 3)
        return choose(jax.random.uniform(k_which) < share, first(k_first), second(k_second))

    return draw


def choose(condition: Array, first: T, second: T) -> T:
    """``first`` where ``condition`` () holds, else ``second``, leaf by leaf."""
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), first, second)


class MapPool(NamedTuple):
    """Given maps at one resolution, padded to a common shape: occupied and free (N, H, W)."""

    occupied: Array
    free: Array


def make_pool(grids: list[OccupancyGrid], cells: int) -> MapPool:
    """Stack maps of one resolution; every side is at least ``cells``."""
    shape = [max(cells, *(grid.shape[axis] for grid in grids)) for axis in (0, 1)]

    def stack(layers: list[Array]) -> Array:
        return jnp.stack([jnp.pad(a, [(0, n - m) for n, m in zip(shape, a.shape, strict=True)]) for a in layers])

    return MapPool(stack([grid.occupied for grid in grids]), stack([grid.free for grid in grids]))


def crop_source(pool: MapPool, cells: int, resolution: float) -> WorldSource:
    """Random square crops of given maps around a free cell, turned by quarters and mirrored at random."""

    def draw(key: Key) -> Building:
        k_map, k_cell, k_turn = jax.random.split(key, 3)
        number = jax.random.randint(k_map, (), 0, pool.free.shape[0])
        occupied, free = pool.occupied[number], pool.free[number]
        x, y = random_poses(k_cell, free, 1.0, 1)[0, :2].astype(jnp.int32)
        corner = [jnp.clip(c - cells // 2, 0, n - cells) for c, n in zip((y, x), free.shape, strict=True)]
        turn = jax.random.randint(k_turn, (), 0, 8)
        occupied, free = (turned(jax.lax.dynamic_slice(a, corner, (cells, cells)), turn) for a in (occupied, free))
        grid = OccupancyGrid(occupied, free, jnp.zeros(3), resolution)
        return Building(grid, grid)

    return draw


def turned(square: Array, turn: Array) -> Array:
    """One of the eight symmetries of a square array (n, n)."""
    square = jnp.where(turn & 1, square[::-1], square)
    square = jnp.where(turn & 2, square[:, ::-1], square)
    return jnp.where(turn & 4, square.T, square)
