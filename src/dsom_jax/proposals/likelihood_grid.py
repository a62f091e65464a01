"""The exact, tempered likelihood of a scan over the whole (x, y, theta) grid: a proposal without any training."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from dsom_jax import pose_grid as pg
from dsom_jax.geometry import compose
from dsom_jax.lidar import LidarConfig
from dsom_jax.occupancy import OccupancyGrid, pad
from dsom_jax.raycast import MapTables, RaycastConfig, cast_rays, make_tables
from dsom_jax.sensor import BeamModel, beam_log_terms
from dsom_jax.types import Array, Inputs, Key

_LEVELS = 1024
_BLOCK = 4096  # cells are counted in blocks, so that maps of like size share one compilation


@dataclass(frozen=True)
class LikelihoodGridConfig:
    """Resolution of the grid and of the evidence.

    Attributes:
        resolution: metres per cell; the map's own if smaller ones are asked for.
        headings: K.
        angles_per_heading: directions of the range table per heading bin.
        beams: beams used, spread evenly over the scan.
        raycast: how expected ranges are obtained.
        model: sensor model; its ``sigma_hit`` has to cover half a cell.
    """

    resolution: float = 0.2
    headings: int = 64
    angles_per_heading: int = 4
    beams: int = 120
    raycast: RaycastConfig = RaycastConfig("exact")
    model: BeamModel = field(default_factory=lambda: BeamModel(sigma_hit=0.15, temper=0.5))


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class LikelihoodGrid:
    """Expected ranges from every free cell, and how a scan is held against them.

    PM lives on cells of the *sensor's* position, so that a mounting offset costs nothing; samples are base poses.

    Attributes:
        pose_grid: (H, W, K) cells.
        free: (H, W) bool, cells with free space in them.
        cells: (C,) int32 flat indices of those cells; H * W where there are fewer.
        expected: (A, C) uint16 expected ranges in 1023rds of ``model.range_max``, 1023 = no return.
        lidar: geometry of the whole scan (static).
        config: static.
    """

    pose_grid: pg.PoseGrid
    free: Array
    cells: Array
    expected: Array
    lidar: LidarConfig = field(metadata={"static": True})
    config: LikelihoodGridConfig = field(metadata={"static": True})

    def prepare(self, inputs: Inputs) -> pg.ProbabilityMap:
        """PM of one scan (B,): softmax of the tempered log-likelihood over all free cells."""
        return self.probability_map(self.log_likelihood(inputs.ranges))

    def probability_map(self, log_mass: Array) -> pg.ProbabilityMap:
        """PM of unnormalised logarithms (C, K) at the free cells."""
        full = jnp.full((self.free.size, self.config.headings), -jnp.inf).at[self.cells].set(log_mass, mode="drop")
        return pg.from_log(self.pose_grid, full.reshape(self.pose_grid.shape), self.free)

    def log_likelihood(self, ranges: Array) -> Array:
        """(C, K) tempered log p(z | x) at the free cells."""
        picked = beam_choice(self.lidar.beams, self.config.beams)
        table = _term_table(ranges[picked], self.config.model)
        columns = _columns(self.lidar.angles()[picked], self.config)
        return self.config.model.temper * _sum_terms(self.expected, table, columns)

    def sample(self, key: Key, prepared: pg.ProbabilityMap, n: int) -> tuple[Array, Array]:
        """``n`` base poses (n, 3) from PM and their log densities."""
        poses, log_density = pg.sample(key, prepared, n)
        x, y, _ = self.lidar.mount
        return compose(poses, jnp.array([-x, -y, 0.0])), log_density


def likelihood_grid(grid: OccupancyGrid, lidar: LidarConfig, config: LikelihoodGridConfig) -> LikelihoodGrid:
    """Proposal for a map; casts C * A exact rays once."""
    coarse = resample_free(grid, config.resolution)
    pose_grid = pg.over(coarse, config.headings)
    count = -(-int(coarse.free.sum()) // _BLOCK) * _BLOCK
    cells = jnp.flatnonzero(coarse.free, size=count, fill_value=coarse.free.size).astype(jnp.int32)
    tables = make_tables(grid, config.raycast, config.model.range_max)
    angles = config.headings * config.angles_per_heading
    expected = _expected(tables, _viewpoints(grid, coarse, cells), angles, config.model.range_max)
    return LikelihoodGrid(pose_grid, coarse.free, cells, expected, lidar, config)


@partial(jax.jit, static_argnames="resolution")
def resample_free(grid: OccupancyGrid, resolution: float) -> OccupancyGrid:
    """Coarser cells that are free where *any* of their old cells is; no finer than the map itself."""
    factor = max(1, round(resolution / grid.resolution))
    rows, cols = (-(-n // factor) for n in grid.shape)
    padded = pad(grid, (rows * factor, cols * factor))
    free = padded.free.reshape(rows, factor, cols, factor).any((1, 3))
    return OccupancyGrid(~free, free, grid.origin, grid.resolution * factor)


@jax.jit
def _viewpoints(grid: OccupancyGrid, coarse: OccupancyGrid, cells: Array) -> Array:
    """(C, 2) metres in the grid's frame: centre of the free old cell nearest to the centre of each new cell."""
    factor = round(coarse.resolution / grid.resolution)
    rows, cols = coarse.shape
    free = pad(grid, (rows * factor, cols * factor)).free
    blocks = free.reshape(rows, factor, cols, factor).swapaxes(1, 2).reshape(rows * cols, factor, factor)
    offset = jnp.arange(factor) - (factor - 1) / 2
    far = jnp.where(blocks[cells], offset[:, None] ** 2 + offset**2, jnp.inf).reshape(len(cells), -1)
    best = jnp.argmin(far, -1)
    j = (cells % cols) * factor + best % factor
    i = (cells // cols) * factor + best // factor
    return (jnp.stack([j, i], -1) + 0.5) * grid.resolution


@partial(jax.jit, static_argnames=("angles", "range_max"))
def _expected(tables: MapTables, points: Array, angles: int, range_max: float) -> Array:
    """(A, C) uint16 ranges from ``points`` (C, 2) at A directions from -pi on, in the grid's frame."""
    ray = LidarConfig(beams=1, angle_min=0.0, range_max=range_max)
    step = (_LEVELS - 1) / range_max

    def along(heading: Array) -> Array:
        local = jnp.concatenate([points, jnp.broadcast_to(heading, (len(points), 1))], -1)
        ranges = cast_rays(tables, tables.grid.from_grid(local), ray)[:, 0]
        return jnp.round(jnp.minimum(ranges * step, _LEVELS - 1)).astype(jnp.uint16)

    return jax.lax.map(along, jnp.arange(angles) * (2 * jnp.pi / angles) - jnp.pi)


def beam_choice(beams: int, wanted: int) -> np.ndarray:
    """Indices of at most ``wanted`` evenly spaced beams."""
    return np.unique(np.linspace(0, beams - 1, min(wanted, beams)).round().astype(int))


def _columns(bearings: np.ndarray, config: LikelihoodGridConfig) -> Array:
    """(b, K) row of ``expected`` that beam b of heading theta_k looks along."""
    angles = config.headings * config.angles_per_heading
    turned = np.round(bearings / (2 * np.pi) * angles).astype(int)[:, None]
    return jnp.asarray((np.arange(config.headings) * config.angles_per_heading + turned) % angles)


def _term_table(ranges: Array, model: BeamModel) -> Array:
    """(b, 1024) log-likelihood of each reading for each level of expected range, the last one no return."""
    levels = jnp.arange(_LEVELS - 1) * (model.range_max / (_LEVELS - 1))
    return beam_log_terms(ranges[:, None], jnp.append(levels, jnp.inf), model)


def _sum_terms(expected: Array, table: Array, columns: Array) -> Array:
    """(C, K) sum over beams b of ``table[b, expected[columns[b, k]]]``."""

    def add(total: Array, beam: tuple[Array, Array]) -> tuple[Array, None]:
        terms, wanted = beam
        return total + terms.at[expected[wanted]].get(mode="promise_in_bounds"), None

    start = jnp.zeros((columns.shape[1], expected.shape[1]))
    return jax.lax.scan(add, start, (table, columns))[0].T
