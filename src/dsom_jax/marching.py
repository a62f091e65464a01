"""Exact ray marching on cells: every step leaps out of the largest empty square ahead, or to the end of an empty wedge.

Pure functions on arrays in cells; :mod:`dsom_jax.raycast` has the maps, the metres and the lidar.
"""

from __future__ import annotations

import math
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_batching import custom_vmap

from dsom_jax.occupancy import inside
from dsom_jax.types import Array

_NUDGE = 1e-3  # cells; larger than float32 rounding at 4,000 cells, smaller than anything a lidar resolves
_STEPS = (3, 2, 2)
"""Leaps of a ray when it is taken up, by level; at first all rays take those of the first level, too."""
_SHARES = (3, 4, 4)
"""Of so many rays one is taken up at a time, by level: a third of all, of these a quarter, of these a quarter."""
_FEW = 1024
"""Rays for which it is not worth while to sort out those that have arrived."""


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


def empty_wedges(blocked: Array, sectors: int, cap: int) -> Array:
    """(8 S, H, W) uint8, how far it is empty from each cell into each of 8 S directions; what lies around is blocked.

    An octant has S sectors of equal steps in slope. Of a value v > 0: whoever starts anywhere in the cell, along any
    direction of the sector, meets nothing blocked in v - 1 columns, the cell's own included (rows, in octants about
    the y axis), and v - 1 <= ``cap``. A blocked cell has 0. Layers count first the axis of the octant, then its
    direction (up, then right, as in :func:`empty_squares`), then the sector.
    """
    ways = [(up, right) for up in (False, True) for right in (False, True)]
    along_x = [_wedges_into(blocked, up, right, sectors, cap) for up, right in ways]
    along_y = [_wedges_into(blocked.T, right, up, sectors, cap).swapaxes(1, 2) for up, right in ways]
    return jnp.concatenate([*along_x, *along_y])


def _wedges_into(blocked: Array, up: bool, right: bool, sectors: int, cap: int) -> Array:
    """(S, H, W) uint8 of :func:`empty_wedges`, of the octant about the x axis."""
    flip = partial(jnp.flip, axis=[axis + 1 for axis, keep in enumerate((up, right)) if not keep])
    slopes, column = np.arange(sectors + 1)[:, None] / sectors, np.arange(cap)
    # From anywhere in its cell, a ray is in column k after less than k + 1 and more than k - 1 cells along x.
    first = np.floor(slopes[:-1] * np.maximum(column - 1, 0)).astype(np.int32)
    last = np.ceil(slopes[1:] * (column + 1) + 1 + _NUDGE).astype(np.int32)
    height, width = blocked.shape
    walled = jnp.pad(flip(blocked[None])[0], ((0, int(last.max())), (0, cap)), constant_values=True)
    below = jnp.pad(jnp.cumsum(walled, 0, dtype=jnp.int32), ((1, 0), (0, 0)))

    def one(rows: tuple[Array, Array]) -> Array:
        def next_column(state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
            k, clear, count = state
            to, since = (jax.lax.dynamic_slice(below, (row[k], k), (height, width)) for row in rows[::-1])
            clear &= to == since
            return k + 1, clear, count + clear

        start = jnp.int32(0), jnp.ones((height, width), bool), jnp.zeros((height, width), jnp.uint8)
        return jax.lax.while_loop(lambda s: (s[0] < cap) & s[1].any(), next_column, start)[2]

    count = flip(jax.lax.map(one, (jnp.asarray(first), jnp.asarray(last))))
    return jnp.where(blocked, 0, count + 1).astype(jnp.uint8)


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
        return self.x, self.y, *direction_of(self.cos, self.sin, self.beam_cos, self.beam_sin)

    def at(self, ray: Array) -> tuple[Array, Array, Array, Array]:
        """x, y and direction of the rays with numbers ``ray`` (G,), counted pose by pose."""
        pose, beam = ray // self.beam_cos.size, ray % self.beam_cos.size
        x, y, c, s = (take(v[:, 0], pose) for v in (self.x, self.y, self.cos, self.sin))
        return x, y, *direction_of(c, s, take(self.beam_cos, beam), take(self.beam_sin, beam))


def direction_of(c: Array, s: Array, beam_cos: Array, beam_sin: Array) -> tuple[Array, Array]:
    """Unit vector of heading + bearing by the addition theorem: no trigonometry per ray."""
    return c * beam_cos - s * beam_sin, s * beam_cos + c * beam_sin


@custom_vmap
def march(empty: Array, x: Array, y: Array, theta: Array, bearings: Array, limit: float) -> Array:
    """Distance in cells to the first occupied cell; inf from ``limit`` on, and for rays that leave the map.

    Args:
        empty: of :func:`empty_squares` or :func:`empty_wedges`, with a border of one cell.
        x, y, theta: (...) sensors, cells from the corner of the map and radians.
        bearings: (B,) of the rays, radians.
        limit: cells.

    Returns:
        (..., B).

    Every step leaps out of the largest empty square ahead, or to the end of the empty wedge. All rays take a few steps
    together; those still under way are then taken up by themselves, so that they do not hold up the rest.
    """
    return _march(empty, x, y, theta, bearings, limit)


@march.def_vmap
def _march_batch(
    axis_size: int, batched: list[bool], empty: Array, x: Array, y: Array, theta: Array, bearings: Array, limit: Array
) -> tuple[Array, bool]:
    """Under ``vmap`` over poses: more poses, as a batch of loops would gather and scatter far more slowly."""
    if batched[0] or batched[4] or batched[5]:
        return jax.vmap(_march, [0 if b else None for b in batched])(empty, x, y, theta, bearings, limit), True
    poses = zip((x, y, theta), batched[1:4], strict=True)
    x, y, theta = (v if b else jnp.broadcast_to(v, (axis_size, *v.shape)) for v, b in poses)
    return march(empty, x, y, theta, bearings, limit), True


def _march(empty: Array, x: Array, y: Array, theta: Array, bearings: Array, limit: float | Array) -> Array:
    shape = (*x.shape, bearings.size)
    x, y, theta = (v.ravel()[:, None] for v in (x, y, theta))
    known = inside((empty.shape[1] - 2, empty.shape[2] - 2), y, x) & jnp.isfinite(theta)
    x, y, theta = jnp.where(known, x, 0.0), jnp.where(known, y, 0.0), jnp.where(known, theta, 0.0)
    turn = (jnp.cos(theta), jnp.sin(theta), jnp.cos(bearings), jnp.sin(bearings))
    # Without the barrier every ray computes its heading's sine and cosine again.
    fan = jax.lax.optimization_barrier(_Fan(x + 1.0, y + 1.0, *turn))
    reach = _march_fan(empty, fan, limit)
    hit = known & (reach < limit) & ~_on_border(empty, fan.rays(), reach)
    return jnp.where(hit, reach, jnp.inf).reshape(shape)


def _march_fan(empty: Array, fan: _Fan, limit: float | Array) -> Array:
    shape = (fan.x.size, fan.beam_cos.size)
    if math.prod(shape) <= _FEW:
        return _to_the_end(empty, fan.rays(), limit, jnp.zeros(shape), jnp.ones(shape, bool))
    reach, side = _leap(empty, fan.rays(), jnp.zeros(shape), _STEPS[0])
    rays = jnp.arange(math.prod(shape), dtype=jnp.int32)
    return _taken_up(empty, fan, limit, rays, reach.ravel(), ((side > 0) & (reach < limit)).ravel(), 0).reshape(shape)


def _taken_up(
    empty: Array, fan: _Fan, limit: float | Array, rays: Array, reach: Array, free: Array, level: int
) -> Array:
    """Distance (n,) that rays with numbers (n,) go in the end, ``reach`` (n,) so far; ``free`` (n,) have not arrived.

    Those still under way are taken up so many at a time that mostly once is enough: few rays graze a wall.
    """
    count = rays.size
    size = -(-count // _SHARES[level])
    last = level + 1 == len(_STEPS)

    def some(state: tuple[Array, Array]) -> tuple[Array, Array]:
        reach, live = state
        # What flatnonzero does, in a third of its time and of its compilation.
        place = jnp.where(live, jnp.cumsum(live, dtype=jnp.int32) - 1, size)
        number = jnp.arange(count, dtype=jnp.int32)
        where = jnp.full(size, count, jnp.int32).at[place].set(number, mode="drop")
        chosen = jnp.minimum(where, count - 1)
        ray = take(rays, chosen)
        ahead = jax.lax.optimization_barrier(fan.at(ray))
        got, side = _leap(empty, ahead, take(reach, chosen), _STEPS[level])
        more = (where < count) & (side > 0) & (got < limit)
        if last:
            got = _to_the_end(empty, ahead, limit, got, more)
        else:
            got = _taken_up(empty, fan, limit, ray, got, more, level + 1)
        return reach.at[where].set(got, mode="drop"), live.at[where].set(False, mode="drop")

    return jax.lax.while_loop(lambda s: s[1].any(), some, (reach, free))[0]


def _to_the_end(
    empty: Array, rays: tuple[Array, Array, Array, Array], limit: float | Array, reach: Array, free: Array
) -> Array:
    """Distance that all of the rays go in the end, none waiting for its turn."""
    # A leap is a cell or more; should rounding ever hold up a ray, it does not hold up the robot.
    rounds = 1 + sum(empty.shape[1:]) // _STEPS[-1]

    def on(state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        reach, side = _leap(empty, rays, state[0], _STEPS[-1])
        return reach, (side > 0) & (reach < limit), state[2] + 1

    return jax.lax.while_loop(lambda s: s[1].any() & (s[2] < rounds), on, (reach, free, jnp.int32(0)))[0]


def flat_index(i: Array, j: Array, shape: tuple[int, int]) -> Array:
    """int32 index of cells (i, j), whole numbers in float32, of an array of ``shape``."""
    if shape[0] * shape[1] <= 2**24:  # float32 is exact up to there, and one conversion cheaper
        return (i * shape[1] + j).astype(jnp.int32)
    return i.astype(jnp.int32) * shape[1] + j.astype(jnp.int32)


def take(values: Array, index: Array) -> Array:
    """Entries of ``values`` (n,) at indices that are known to lie within: no check for each ray."""
    return values.at[index].get(mode="promise_in_bounds")


def _leap(empty: Array, rays: tuple[Array, Array, Array, Array], reach: Array, steps: int) -> tuple[Array, Array]:
    """``steps`` leaps of rays that lie inside of the bordered map; ones that arrived stay where they are.

    ``empty`` is that of :func:`empty_squares`, (4, H, W), or of :func:`empty_wedges`, (8 S, H, W).
    """
    x, y, dx, dy = rays
    layers, height, width = empty.shape
    flat = empty.reshape(-1)
    right, up = dx >= 0, dy >= 0
    steep = jnp.abs(dy) > jnp.abs(dx)
    sectors = layers // 8
    number = jnp.where(up, 2, 0) + jnp.where(right, 1, 0)
    per_x, per_y = (1 / jnp.where(v >= 0, jnp.maximum(v, 1e-9), jnp.minimum(v, -1e-9)) for v in (dx, dy))
    if sectors:
        slope = jnp.abs(jnp.where(steep, dx * per_y, dy * per_x))
        sector = jnp.minimum((slope * sectors).astype(jnp.int32), sectors - 1)
        number = (number + jnp.where(steep, 4, 0)) * sectors + sector
    layer = number * (height * width)
    sign_x, sign_y = jnp.where(right, 1.0, -1.0), jnp.where(up, 1.0, -1.0)
    edge_x, edge_y = jnp.where(right, 0.0, 1.0) - x, jnp.where(up, 0.0, 1.0) - y
    ahead_x, ahead_y = x + _NUDGE * sign_x, y + _NUDGE * sign_y
    for _ in range(steps):
        j, i = jnp.floor(ahead_x + reach * dx), jnp.floor(ahead_y + reach * dy)
        side = take(flat, layer + flat_index(i, j, (height, width))).astype(jnp.float32)
        square = jnp.minimum(side, 1.0) if sectors else side
        leave = jnp.minimum((j + edge_x + square * sign_x) * per_x, (i + edge_y + square * sign_y) * per_y)
        if sectors:
            columns = side - 1.0
            along_x, along_y = (j + edge_x + columns * sign_x) * per_x, (i + edge_y + columns * sign_y) * per_y
            leave = jnp.maximum(leave, jnp.where(steep, along_y, along_x))
        # Without the barrier XLA computes each leap again for every later one.
        reach, side = jax.lax.optimization_barrier((jnp.maximum(reach, leave), side))
    return reach, side


def _on_border(empty: Array, rays: tuple[Array, Array, Array, Array], reach: Array) -> Array:
    """Whether a ray that ended at ``reach`` ended outside of the map (not on an occupied cell)."""
    x, y, dx, dy = rays
    height, width = empty.shape[1] - 2, empty.shape[2] - 2
    j = x - 1 + reach * dx + jnp.where(dx >= 0, _NUDGE, -_NUDGE)
    i = y - 1 + reach * dy + jnp.where(dy >= 0, _NUDGE, -_NUDGE)
    return ~inside((height, width), i, j) | (i < 0) | (j < 0)
