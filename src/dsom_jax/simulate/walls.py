"""Walls between labels, and doors in them, so that the rooms hang together."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from dsom_jax.simulate.floorplan import OUTSIDE, Style
from dsom_jax.simulate.morphology import grow, shifted
from dsom_jax.types import Array, Key


class Boundary(NamedTuple):
    """Where labels meet.

    Attributes:
        wall: (H, W) bool, cells on the boundary of their label.
        pair: (H, W) int32, the two labels that meet there as lower * L + higher.
        outer: (H, W) bool, boundary with the outside of the building.
        corner: (H, W) bool, a third label is near: no place for a door.
    """

    wall: Array
    pair: Array
    outer: Array
    corner: Array


def boundary(labels: Array, count: int) -> Boundary:
    """Boundary cells of ``labels``: those that differ from their right, upper or upper right neighbour.

    Two cells with different labels that are not walls never touch, not even at a corner, so no ray passes.
    """
    right, upper, diagonal = (shifted(labels, *shift, outside=OUTSIDE) for shift in ((0, 1), (1, 0), (1, 1)))
    other = jnp.where(right != labels, right, jnp.where(upper != labels, upper, diagonal))
    low, high = jnp.minimum(labels, other), jnp.maximum(labels, other)
    outer = (jnp.stack([labels, right, upper, diagonal]) == OUTSIDE).any(0)
    return Boundary(other != labels, low * count + high, outer & (other != labels), _near_third(labels, low, high))


def _near_third(labels: Array, low: Array, high: Array) -> Array:
    """Cells with a label near them that is neither ``low`` nor ``high``."""
    third = jnp.zeros(labels.shape, bool)
    for di in (-2, 0, 3):
        for dj in (-2, 0, 3):
            near = shifted(labels, di, dj, outside=OUTSIDE)
            third |= (near != low) & (near != high)
    return third


def build_walls(
    key: Key, style: Style, labels: Array, is_corridor: Array, door_cells: tuple[int, int]
) -> tuple[Array, Array]:
    """Walls (H, W) with doors and openings cut out, and the cells (H, W) that must stay clear before the doors.

    ``door_cells``: half widths of narrow and wide doors, cells.
    """
    k_where, k_which, k_wide = jax.random.split(key, 3)
    count = is_corridor.shape[0]
    edge = boundary(labels, count)
    score, place = _door_places(k_where, edge, count)
    opened, doors = _connections(k_which, style, place, is_corridor, labels)
    door = edge.wall & ~edge.outer & ~edge.corner & (score == place.ravel()[edge.pair]) & doors.ravel()[edge.pair]
    wide = door & (jax.random.uniform(k_wide, door.shape) < style.wide_doors)
    wall = edge.wall & ~(opened.ravel()[edge.pair] & ~edge.outer)
    outer = edge.outer
    # The second layer of a thick wall lies below and to the left of the first.
    wall, outer = (w | (style.thick & (shifted(w, 0, 1) | shifted(w, 1, 0))) for w in (wall, outer))
    cut = grow(door & ~wide, door_cells[0]) | grow(wide, door_cells[1])
    # A narrow door in a slanted thick wall would be no wider than a slit.
    cut = jnp.where(style.thick, grow(cut, 1), cut)
    return wall & ~(cut & ~outer), grow(cut, 2)


def _door_places(key: Key, edge: Boundary, count: int) -> tuple[Array, Array]:
    """A random score per cell (H, W), and the lowest of each pair of labels (L, L); inf where no door fits."""
    score = jax.random.uniform(key, edge.wall.shape)
    fits = edge.wall & ~edge.outer & ~edge.corner
    lowest = jnp.full(count * count, jnp.inf).at[jnp.where(fits, edge.pair, 0)].min(jnp.where(fits, score, jnp.inf))
    return score, lowest.reshape(count, count)


def _connections(key: Key, style: Style, place: Array, is_corridor: Array, labels: Array) -> tuple[Array, Array]:
    """Which pairs of labels have no wall and which have a door, both (L, L), upper triangle."""
    draw = jax.random.uniform(key, place.shape)
    # Further digits of one draw: three independent ones for the price of one.
    draw_door, draw_weight = (draw * 251) % 1, (draw * 63001) % 1
    fits = jnp.isfinite(place)
    corridors = is_corridor[:, None].astype(jnp.int32) + is_corridor[None]
    opened = draw < style.merge * jnp.asarray([1.0, 0.15, 0.0])[corridors]
    opened |= corridors == 2
    chance = jnp.stack([style.room_doors, 0.85 * jnp.ones(()), jnp.zeros(())])[corridors]
    doors = fits & (draw_door < chance)
    sizes = jnp.zeros(place.shape[0], jnp.int32).at[labels.ravel()].add(1).at[OUTSIDE].set(0)
    weights = jnp.where(fits, draw_weight + 0.5 * (corridors == 1), 0.0)
    return opened, doors | _missing_doors(weights, (opened & fits) | doors, jnp.argmax(sizes))


def _missing_doors(weights: Array, linked: Array, start: Array) -> Array:
    """Doors (L, L) to add to ``linked`` so that all labels with a positive weight between them hang together.

    Grows the set that is reached from ``start``; when it is stuck, each label beside it gets its heaviest door.
    """
    n = weights.shape[0]
    weights, linked = weights + weights.T, linked | linked.T

    def advance(carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        reached, extra, _ = carry
        grown = reached | ((linked | extra) & reached[None]).any(1)
        stuck = (grown == reached).all()
        options = jnp.where(reached[None] & ~reached[:, None], weights, 0.0)
        chosen = stuck & (options.max(1, keepdims=True) > 0) & (jnp.arange(n)[None] == options.argmax(1)[:, None])
        return grown, extra | chosen | chosen.T, ~stuck | chosen.any()

    state = (jnp.arange(n) == start, jnp.zeros((n, n), bool), jnp.bool_(True))
    return jnp.triu(jax.lax.while_loop(lambda carry: carry[2], advance, state)[1])
