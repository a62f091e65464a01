"""Ray casting on an occupancy grid: exact by empty-square skipping, or looked up in a precomputed table.

Accuracy and speed of both are measured by ``experiments/perf/raycast.py``; the worst case of the table is at the
edges of obstacles, where the ray from the pose and the one from the centre of its cell meet different walls.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
from jax.custom_batching import custom_vmap

from dsom_jax import checks
from dsom_jax.errors import UserError
from dsom_jax.geometry import compose
from dsom_jax.lidar import LidarConfig
from dsom_jax.occupancy import OccupancyGrid, inside
from dsom_jax.types import Array

_NUDGE = 1e-3  # cells; larger than float32 rounding at 4,000 cells, smaller than anything a lidar resolves
_FIRST_STEPS, _MORE_STEPS, _GROUP = 4, 4, 32


@dataclass(frozen=True)
class RaycastConfig:
    """How expected ranges are obtained.

    Attributes:
        method: ``exact`` marches every ray; ``table`` looks up the wall that the ray from the centre of the cell, at
            the nearest of ``angles`` directions, would meet, and intersects the actual ray with that wall.
        angles: directions per cell of the table.
        max_skip: side of the largest empty square stored, cells.
        surface: how deep in an occupied cell the beam is returned, cells. 0 for worlds whose cells are solid; 0.5 for
            maps made from scans, whose end points lie anywhere in the cells that they fill.
    """

    method: Literal["exact", "table"] = "exact"
    angles: int = 360
    max_skip: int = 63
    surface: float = 0.0

    def __post_init__(self) -> None:
        checks.choice(self, "method", ("exact", "table"))
        checks.count(self, "angles", 4)
        checks.count(self, "max_skip")
        checks.within(self, "max_skip", 1, 255, "give 1 to 255 cells")
        checks.not_negative(self, "surface")


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class MapTables:
    """A map with what ray casting precomputes of it.

    Attributes:
        grid: the map.
        squares: (4, H + 2, W + 2) uint8, side of the largest empty square whose corner is the cell and that extends
            to -x-y, +x-y, -x+y, +x+y; zero on occupied cells and on a border one cell wide around the map.
        walls: (H, W, A) int16 or None, first wall from the centre of the cell: 2 * coordinate + axis, -1 for none,
            -2 on occupied cells.
        range_max: metres up to which ``walls`` was computed (static).
        surface: metres added to the distance of the near edge of an occupied cell (static).
    """

    grid: OccupancyGrid
    squares: Array
    walls: Array | None
    range_max: float = field(metadata={"static": True})
    surface: float = field(metadata={"static": True})


@partial(jax.jit, static_argnames=("config", "range_max"))
def make_tables(grid: OccupancyGrid, config: RaycastConfig, range_max: float) -> MapTables:
    """Tables for :func:`cast_rays` up to ``range_max`` metres.

    Raises:
        UserError: the map is too large for ``table``, whose entries are counted in int32 and name walls in int16.
    """
    if config.method == "table" and (grid.occupied.size * config.angles >= 2**31 or max(grid.shape) >= 2**14):
        cells, angles = "x".join(map(str, grid.shape)), config.angles
        raise UserError(f"map of {cells} cells is too large for a table of {angles} angles; use method exact")
    squares = empty_squares(jnp.pad(grid.occupied, 1, constant_values=True), config.max_skip)
    tables = MapTables(grid, squares, None, range_max, config.surface * grid.resolution)
    if config.method == "exact":
        return tables
    return replace(tables, walls=_first_walls(tables, config.angles))


def empty_squares(blocked: Array, cap: int) -> Array:
    """(4, H, W) uint8 side of the largest empty square extending from each cell into each quadrant, at most ``cap``."""
    return jnp.stack([_squares_into(blocked, up, right, cap) for up in (False, True) for right in (False, True)])


def _squares_into(blocked: Array, up: bool, right: bool, cap: int) -> Array:
    flip = partial(jnp.flip, axis=[axis for axis, keep in enumerate((up, right)) if not keep])

    def grow(carry: tuple[Array, Array], _: None) -> tuple[tuple[Array, Array], None]:
        hit, side = carry
        hit = hit.at[:-1].max(hit[1:])
        hit = hit.at[:, :-1].max(hit[:, 1:])
        return (hit, side + ~hit), None

    start = flip(blocked)
    (_, side), _ = jax.lax.scan(grow, (start, (~start).astype(jnp.uint8)), length=cap - 1)
    return flip(side)


def cast_rays(tables: MapTables, poses: Array, lidar: LidarConfig) -> Array:
    """Expected ranges (..., B) in metres from map-frame base poses (..., 3); +inf beyond ``lidar.range_max``.

    A pose outside of the map sees nothing, one on an occupied cell sees ``surface`` (zero for solid cells).
    """
    sensor = tables.grid.to_grid(compose(poses, jnp.asarray(lidar.mount)))
    bearings = jnp.asarray(lidar.angles()) - lidar.mount[2]
    x, y = (sensor[..., axis] / tables.grid.resolution for axis in (0, 1))
    limit = lidar.range_max / tables.grid.resolution
    if tables.walls is None:
        reach = march(tables.squares, x, y, sensor[..., 2], bearings, limit)
    else:
        reach = _meet_walls(tables.walls, x[..., None], y[..., None], sensor[..., 2], bearings)
    reach = reach * tables.grid.resolution + tables.surface
    return jnp.where(reach < lidar.range_max, reach, jnp.inf)


class _Fan(NamedTuple):
    """Rays of P sensors with the same B bearings: everything that a ray is made of, without an array of all rays.

    Attributes:
        x, y: (P, 1) sensors in cells.
        cos, sin: (P, 1) of their headings.
        beam_cos, beam_sin: (B,) of the bearings.
    """

    x: Array
    y: Array
    cos: Array
    sin: Array
    beam_cos: Array
    beam_sin: Array

    def rays(self) -> tuple[Array, Array, Array, Array]:
        """x, y and direction of all rays, broadcast against (P, B)."""
        return self.x, self.y, *_turned(self.cos, self.sin, self.beam_cos, self.beam_sin)

    def at(self, ray: Array) -> tuple[Array, Array, Array, Array]:
        """x, y and direction of the rays with numbers ``ray`` (G,), counted pose by pose."""
        pose, beam = ray // self.beam_cos.size, ray % self.beam_cos.size
        x, y, c, s = (_at(v[:, 0], pose) for v in (self.x, self.y, self.cos, self.sin))
        return x, y, *_turned(c, s, _at(self.beam_cos, beam), _at(self.beam_sin, beam))


def _turned(c: Array, s: Array, beam_cos: Array, beam_sin: Array) -> tuple[Array, Array]:
    """Unit vector of heading + bearing by the addition theorem: no trigonometry per ray."""
    return c * beam_cos - s * beam_sin, s * beam_cos + c * beam_sin


def _directions(theta: Array, bearings: Array) -> tuple[Array, Array]:
    """Unit vectors of ``theta`` (...) + ``bearings`` (B,)."""
    c, s = jnp.cos(theta)[..., None], jnp.sin(theta)[..., None]
    return _turned(c, s, jnp.cos(bearings), jnp.sin(bearings))


@custom_vmap
def march(squares: Array, x: Array, y: Array, theta: Array, bearings: Array, limit: float) -> Array:
    """Distance in cells to the first occupied cell; inf from ``limit`` on, and for rays that leave the map.

    Args:
        squares: of :func:`empty_squares`, with a border of one cell.
        x, y, theta: (...) sensors, cells from the corner of the map and radians.
        bearings: (B,) of the rays, radians.
        limit: cells.

    Returns:
        (..., B).

    Every step leaps out of the largest empty square ahead. All rays take a few steps together; the few that are still
    under way (grazing a wall) are then taken up one per group of 32, so that they do not hold up the rest.
    """
    return _march(squares, x, y, theta, bearings, limit)


@march.def_vmap
def _march_batch(
    axis_size: int, batched: list[bool], squares: Array, x: Array, y: Array, theta: Array, bearings: Array, limit: Array
) -> tuple[Array, bool]:
    """Under ``vmap`` over poses: more poses, as a batch of loops would gather and scatter far more slowly."""
    if batched[0] or batched[4] or batched[5]:
        return jax.vmap(_march, [0 if b else None for b in batched])(squares, x, y, theta, bearings, limit), True
    poses = zip((x, y, theta), batched[1:4], strict=True)
    x, y, theta = (v if b else jnp.broadcast_to(v, (axis_size, *v.shape)) for v, b in poses)
    return march(squares, x, y, theta, bearings, limit), True


def _march(squares: Array, x: Array, y: Array, theta: Array, bearings: Array, limit: float | Array) -> Array:
    shape = (*x.shape, bearings.size)
    x, y, theta = (v.ravel()[:, None] for v in (x, y, theta))
    known = inside((squares.shape[1] - 2, squares.shape[2] - 2), y, x) & jnp.isfinite(theta)
    x, y, theta = jnp.where(known, x, 0.0), jnp.where(known, y, 0.0), jnp.where(known, theta, 0.0)
    turn = (jnp.cos(theta), jnp.sin(theta), jnp.cos(bearings), jnp.sin(bearings))
    # Without the barrier every ray computes its heading's sine and cosine again.
    fan = jax.lax.optimization_barrier(_Fan(x + 1.0, y + 1.0, *turn))
    reach = _march_fan(squares, fan, limit)
    hit = known & (reach < limit) & ~_on_border(squares, fan.rays(), reach)
    return jnp.where(hit, reach, jnp.inf).reshape(shape)


def _march_fan(squares: Array, fan: _Fan, limit: float | Array) -> Array:
    shape = (fan.x.size, fan.beam_cos.size)
    count = math.prod(shape)
    groups = -(-count // _GROUP)
    reach, side = _leap(squares, fan.rays(), jnp.zeros(shape), _FIRST_STEPS)
    rounds = _GROUP * (1 + sum(squares.shape[1:]) // _MORE_STEPS)
    reach, live = (jnp.pad(v.ravel(), (0, groups * _GROUP - count)) for v in (reach, (side > 0) & (reach < limit)))

    def one_per_group(state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        reach, live, number = state
        order = jnp.arange(_GROUP, dtype=jnp.int32)[:, None]
        first = jnp.where(live.reshape(_GROUP, groups), order, _GROUP - 1).min(0)
        chosen = first * groups + jnp.arange(groups, dtype=jnp.int32)
        rays = jax.lax.optimization_barrier(fan.at(jnp.minimum(chosen, count - 1)))
        got, side = _leap(squares, rays, _at(reach, chosen), _MORE_STEPS)
        live = _put(live, chosen, (side > 0) & (got < limit) & (chosen < count))
        return _put(reach, chosen, got), live, number + 1

    state = (reach, live, jnp.int32(0))
    reach = jax.lax.while_loop(lambda s: s[1].any() & (s[2] < rounds), one_per_group, state)[0]
    return reach[:count].reshape(shape)


def _flat_index(i: Array, j: Array, shape: tuple[int, int]) -> Array:
    """int32 index of cells (i, j), whole numbers in float32, of an array of ``shape``."""
    if shape[0] * shape[1] <= 2**24:  # float32 is exact up to there, and one conversion cheaper
        return (i * shape[1] + j).astype(jnp.int32)
    return i.astype(jnp.int32) * shape[1] + j.astype(jnp.int32)


def _at(values: Array, index: Array) -> Array:
    return values.at[index].get(mode="promise_in_bounds")


def _put(values: Array, index: Array, new: Array) -> Array:
    return values.at[index].set(new, mode="promise_in_bounds", unique_indices=True)


def _leap(squares: Array, rays: tuple[Array, Array, Array, Array], reach: Array, steps: int) -> tuple[Array, Array]:
    """``steps`` leaps of rays that lie inside of the bordered map; ones that arrived stay where they are."""
    x, y, dx, dy = rays
    _, height, width = squares.shape
    flat = squares.reshape(-1)
    right, up = dx >= 0, dy >= 0
    layer = jnp.where(up, 2 * height * width, 0) + jnp.where(right, height * width, 0)
    per_x, per_y = (1 / jnp.where(v >= 0, jnp.maximum(v, 1e-9), jnp.minimum(v, -1e-9)) for v in (dx, dy))
    sign_x, sign_y = jnp.where(right, 1.0, -1.0), jnp.where(up, 1.0, -1.0)
    edge_x, edge_y = jnp.where(right, 0.0, 1.0) - x, jnp.where(up, 0.0, 1.0) - y
    ahead_x, ahead_y = x + _NUDGE * sign_x, y + _NUDGE * sign_y
    for _ in range(steps):
        j, i = jnp.floor(ahead_x + reach * dx), jnp.floor(ahead_y + reach * dy)
        side = _at(flat, layer + _flat_index(i, j, (height, width))).astype(jnp.float32)
        leave = jnp.minimum((j + edge_x + side * sign_x) * per_x, (i + edge_y + side * sign_y) * per_y)
        # Without the barrier XLA computes each leap again for every later one.
        reach, side = jax.lax.optimization_barrier((jnp.maximum(reach, leave), side))
    return reach, side


def _on_border(squares: Array, rays: tuple[Array, Array, Array, Array], reach: Array) -> Array:
    """Whether a ray that ended at ``reach`` ended outside of the map (not on an occupied cell)."""
    x, y, dx, dy = rays
    height, width = squares.shape[1] - 2, squares.shape[2] - 2
    j = x - 1 + reach * dx + jnp.where(dx >= 0, _NUDGE, -_NUDGE)
    i = y - 1 + reach * dy + jnp.where(dy >= 0, _NUDGE, -_NUDGE)
    return ~inside((height, width), i, j) | (i < 0) | (j < 0)


def _first_walls(tables: MapTables, angles: int) -> Array:
    """(H, W, A) int16 walls seen from cell centres: 2 * coordinate of the cell edge hit + (0 across x, 1 across y).

    -1 for none; -2 on occupied cells, from which everything is at distance zero.
    """
    height, width = tables.grid.shape
    theta = jnp.arange(angles) * (2 * jnp.pi / angles)
    dx, dy = jnp.cos(theta), jnp.sin(theta)
    limit = tables.range_max / tables.grid.resolution + 1.0

    def one_row(i: Array) -> Array:
        x, y = jnp.arange(width) + 0.5, i + 0.5
        reach = march(tables.squares, x, jnp.full(width, y), jnp.zeros(width), theta, limit)
        at_x, at_y = x[:, None] + reach * dx, y + reach * dy
        across_y = jnp.abs(at_y - jnp.round(at_y)) < jnp.abs(at_x - jnp.round(at_x))
        edge = jnp.round(jnp.where(across_y, at_y, at_x))
        walls = jnp.where(jnp.isfinite(reach), 2 * edge + across_y, -1).astype(jnp.int16)
        return jnp.where(tables.grid.occupied[i.astype(jnp.int32), :, None], jnp.int16(-2), walls)

    return jax.lax.map(one_row, jnp.arange(height), batch_size=16)


def _meet_walls(walls: Array, x: Array, y: Array, theta: Array, bearings: Array) -> Array:
    """Distance in cells along the actual rays to the tabulated wall, inf for none."""
    height, width, angles = walls.shape
    dx, dy = _directions(theta, bearings)
    known = inside((height, width), y, x) & jnp.isfinite(theta)[..., None]
    i, j = (jnp.where(known, jnp.floor(v), 0.0) for v in (y, x))
    cell = _flat_index(i, j, (height, width)) * angles
    turns = (theta[..., None] + bearings) * (angles / (2 * jnp.pi))
    bins = jnp.round(jnp.where(known, turns, 0.0)).astype(jnp.int32) % angles
    wall = _at(walls.reshape(-1), cell + bins).astype(jnp.int32)
    across_y = (wall & 1) == 1
    gap = (wall >> 1).astype(jnp.float32) - jnp.where(across_y, y, x)
    reach = jnp.maximum(gap / jnp.where(across_y, dy, dx), 0.0)
    reach = jnp.where(wall == -2, 0.0, reach)
    return jnp.where(known & (wall != -1), reach, jnp.inf)
