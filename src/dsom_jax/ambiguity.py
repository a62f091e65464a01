"""Where in a building a robot is ambiguous: exact grid localization on many short simulated drives."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from dsom_jax import checks
from dsom_jax import pose_grid as pg
from dsom_jax.compiling import run_options
from dsom_jax.errors import UserError
from dsom_jax.geometry import compose
from dsom_jax.lidar import LidarConfig, LidarNoise, observe
from dsom_jax.occupancy import OccupancyGrid
from dsom_jax.proposals.likelihood_grid import LikelihoodGridConfig, likelihood_grid, resample_free
from dsom_jax.proposals.markov_grid import MarkovGrid
from dsom_jax.raycast import RaycastConfig, cast_rays, make_tables
from dsom_jax.sensor import BeamModel
from dsom_jax.simulate.drive import DriveConfig, measure_odometry
from dsom_jax.simulate.paths import drive, roads
from dsom_jax.types import Array, Inputs

_POSITION, _ANGLE, _SURE = 2.0, math.radians(10), 0.95
"""The robot is found once so much of the belief lies within 2 m and 10 deg of where it is."""


@dataclass(frozen=True)
class AmbiguityConfig:
    """How a building is tried.

    Attributes:
        drives: random drives, each from another place.
        updates: updates of a drive; ``step`` metres or radians between two of them, whichever comes first.
        headings: of the belief.
        states: cells of the belief are so large that there are no more of them, times headings.
        noise: of the ranges; ``short`` stands for people and things that the map does not show.
        temper: what a scan counts for, as in ``Settings.memory_temper``.
        batch: drives computed in one call.
    """

    drives: int = 64
    updates: int = 36
    step: tuple[float, float] = (0.5, 0.5)
    headings: int = 48
    states: int = 300_000
    noise: LidarNoise = LidarNoise(sigma=0.03, dropout=0.01, short=0.05)
    temper: float = 0.05
    batch: int = 8

    def __post_init__(self) -> None:
        checks.count(self, "drives headings states batch")
        checks.count(self, "updates", 2)
        checks.positive(self, "temper")


class Tried(NamedTuple):
    """What came of D drives over T updates.

    Attributes:
        poses: (D, T, 3) in the map frame.
        metres: (D, T) driven since the start.
        truth: (D, T) belief at the truth.
        other: (D, T) belief at the heaviest place elsewhere, and ``other_pose`` (D, T, 3) of the base there.
    """

    poses: np.ndarray
    metres: np.ndarray
    truth: np.ndarray
    other: np.ndarray
    other_pose: np.ndarray

    def metres_until_found(self) -> np.ndarray:
        """(D,) metres driven until the belief is sure of the truth; infinite if it never is."""
        found = self.truth >= _SURE
        return np.where(found.any(1), self.metres[np.arange(len(found)), found.argmax(1)], np.inf)


def try_out(
    grid: OccupancyGrid,
    lidar: LidarConfig,
    config: AmbiguityConfig,
    seed: int,
    batches: Callable[[Sequence[int]], Iterable[int]] = iter,
) -> Tried:
    """Drive about and see what the belief makes of it; ``batches`` may show how far it has come."""
    poses = _plan(grid, config, seed)
    belief = _build(grid, lidar, config)
    tables = make_tables(grid, RaycastConfig("exact"), lidar.range_max)
    parts = []
    for start in batches(range(0, config.drives, config.batch)):
        # The last batch is filled up: another shape would be compiled anew.
        rows = np.minimum(np.arange(start, start + config.batch), config.drives - 1)
        keys = jax.vmap(lambda row: jax.random.fold_in(jax.random.key(seed), row))(jnp.asarray(rows))
        answer = _compiled()(belief, tables, jnp.asarray(poses[rows]), keys, lidar, config.noise)
        parts.append([np.asarray(part) for part in answer])
    truth, other, other_pose = (np.concatenate(part)[: config.drives] for part in zip(*parts, strict=True))
    moved = np.hypot(*np.moveaxis(np.diff(poses[..., :2], axis=1), -1, 0))
    metres = np.concatenate([np.zeros((len(poses), 1)), np.cumsum(moved, 1)], 1)
    return Tried(poses, metres, truth, other, other_pose)


def _build(grid: OccupancyGrid, lidar: LidarConfig, config: AmbiguityConfig) -> MarkovGrid:
    """The belief, on cells as fine as ``states`` allows."""
    resolution = max(0.2, grid.resolution)
    while resolution < 1 and int(resample_free(grid, resolution).free.sum()) * config.headings > config.states:
        resolution += max(0.05, grid.resolution)
    model = BeamModel(sigma_hit=max(0.15, resolution / 2), temper=config.temper, range_max=lidar.range_max)
    settings = LikelihoodGridConfig(resolution=resolution, headings=config.headings, beams=60, model=model)
    return MarkovGrid(likelihood_grid(grid, lidar, settings))


def _plan(grid: OccupancyGrid, config: AmbiguityConfig, seed: int) -> np.ndarray:
    """(D, T, 3) drives from places that are spread over the building, in the map frame."""
    network, rng = roads(grid), np.random.default_rng(seed)
    if len(network.cells) < 2:
        raise UserError("the map has a single free cell to drive on: there is nowhere to go")
    # Cells are listed row by row: equal steps along the list are spread over the building.
    starts = (np.arange(config.drives) + rng.uniform()) / config.drives * len(network.cells)
    drives = [drive(network, rng, int(start), config.updates, config.step) for start in starts]
    return np.asarray(grid.from_grid(jnp.asarray(np.stack(drives), jnp.float32)))


@cache
def _compiled() -> Any:
    """:func:`_follow`, compiled."""
    return jax.jit(_follow, static_argnums=(4, 5), compiler_options=run_options())


def _follow(
    belief: MarkovGrid, tables: Any, poses: Array, keys: Array, lidar: LidarConfig, noise: LidarNoise
) -> tuple[Array, Array, Array]:
    """For drives (D, T, 3): belief at the truth (D, T), at the heaviest other place (D, T), that place (D, T, 3)."""

    def one(inputs: tuple[Array, Array]) -> tuple[Array, Array, Array]:
        path, key = inputs
        k_scan, k_odometry = jax.random.split(key)
        ranges = observe(k_scan, cast_rays(tables, path, lidar), lidar, noise)
        before = jnp.concatenate([path[:1], path[:-1]])
        odometry = measure_odometry(k_odometry, before, path, DriveConfig().odometry)

        def update(memory: Array, now: tuple[Inputs, Array]) -> tuple[Array, tuple[Array, Array, Array]]:
            told, pose = now
            _, memory = belief.prepare(memory, told)
            return memory, _places(belief, memory, pose)

        told = Inputs(ranges, odometry, jnp.arange(len(path)))
        return jax.lax.scan(update, belief.begin(), (told, path))[1]

    return jax.lax.map(one, (poses, keys))


def _places(belief: MarkovGrid, mass: Array, pose: Array) -> tuple[Array, Array, Array]:
    """Belief (C, K) at the base pose (3,), and at the heaviest place elsewhere, and that place as a base pose."""
    likelihood = belief.likelihood
    grid, cells = likelihood.pose_grid, likelihood.cells
    mount = jnp.array([likelihood.lidar.mount[0], likelihood.lidar.mount[1], 0.0])
    # Cells that fill up lie behind the last row: far from everything.
    i, j = jnp.divmod(cells, grid.width)
    angle = max(_ANGLE, 1.5 * grid.turn)

    def near(at: tuple[Array, Array, Array]) -> Array:
        close = jnp.hypot(i - at[0], j - at[1]) * grid.resolution <= _POSITION
        gap = (jnp.arange(grid.headings) - at[2] + grid.headings / 2) % grid.headings - grid.headings / 2
        return close[:, None] & (jnp.abs(gap) * grid.turn <= angle)

    here = near(pg.pose_cell(grid, compose(pose, mount)))
    elsewhere = jnp.where(here, 0.0, mass)
    c, k = jnp.divmod(jnp.argmax(elsewhere), grid.headings)
    there = near((i[c].astype(jnp.float32), j[c].astype(jnp.float32), k.astype(jnp.float32)))
    sensor = pg.cell_pose(grid, i[c], j[c], k)
    return (jnp.where(here, mass, 0.0).sum(), jnp.where(there, elsewhere, 0.0).sum(), compose(sensor, -mount))


def look_alikes(tried: Tried, at_metres: float, least: float = 0.02, apart: float = 3.0, most: int = 12) -> list[Any]:
    """(drive, update) of the most stubborn pairs: places that still hold ``least`` of the belief after ``at_metres``.

    A pair with both ends within ``apart`` metres of a worse one, in either order, is not told again.
    """
    rows = []
    for d in range(len(tried.poses)):
        t = int(min(np.searchsorted(tried.metres[d], at_metres), tried.metres.shape[1] - 1))
        if tried.other[d, t] >= least:
            rows.append((log_odds(tried, d, t), d, t))
    chosen: list[Any] = []
    for _, d, t in sorted(rows):
        ends = tried.poses[d, t, :2], tried.other_pose[d, t, :2]
        if not any(_same(ends, (tried.poses[e, s, :2], tried.other_pose[e, s, :2]), apart) for e, s in chosen):
            chosen.append((d, t))
    return chosen[:most]


def log_odds(tried: Tried, d: int, t: int) -> float:
    """How much more the belief holds of the truth than of the other place, as a natural logarithm."""
    return float(np.log(max(tried.truth[d, t], 1e-9) / max(tried.other[d, t], 1e-9)))


def _same(one: tuple[np.ndarray, np.ndarray], two: tuple[np.ndarray, np.ndarray], apart: float) -> bool:
    def gap(a: np.ndarray, b: np.ndarray) -> float:
        return float(np.hypot(*(a - b)))

    return min(
        max(gap(one[0], two[0]), gap(one[1], two[1])), max(gap(one[0], two[1]), gap(one[1], two[0]))
    ) < apart  # fmt: skip
