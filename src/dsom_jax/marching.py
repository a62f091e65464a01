"""Exact ray marching on cells: every step leaps out of the largest empty square ahead.

Pure functions on arrays in cells; :mod:`dsom_jax.raycast` has the maps, the metres and the lidar.
"""

from __future__ import annotations

import math
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.custom_batching import custom_vmap

from dsom_jax.occupancy import inside
from dsom_jax.types import Array

_NUDGE = 1e-3  # cells; larger than float32 rounding at 4,000 cells, smaller than anything a lidar resolves
_FIRST_STEPS, _MORE_STEPS, _GROUP = 4, 4, 32


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
        return self.x, self.y, *turned(self.cos, self.sin, self.beam_cos, self.beam_sin)

    def at(self, ray: Array) -> tuple[Array, Array, Array, Array]:
        """x, y and direction of the rays with numbers ``ray`` (G,), counted pose by pose."""
        pose, beam = ray // self.beam_cos.size, ray % self.beam_cos.size
        x, y, c, s = (take(v[:, 0], pose) for v in (self.x, self.y, self.cos, self.sin))
        return x, y, *turned(c, s, take(self.beam_cos, beam), take(self.beam_sin, beam))


def turned(c: Array, s: Array, beam_cos: Array, beam_sin: Array) -> tuple[Array, Array]:
    """Unit vector of heading + bearing by the addition theorem: no trigonometry per ray."""
    return c * beam_cos - s * beam_sin, s * beam_cos + c * beam_sin


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
        got, side = _leap(squares, rays, take(reach, chosen), _MORE_STEPS)
        live = _put(live, chosen, (side > 0) & (got < limit) & (chosen < count))
        return _put(reach, chosen, got), live, number + 1

    state = (reach, live, jnp.int32(0))
    reach = jax.lax.while_loop(lambda s: s[1].any() & (s[2] < rounds), one_per_group, state)[0]
    return reach[:count].reshape(shape)


def flat_index(i: Array, j: Array, shape: tuple[int, int]) -> Array:
    """int32 index of cells (i, j), whole numbers in float32, of an array of ``shape``."""
    if shape[0] * shape[1] <= 2**24:  # float32 is exact up to there, and one conversion cheaper
        return (i * shape[1] + j).astype(jnp.int32)
    return i.astype(jnp.int32) * shape[1] + j.astype(jnp.int32)


def take(values: Array, index: Array) -> Array:
    """Entries of ``values`` (n,) at indices that are known to lie within: no check for each ray."""
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
        side = take(flat, layer + flat_index(i, j, (height, width))).astype(jnp.float32)
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
