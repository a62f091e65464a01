"""The exact, tempered likelihood of a scan over the whole (x, y, theta) grid: a proposal without any training."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from dsom_jax import checks
from dsom_jax import pose_grid as pg
from dsom_jax.geometry import compose, wrap_angle
from dsom_jax.lidar import LidarConfig
from dsom_jax.occupancy import OccupancyGrid, pad
from dsom_jax.raycast import MapTables, RaycastConfig, cast_rays, make_tables
from dsom_jax.resampling import pick_in_rows
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
    model: BeamModel = BeamModel(sigma_hit=0.15, temper=0.5)

    def __post_init__(self) -> None:
        checks.positive(self, "resolution")
        checks.count(self, "headings angles_per_heading beams")


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class LikelihoodGrid:
    """Expected ranges from every free cell, and how a scan is held against them.

    PM lives on cells of the *sensor's* position, so that a mounting offset costs nothing; samples are base poses.
    A cell may cover several cells of the map, not all of them free: its mass counts the free ones, and samples lie on
    those alone. With a mounting offset that holds for the sensor; the base beside it may stand where it cannot.

    Attributes:
        pose_grid: (H, W, K) cells.
        free: (H, W) bool, cells with free space in them.
        parts: (H * W, F * F) uint16 running count of the free ones among the map's cells in each cell.
        cells: (C,) int32 flat indices of the free cells; H * W where there are fewer.
        expected: (A, C) uint16 expected ranges in 1023rds of ``model.range_max``, 1023 = no return.
        lidar: geometry of the whole scan (static).
        config: static.
    """

    pose_grid: pg.PoseGrid
    free: Array
    parts: Array
    cells: Array
    expected: Array
    lidar: LidarConfig = field(metadata={"static": True})
    config: LikelihoodGridConfig = field(metadata={"static": True})

    def begin(self) -> tuple[()]:
        """No memory: each scan is taken on its own."""
        return ()

    def prepare(self, memory: tuple[()], inputs: Inputs) -> tuple[pg.ProbabilityMap, tuple[()]]:
        """PM of one scan (B,): the tempered likelihood, normalised over free space."""
        return self.probability_map(self.log_likelihood(inputs.ranges)), memory

    def probability_map(self, log_mass: Array) -> pg.ProbabilityMap:
        """PM of unnormalised log densities (C, K) at the free cells."""
        log_mass += jnp.log(self.parts[self.cells, -1] / self.parts.shape[1])[:, None]
        full = jnp.full((self.free.size, self.config.headings), -jnp.inf).at[self.cells].set(log_mass, mode="drop")
        return pg.from_log(self.pose_grid, full.reshape(self.pose_grid.shape), self.free)

    def tempered(self, temper: float) -> LikelihoodGrid:
        """The same grid with another factor on its log-likelihood."""
        return replace(self, config=replace(self.config, model=replace(self.config.model, temper=temper)))

    def log_likelihood(self, ranges: Array) -> Array:
        """(C, K) tempered log p(z | x) at the free cells."""
        return self.config.model.temper * self.evidence(ranges, self.config.beams)

    def evidence(self, ranges: Array, beams: int, rows: Array | None = None) -> Array:
        """(n, K) log p(z | x), not tempered, of ``beams`` beams of a scan (B,), at all free cells or ``rows`` (n,)."""
        picked = beam_choice(self.lidar.beams, beams)
        expected = self.expected if rows is None else self.expected.at[:, rows].get(mode="clip")
        table = _term_table(ranges[picked], self.config.model)
        return _sum_terms(expected, table, _columns(self.lidar.angles()[picked], self.config))

    def sample(self, key: Key, prepared: pg.ProbabilityMap, n: int) -> tuple[Array, Array]:
        """``n`` base poses (n, 3) from PM, uniform within the free space of a cell, and their log densities."""
        u = jax.random.uniform(key, (5, n))
        cell, k = pg.pick_cells(prepared, u[:2])
        return self.poses_in(cell, k, u[2:]), self._log_density(prepared, cell, k)

    def poses_in(self, cell: Array, k: Array, u: Array) -> Array:
        """Base poses (n, 3) in the free space of cells (flat (i, j), k) (n,), by ``u`` (3, n) in [0, 1)."""
        # One number chooses the free part, and what is left of it the place in there.
        part = pick_in_rows(self.parts, cell, u[0])
        along = (u[0] * self.parts[cell, -1]) % 1.0
        side = self.map_cells.height // self.pose_grid.height
        i, j = (v * side + w for v, w in zip(divmod(cell, self.pose_grid.width), divmod(part, side), strict=True))
        poses = pg.cell_pose(self.map_cells, i + along - 0.5, j + u[1] - 0.5, k + u[2] - 0.5)
        x, y, _ = self.lidar.mount
        return compose(poses, jnp.array([-x, -y, 0.0]))

    def log_volume(self, cell: Array) -> Array:
        """Logarithm of the free volume (...) of one heading of cells (flat), in m^2 rad."""
        parts = self.parts.at[cell, -1].get(mode="clip").astype(jnp.float32)
        return jnp.log(parts) + self.map_cells.log_cell_volume

    def around(self, pose: Array, covariance: Array) -> Array:
        """(C, K) mass of sum one at the free cells, Gaussian about a base pose (3,); no narrower than a cell."""
        grid, (x, y, _) = self.pose_grid, self.lidar.mount
        i, j = jnp.divmod(self.cells, grid.width)
        cells = pg.cell_pose(grid, *jnp.broadcast_arrays(i[:, None], j[:, None], jnp.arange(grid.headings)))
        # Cells are those of the sensor.
        off = cells - compose(pose, jnp.array([x, y, 0.0]))
        off = off.at[..., 2].set(wrap_angle(off[..., 2]))
        floor = jnp.array([grid.resolution, grid.resolution, grid.turn]) ** 2 / 4
        precision = jnp.linalg.inv(covariance + jnp.diag(floor))
        real = (self.cells < self.free.size)[:, None]
        log_mass = jnp.where(real, -0.5 * jnp.einsum("cka,ab,ckb->ck", off, precision, off), -jnp.inf)
        mass = pg.exp_or_zero(log_mass - log_mass.max())
        return mass / mass.sum()

    def log_density(self, prepared: pg.ProbabilityMap, poses: Array) -> Array:
        """Log density (...) of :meth:`sample` at base poses (..., 3) in 1 / (m^2 rad); -inf off free space."""
        x, y, _ = self.lidar.mount
        i, j, k, on_grid = pg.nearest_cell(self.map_cells, compose(poses, jnp.array([x, y, 0.0])))
        side = self.map_cells.height // self.pose_grid.height
        cell = jnp.where(on_grid, i // side * self.pose_grid.width + j // side, 0)
        part = i % side * side + j % side
        before = jnp.where(part > 0, self.parts[cell, part - 1], 0)
        free = on_grid & (self.parts[cell, part] > before)
        return jnp.where(free, self._log_density(prepared, cell, k), -jnp.inf)

    def _log_density(self, prepared: pg.ProbabilityMap, cell: Array, k: Array) -> Array:
        """Log density on the free parts of cells (flat (i, j), k)."""
        return pg.log_share(prepared, cell, k) - self.log_volume(cell)

    @property
    def map_cells(self) -> pg.PoseGrid:
        """The cells of PM divided into those of the map."""
        side, grid = math.isqrt(self.parts.shape[1]), self.pose_grid
        return replace(grid, height=grid.height * side, width=grid.width * side, resolution=grid.resolution / side)


def likelihood_grid(grid: OccupancyGrid, lidar: LidarConfig, config: LikelihoodGridConfig) -> LikelihoodGrid:
    """Proposal for a map; casts C * A exact rays once."""
    coarse = resample_free(grid, config.resolution)
    pose_grid = pg.over(coarse, config.headings)
    count = -(-int(coarse.free.sum()) // _BLOCK) * _BLOCK
    cells = jnp.flatnonzero(coarse.free, size=count, fill_value=coarse.free.size).astype(jnp.int32)
    tables = make_tables(grid, config.raycast, config.model.range_max)
    angles = config.headings * config.angles_per_heading
    blocks = free_blocks(grid, coarse)
    expected = _expected(tables, _viewpoints(grid, coarse, blocks, cells), angles, config.model.range_max)
    parts = jnp.cumsum(blocks.reshape(len(blocks), -1), -1, dtype=jnp.uint16)
    return LikelihoodGrid(pose_grid, coarse.free, parts, cells, expected, lidar, config)


@partial(jax.jit, static_argnames="resolution")
def resample_free(grid: OccupancyGrid, resolution: float) -> OccupancyGrid:
    """Coarser cells that are free where *any* of their old cells is; no finer than the map itself."""
    factor = max(1, round(resolution / grid.resolution))
    rows, cols = (-(-n // factor) for n in grid.shape)
    padded = pad(grid, (rows * factor, cols * factor))
    free = padded.free.reshape(rows, factor, cols, factor).any((1, 3))
    return OccupancyGrid(~free, free, grid.origin, grid.resolution * factor)


@jax.jit
def free_blocks(grid: OccupancyGrid, coarse: OccupancyGrid) -> Array:
    """(H * W, F, F) bool, the free ones among the F x F old cells in each new cell."""
    factor = round(coarse.resolution / grid.resolution)
    rows, cols = coarse.shape
    free = pad(grid, (rows * factor, cols * factor)).free
    return free.reshape(rows, factor, cols, factor).swapaxes(1, 2).reshape(rows * cols, factor, factor)


@jax.jit
def _viewpoints(grid: OccupancyGrid, coarse: OccupancyGrid, blocks: Array, cells: Array) -> Array:
    """(C, 2) metres in the grid's frame: the centre of each new cell, or of the free old cell that is nearest to it.

    Off the centre only where it must be: a viewpoint that always lies to one side of it makes places unequal that are.
    """
    factor, cols = blocks.shape[1], coarse.shape[1]
    offset = jnp.arange(factor) - (factor - 1) / 2
    inside = blocks[cells]
    far = jnp.where(inside, offset[:, None] ** 2 + offset**2, jnp.inf).reshape(len(cells), -1)
    best = jnp.argmin(far, -1)
    i, j = jnp.divmod(cells, cols)
    middle = jnp.stack([j, i], -1) * factor + factor / 2
    nearest = jnp.stack([j * factor + best % factor, i * factor + best // factor], -1) + 0.5
    return jnp.where(inside.all((1, 2))[:, None], middle, nearest) * grid.resolution


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
