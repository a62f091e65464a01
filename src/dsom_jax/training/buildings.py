"""Where scans are taken: procedural buildings, crops of given maps, or some of both, drawn on the device."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp

from dsom_jax.occupancy import OccupancyGrid, is_free, resample
from dsom_jax.simulate.worlds import WorldConfig, make_world
from dsom_jax.types import Array, Key

_T = TypeVar("_T")


class Building(NamedTuple):
    """What the map shows and what a lidar sees; free space of ``seen`` is part of that of ``shown``.

    Attributes:
        shown: the map at the network's scale.
        seen: the world, in cells of its own.
        given: the map in the cells of ``seen`` where these are finer, else None; what a network's views are cast in.
    """

    shown: OccupancyGrid
    seen: OccupancyGrid
    given: OccupancyGrid | None = None


WorldSource = Callable[[Key], Building]
"""Draws a building; :func:`procedural_source`, :func:`crop_source` or :func:`mixed_source`."""


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


def procedural_source(world: WorldConfig, bare: float) -> WorldSource:
    """Procedural buildings; with probability ``bare`` the map lacks all that is not a wall."""
    empty = replace(world, furniture=0.0, pillars=0.0, shelves=0.0)

    def draw(key: Key) -> Building:
        k_world, k_bare = jax.random.split(key)
        seen = make_world(k_world, world)
        if not bare:
            return Building(seen, seen)
        return Building(_choose(jax.random.uniform(k_bare) < bare, make_world(k_world, empty), seen), seen)

    return draw


def mixed_source(first: WorldSource, second: WorldSource, share: float) -> WorldSource:
    """``first`` with probability ``share``, else ``second``."""

    def draw(key: Key) -> Building:
        k_which, k_first, k_second = jax.random.split(key, 3)
        return _choose(jax.random.uniform(k_which) < share, first(k_first), second(k_second))

    return draw


def _choose(condition: Array, first: _T, second: _T) -> _T:
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


def crop_source(pool: MapPool, cells: int, resolution: float, fine: float | None = None) -> WorldSource:
    """Random square crops of given maps around a free cell, turned by quarters and mirrored at random.

    Args:
        pool: the maps.
        cells: side of a crop at the network's scale.
        resolution: metres per cell of that scale.
        fine: metres per cell of the maps, if they are finer. Scans are then cast in them, as walls of the map that is
            shown are up to a cell thicker and its gaps narrower.
    """
    own = fine or resolution
    side = cells if fine is None else crop_side(cells, resolution, fine)

    def draw(key: Key) -> Building:
        k_map, k_cell, k_turn = jax.random.split(key, 3)
        number = jax.random.randint(k_map, (), 0, pool.free.shape[0])
        occupied, free = pool.occupied[number], pool.free[number]
        x, y = random_poses(k_cell, free, 1.0, 1)[0, :2].astype(jnp.int32)
        corner = [jnp.clip(c - side // 2, 0, n - side) for c, n in zip((y, x), free.shape, strict=True)]
        turn = jax.random.randint(k_turn, (), 0, 8)
        occupied, free = (turned_square(jax.lax.dynamic_slice(a, corner, (side, side)), turn) for a in (occupied, free))
        grid = OccupancyGrid(occupied, free, jnp.zeros(3), own)
        return Building(grid, grid) if fine is None else with_fine(grid, resolution)

    return draw


def crop_side(cells: int, resolution: float, fine: float) -> int:
    """Cells of ``fine`` metres along a crop that becomes ``cells`` cells when it is resampled to ``resolution``."""
    return math.floor(cells * resolution / fine + 1e-6)


def with_fine(grid: OccupancyGrid, resolution: float) -> Building:
    """A fine map, shown at ``resolution``; poses stand where both are free."""
    shown = resample(grid, resolution)
    return Building(shown, replace(grid, free=grid.free & is_free(shown, centres(grid))), grid)


def centres(grid: OccupancyGrid) -> Array:
    """(H, W, 3) map-frame poses in the middle of the cells."""
    y, x = jnp.meshgrid(*((jnp.arange(n) + 0.5) * grid.resolution for n in grid.shape), indexing="ij")
    return grid.from_grid(jnp.stack([x, y, jnp.zeros_like(x)], axis=-1))


def turned_square(square: Array, turn: Array) -> Array:
    """One of the eight symmetries of a square array (n, n)."""
    square = jnp.where(turn & 1, square[::-1], square)
    square = jnp.where(turn & 2, square[:, ::-1], square)
    return jnp.where(turn & 4, square.T, square)
