"""How the true world differs from the map: unknown obstacles put in, known structure removed. Pure, jittable."""

from __future__ import annotations

import math
from dataclasses import replace

import jax
import jax.numpy as jnp

from dsom_jax.occupancy import OccupancyGrid
from dsom_jax.resampling import draw_ancestors
from dsom_jax.simulate.morphology import clear_of
from dsom_jax.types import Array, Key

SIZES = (0.3, 1.0)
"""Smallest and largest side or diameter of an obstacle, metres."""

REMOVED_SIZES = (0.7, 2.5)
"""Smallest and largest side of a piece of structure that is removed, metres."""


def add_obstacles(
    key: Key,
    grid: OccupancyGrid,
    count: Array | int,
    *,
    max_count: int | None = None,
    sizes: tuple[float, float] = SIZES,
    where: Array | None = None,
    keep: Array | None = None,
) -> OccupancyGrid:
    """The map with ``count`` boxes and discs on it; ``free`` loses their cells and those that share an edge with them.

    ``count`` may be traced if ``max_count`` bounds it. ``where`` (H, W): cells that their centres are drawn from,
    default ``grid.free``. ``keep`` (H, W): cells that no obstacle covers. At least one cell is covered by each.
    """
    cells = grid.free if where is None else where
    number = _bound(count, max_count)
    covered = _draw_shapes(key, cells, jnp.arange(number) < count, sizes, grid.resolution)
    covered &= ~grid.occupied if keep is None else ~(grid.occupied | keep)
    return replace(grid, occupied=grid.occupied | covered, free=grid.free & clear_of(covered))


def remove_structure(
    key: Key,
    grid: OccupancyGrid,
    count: Array | int,
    *,
    max_count: int | None = None,
    sizes: tuple[float, float] = REMOVED_SIZES,
    where: Array | None = None,
) -> OccupancyGrid:
    """The map without ``count`` pieces of its walls and furniture, each as large as a box or disc.

    ``where`` (H, W): occupied cells that the centres are drawn from, default all. What is removed lets rays pass, but
    does not become free: the map does not say what lies there.
    """
    cells = grid.occupied if where is None else grid.occupied & where
    number = _bound(count, max_count)
    gone = _draw_shapes(key, cells, jnp.arange(number) < count, sizes, grid.resolution)
    return replace(grid, occupied=grid.occupied & ~gone)


def _bound(count: Array | int, max_count: int | None) -> int:
    if max_count is None and isinstance(count, jax.core.Tracer):
        raise ValueError("count is traced: give max_count, its static bound")
    return int(count) if max_count is None else max_count


def _draw_shapes(key: Key, cells: Array, present: Array, sizes: tuple[float, float], resolution: float) -> Array:
    """(H, W) bool, union of boxes and discs of ``sizes`` metres around random ``cells``, where ``present`` (n,)."""
    sizes = sizes[0] / resolution, sizes[1] / resolution
    if not len(present):
        return jnp.zeros(cells.shape, bool)
    k_cell, k_shape = jax.random.split(key)
    flat = draw_ancestors(k_cell, cells.ravel().astype(jnp.float32), len(present), "multinomial")
    i, j = flat // cells.shape[1], flat % cells.shape[1]
    reach = math.ceil(sizes[1] * math.sqrt(0.5)) + 1
    steps = jnp.arange(-reach, reach + 1)
    inside = _shapes(jax.random.uniform(k_shape, (6, len(present), 1, 1)), steps, sizes)
    inside &= (present & cells.any())[:, None, None]
    rows, columns = jnp.broadcast_arrays((i[:, None] + steps)[:, :, None], (j[:, None] + steps)[:, None, :])
    rows = jnp.where(inside & (rows >= 0) & (columns >= 0), rows, cells.shape[0])
    return jnp.zeros(cells.shape, bool).at[rows, columns].set(True, mode="drop")


def _shapes(r: Array, steps: Array, sizes: tuple[float, float]) -> Array:
    """(n, m, m) bool, cells of n boxes (turned) and discs, from draws ``r`` (6, n, 1, 1).

    ``steps`` (m,): cells from the middle cell, which is always covered.
    """
    a, b = (sizes[0] + (sizes[1] - sizes[0]) * r[:2]) / 2
    y, x = steps[:, None] + r[2] - 0.5, steps + r[3] - 0.5
    c, s = jnp.cos(jnp.pi * r[4]), jnp.sin(jnp.pi * r[4])
    box = (jnp.abs(c * x + s * y) < a) & (jnp.abs(c * y - s * x) < b)
    disc = x**2 + y**2 < a**2
    middle = (steps == 0)[:, None] & (steps == 0)
    return jnp.where(r[5] < 0.5, box, disc) | middle
