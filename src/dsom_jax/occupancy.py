"""The known map as a grid: where rays stop, where the robot may stand, and how cells and metres relate."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import jax
import jax.numpy as jnp
import numpy as np

from dsom_jax.geometry import compose, relative
from dsom_jax.types import Array

_ROUNDING = 1e-6  # cells; edges of old and new cells closer than this are the same edge


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class OccupancyGrid:
    """Map of a building; ``cells[i, j]`` has i along y and j along x, row 0 at the bottom.

    Attributes:
        occupied: (H, W) bool, cells that stop a ray.
        free: (H, W) bool, cells on which the robot may stand. Unknown cells are neither.
        origin: (3,) pose of the lower-left corner of cell (0, 0) in the map frame (m, m, rad).
        resolution: metres per cell (static).
    """

    occupied: Array
    free: Array
    origin: Array
    resolution: float = field(metadata={"static": True})

    @property
    def shape(self) -> tuple[int, int]:
        """(H, W) in cells."""
        return self.occupied.shape[0], self.occupied.shape[1]

    @property
    def size(self) -> tuple[float, float]:
        """Extent (x, y) of the grid in metres."""
        return self.shape[1] * self.resolution, self.shape[0] * self.resolution

    def to_grid(self, poses: Array) -> Array:
        """Map-frame poses (..., 3) in the grid's own frame: metres from its lower-left corner."""
        return relative(self.origin, poses)

    def from_grid(self, poses: Array) -> Array:
        """Poses (..., 3) of the grid's own frame in the map frame."""
        return compose(self.origin, poses)


def from_cells(
    occupied: Array,
    free: Array | None = None,
    *,
    resolution: float,
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> OccupancyGrid:
    """Grid of boolean arrays (H, W); without ``free`` every cell that is not occupied is free."""
    occupied = jnp.asarray(occupied, bool)
    free = ~occupied if free is None else jnp.asarray(free, bool) & ~occupied
    return OccupancyGrid(occupied, free, jnp.asarray(origin, jnp.float32), float(resolution))


def cell_index(grid: OccupancyGrid, poses: Array) -> tuple[Array, Array]:
    """Cells (i, j) of map-frame poses (..., 3); outside of the grid, and for NaN, they lie outside of its shape."""
    cells = jnp.floor(grid.to_grid(poses)[..., :2] / grid.resolution)
    cells = jnp.where(jnp.isnan(cells), -1, cells).astype(jnp.int32)
    return cells[..., 1], cells[..., 0]


def inside(shape: tuple[int, ...], i: Array, j: Array) -> Array:
    """Whether cells (i, j) lie in a grid of ``shape``."""
    return (i >= 0) & (i < shape[0]) & (j >= 0) & (j < shape[1])


def lookup(cells: Array, i: Array, j: Array, outside: bool | int | float) -> Array:
    """``cells[i, j]`` with a value for what lies outside."""
    values = cells[jnp.clip(i, 0, cells.shape[0] - 1), jnp.clip(j, 0, cells.shape[1] - 1)]
    return jnp.where(inside(cells.shape, i, j), values, outside)


def is_free(grid: OccupancyGrid, poses: Array) -> Array:
    """(...) bool, whether the robot may stand at map-frame poses (..., 3)."""
    return lookup(grid.free, *cell_index(grid, poses), outside=False)


def pad(grid: OccupancyGrid, shape: tuple[int, int]) -> OccupancyGrid:
    """The grid grown to ``shape`` at its upper and right edges by cells that are neither free nor occupied."""
    extra = [(0, shape[0] - grid.shape[0]), (0, shape[1] - grid.shape[1])]
    return replace(grid, occupied=jnp.pad(grid.occupied, extra), free=jnp.pad(grid.free, extra))


def resample(grid: OccupancyGrid, resolution: float) -> OccupancyGrid:
    """The same map at other cells: occupied where any old cell touched is, so that thin walls survive.

    A new cell is free if the old cell at its centre was free and no occupied cell touches it.
    """
    ratio = resolution / grid.resolution
    rows, cols = (max(1, math.ceil(n / ratio - _ROUNDING)) for n in grid.shape)
    occupied = _any_in_window(grid.occupied, rows, ratio, axis=0)
    occupied = _any_in_window(occupied, cols, ratio, axis=1)
    i, j = np.ix_(_centres(rows, ratio, grid.shape[0]), _centres(cols, ratio, grid.shape[1]))
    return OccupancyGrid(occupied, grid.free[i, j] & ~occupied, grid.origin, float(resolution))


def _centres(n: int, ratio: float, old: int) -> np.ndarray:
    return np.minimum(np.floor((np.arange(n) + 0.5) * ratio + _ROUNDING).astype(int), old - 1)


def _any_in_window(cells: Array, n: int, ratio: float, axis: int) -> Array:
    """``n`` windows of ``ratio`` old cells along ``axis``, true where any cell in the window is."""
    cells = jnp.moveaxis(cells, axis, 0)
    old = cells.shape[0]
    counts = jnp.concatenate([jnp.zeros((1, *cells.shape[1:]), jnp.int32), jnp.cumsum(cells, 0, dtype=jnp.int32)])
    start = np.floor(np.arange(n) * ratio + _ROUNDING).astype(int)
    stop = np.maximum(np.ceil(np.arange(1, n + 1) * ratio - _ROUNDING).astype(int), start + 1)
    hit = counts[np.clip(stop, 0, old)] > counts[np.clip(start, 0, old)]
    return jnp.moveaxis(hit, 0, axis)


def dilate(cells: Array, steps: int = 1) -> Array:
    """Boolean cells (..., H, W) grown by ``steps`` in the eight directions."""
    for axis in (-2, -1):
        width = [(0, 0)] * (cells.ndim - 1)
        width.insert(cells.ndim + axis, (steps, steps))
        padded, n = jnp.pad(cells, width), cells.shape[axis]
        cells = padded[..., :n, :] if axis == -2 else padded[..., :n]
        for k in range(1, 2 * steps + 1):
            cells |= jax.lax.slice_in_dim(padded, k, k + n, axis=axis)
    return cells


def euclidean_distance(occupied: Array, cap: int) -> Array:
    """(H, W) float32 distance in cells between cell centres to the nearest occupied one, at most ``cap``.

    Exact: distances along rows first, then the lower envelope over at most ``cap`` rows on either side.
    """
    height, width = occupied.shape
    far = jnp.float32(cap)
    columns = jnp.arange(width, dtype=jnp.float32)
    before = jax.lax.cummax(jnp.where(occupied, columns, -jnp.inf), axis=1)
    after = jax.lax.cummin(jnp.where(occupied, columns, jnp.inf), axis=1, reverse=True)
    row = jnp.minimum(jnp.minimum(columns - before, after - columns), far) ** 2
    padded = jnp.pad(row, ((cap, cap), (0, 0)), constant_values=float(cap) ** 2)

    def lower(best: Array, shift: Array) -> tuple[Array, None]:
        other = jax.lax.dynamic_slice(padded, (shift, jnp.int32(0)), (height, width))
        return jnp.minimum(best, other + (shift - cap).astype(jnp.float32) ** 2), None

    squared, _ = jax.lax.scan(lower, jnp.full((height, width), far**2), jnp.arange(2 * cap + 1))
    return jnp.minimum(jnp.sqrt(squared), far)
