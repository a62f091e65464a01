"""Ray casting on an occupancy grid: exact by empty-square skipping, or looked up in a precomputed table.

Accuracy and speed of both are measured by ``experiments/perf/raycast.py``; the worst case of the table is at the
edges of obstacles, where the ray from the pose and the one from the nearest viewpoint meet different walls.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import partial
from typing import Literal

import jax
import jax.numpy as jnp

from dsom_jax import checks
from dsom_jax.errors import UserError
from dsom_jax.geometry import compose
from dsom_jax.lidar import LidarConfig
from dsom_jax.marching import direction_of, empty_squares, empty_wedges, flat_index, march, take
from dsom_jax.occupancy import OccupancyGrid, inside
from dsom_jax.types import Array

_MOST = 2**26
"""Bytes of wedges."""


@dataclass(frozen=True)
class RaycastConfig:
    """How expected ranges are obtained.

    Attributes:
        method: ``exact`` marches every ray; ``table`` looks up the wall that the ray from the nearest viewpoint, at
            the nearest of ``angles`` directions, would meet, and intersects the actual ray with that wall.
        angles: directions of the table.
        viewpoints: of the table, per side of a cell; time and memory of the table grow with their square. 1 is the
            centre of the cell.
        max_skip: side of the largest empty square stored, or length of the longest empty wedge, cells.
        wedges: an octant's sectors, for each of which rays know how far it is empty ahead; 0 for squares, which are
            made sooner, but take rays twice as many leaps. No more than 64 MB hold, at least 1.
        surface: how deep in an occupied cell the beam is returned, cells. 0 for worlds whose cells are solid; 0.5 for
            maps made from scans, whose end points lie anywhere in the cells that they fill.
    """

    method: Literal["exact", "table"] = "exact"
    angles: int = 360
    max_skip: int = 63
    wedges: int = 0
    surface: float = 0.0
    viewpoints: int = 1

    def __post_init__(self) -> None:
        checks.choice(self, "method", ("exact", "table"))
        checks.count(self, "angles", 4)
        checks.count(self, "max_skip viewpoints")
        checks.within(self, "max_skip", 1, 255, "give 1 to 255 cells")
        checks.count(self, "wedges", 0)
        checks.not_negative(self, "surface")


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class MapTables:
    """A map with what ray casting precomputes of it.

    Attributes:
        grid: the map.
        empty: uint8 of :func:`dsom_jax.marching.empty_squares`, (4, H + 2, W + 2), or
            :func:`dsom_jax.marching.empty_wedges`, (8 S, H + 2, W + 2); the map has a border of one occupied cell.
        walls: (V H, V W, A) int16 or None, first wall from each of V x V viewpoints in a cell: 2 * coordinate + axis,
            -1 for none, -2 on occupied cells.
        range_max: metres up to which ``walls`` was computed (static).
        surface: metres added to the distance of the near edge of an occupied cell (static).
    """

    grid: OccupancyGrid
    empty: Array
    walls: Array | None
    range_max: float = field(metadata={"static": True})
    surface: float = field(metadata={"static": True})


@partial(jax.jit, static_argnames=("config", "range_max"))
def make_tables(grid: OccupancyGrid, config: RaycastConfig, range_max: float) -> MapTables:
    """Tables for :func:`cast_rays` up to ``range_max`` metres.

    Raises:
        UserError: the map is too large for ``table``, whose entries are counted in int32 and name walls in int16.
    """
    entries = grid.occupied.size * config.viewpoints**2 * config.angles
    if config.method == "table" and (entries >= 2**31 or max(grid.shape) >= 2**14):
        cells, count = "x".join(map(str, grid.shape)), config.viewpoints**2 * config.angles
        raise UserError(f"map of {cells} cells is too large for a table of {count} rays from each; use method exact")
    tables = MapTables(grid, leaps(grid.occupied, config), None, range_max, config.surface * grid.resolution)
    if config.method == "exact":
        return tables
    return replace(tables, walls=_first_walls(tables, config.angles, config.viewpoints))


def leaps(occupied: Array, config: RaycastConfig) -> Array:
    """:attr:`MapTables.empty` of occupied cells (H, W)."""
    bordered = jnp.pad(occupied, 1, constant_values=True)
    if not config.wedges:
        return empty_squares(bordered, config.max_skip)
    sectors = max(1, min(config.wedges, _MOST // (8 * bordered.size)))
    return empty_wedges(bordered, sectors, min(config.max_skip, 254))


def cast_rays(tables: MapTables, poses: Array, lidar: LidarConfig) -> Array:
    """Expected ranges (..., B) in metres from map-frame base poses (..., 3); +inf beyond ``lidar.range_max``.

    A pose outside of the map sees nothing, one on an occupied cell sees ``surface`` (zero for solid cells).
    """
    sensor = tables.grid.to_grid(compose(poses, jnp.asarray(lidar.mount)))
    bearings = jnp.asarray(lidar.angles()) - lidar.mount[2]
    x, y = (sensor[..., axis] / tables.grid.resolution for axis in (0, 1))
    limit = lidar.range_max / tables.grid.resolution
    if tables.walls is None:
        reach = march(tables.empty, x, y, sensor[..., 2], bearings, limit)
    else:
        viewpoints = tables.walls.shape[0] // tables.grid.shape[0]
        reach = _meet_walls(tables.walls, viewpoints, x[..., None], y[..., None], sensor[..., 2], bearings)
    reach = reach * tables.grid.resolution + tables.surface
    return jnp.where(reach < lidar.range_max, reach, jnp.inf)


def _directions(theta: Array, bearings: Array) -> tuple[Array, Array]:
    """Unit vectors of ``theta`` (...) + ``bearings`` (B,)."""
    c, s = jnp.cos(theta)[..., None], jnp.sin(theta)[..., None]
    return direction_of(c, s, jnp.cos(bearings), jnp.sin(bearings))


def _first_walls(tables: MapTables, angles: int, viewpoints: int) -> Array:
    """(V H, V W, A) int16 walls seen from the viewpoints: 2 * coordinate of the edge hit + (0 across x, 1 across y).

    -1 for none; -2 on occupied cells, from which everything is at distance zero.
    """
    height, width = (side * viewpoints for side in tables.grid.shape)
    theta = jnp.arange(angles) * (2 * jnp.pi / angles)
    dx, dy = jnp.cos(theta), jnp.sin(theta)
    limit = tables.range_max / tables.grid.resolution + 1.0
    occupied = jnp.repeat(jnp.repeat(tables.grid.occupied, viewpoints, 0), viewpoints, 1)

    def one_row(i: Array) -> Array:
        x, y = (jnp.arange(width) + 0.5) / viewpoints, (i + 0.5) / viewpoints
        reach = march(tables.empty, x, jnp.full(width, y), jnp.zeros(width), theta, limit)
        at_x, at_y = x[:, None] + reach * dx, y + reach * dy
        across_y = jnp.abs(at_y - jnp.round(at_y)) < jnp.abs(at_x - jnp.round(at_x))
        edge = jnp.round(jnp.where(across_y, at_y, at_x))
        walls = jnp.where(jnp.isfinite(reach), 2 * edge + across_y, -1).astype(jnp.int16)
        return jnp.where(occupied[i.astype(jnp.int32), :, None], jnp.int16(-2), walls)

    return jax.lax.map(one_row, jnp.arange(height), batch_size=16)


def _meet_walls(walls: Array, viewpoints: int, x: Array, y: Array, theta: Array, bearings: Array) -> Array:
    """Distance in cells along the actual rays to the tabulated wall, inf for none."""
    height, width, angles = walls.shape
    dx, dy = _directions(theta, bearings)
    row, column = y * viewpoints, x * viewpoints
    known = inside((height, width), row, column) & jnp.isfinite(theta)[..., None]
    i, j = (jnp.where(known, jnp.floor(v), 0.0) for v in (row, column))
    cell = flat_index(i, j, (height, width)) * angles
    turns = (theta[..., None] + bearings) * (angles / (2 * jnp.pi))
    bins = jnp.round(jnp.where(known, turns, 0.0)).astype(jnp.int32) % angles
    wall = take(walls.reshape(-1), cell + bins).astype(jnp.int32)
    across_y = (wall & 1) == 1
    gap = (wall >> 1).astype(jnp.float32) - jnp.where(across_y, y, x)
    reach = jnp.maximum(gap / jnp.where(across_y, dy, dx), 0.0)
    reach = jnp.where(wall == -2, 0.0, reach)
    return jnp.where(known & (wall != -1), reach, jnp.inf)
