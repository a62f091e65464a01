"""Floor plans as labels: every cell gets the number of the room or corridor that it lies in.

A building is a turned, perhaps bent rectangle that is split again and again, first by corridors, then into rooms;
shapes that ignore the splits (slanted halls, rounds, ring corridors) are laid over it. Lengths are metres in the frame
of the building, (u, v), centred on the map.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from dsom_jax.simulate.morphology import renumber
from dsom_jax.types import Array, Key

OUTSIDE = 0
"""Label of everything that is not part of the building, courtyards and shafts included."""

LARGEST_HALL = 18.0
"""Longest side of a region that may stay undivided by chance, metres."""

SMALLEST_ROOM = 12
"""Cells; smaller pieces are walled up."""

OVERLAYS = 3
"""Number of shapes laid over the splits; the first may be a ring corridor."""


class Style(NamedTuple):
    """Character of one building; scalars drawn by ``worlds.draw_style``.

    Attributes:
        turn: rotation of the building, radians.
        half: (2,) half extents of the building, metres.
        notches: (3, 4) centre and half extents of the rectangles cut from its outline, metres; NaN = none.
        bend: (5,) amplitude (m), wavelength (m) and phase (rad) of its curved walls, slope and place (m) of its kink.
        corridor_levels: number of split levels that lay corridors.
        corridor_width: metres.
        room_size: smallest side of a room, metres.
        irregular: 0 = all splits in the middle, 1 = anywhere.
        hall: probability that a region is not split further.
        slanted: probability that a split is not parallel to the building.
        void: probability that a room is closed off and unknown.
        merge: probability that two neighbouring rooms have no wall between them.
        room_doors: probability of a door between two neighbouring rooms.
        wide_doors: probability that a door is a wide one.
        thick: whether walls are two cells thick.
        furniture: mean density of furniture in rooms, 0 to 1.
        pillars: probability that a room has pillars.
        shelves: probability that a stretch of wall carries something.
    """

    turn: Array
    half: Array
    notches: Array
    bend: Array
    corridor_levels: Array
    corridor_width: Array
    room_size: Array
    irregular: Array
    hall: Array
    slanted: Array
    void: Array
    merge: Array
    room_doors: Array
    wide_doors: Array
    thick: Array
    furniture: Array
    pillars: Array
    shelves: Array


class Splits(NamedTuple):
    """One level d of splits; node n < 2^d has the label 2^d + n, further ones are padding.

    Attributes:
        split: (n,) bool, whether the node is split at all.
        along_u: (n,) bool, whether the cut is at one u (else one v).
        cut: (n,) where, metres.
        centre: (n,) middle of the node along the cut, metres.
        slope: (n,) drift of the cut per metre along it.
        corridor: (n,) half width of the corridor that replaces the cut, 0 = a wall.
    """

    split: Array
    along_u: Array
    cut: Array
    centre: Array
    slope: Array
    corridor: Array


def building_frame(style: Style, x: Array, y: Array) -> tuple[Array, Array]:
    """(u, v) of points (x, y), metres from the middle of the map: turned, then bent and kinked."""
    c, s = jnp.cos(style.turn), jnp.sin(style.turn)
    u, v = c * x + s * y, c * y - s * x
    amplitude, wavelength, phase, kink, place = style.bend
    return u, v + amplitude * jnp.sin(2 * jnp.pi * u / wavelength + phase) + kink * jnp.abs(u - place)


def room_labels(key: Key, style: Style, u: Array, v: Array, depth: int) -> tuple[Array, Array]:
    """Numbers (H, W) int32 of the rooms at points (u, v), each in one piece, and which numbers are corridors (L,).

    L = 1.5 * 2^depth is the most that there can be; the border of the map is outside, so that outer walls are closed.
    """
    k_tree, k_over, k_void = jax.random.split(key, 3)
    labels, is_corridor = _split(k_tree, style, u, v, depth)
    labels, is_corridor = _lay_over(k_over, style, labels, is_corridor, u, v)
    labels = jnp.where(inside_outline(style, u, v), labels, OUTSIDE)
    labels = jnp.pad(labels[1:-1, 1:-1], 1, constant_values=OUTSIDE)
    labels, former = renumber(labels, SMALLEST_ROOM, 3 * 2**depth // 2)
    is_corridor = is_corridor[former]
    return _close_off(k_void, style, labels, is_corridor), is_corridor


def _split(key: Key, style: Style, u: Array, v: Array, depth: int) -> tuple[Array, Array]:
    """Labels (H, W) after all levels of splits, and which labels are corridors (2^(depth+1) + OVERLAYS,).

    Loops rather than unrolled levels: XLA would fuse the splits into the cells and compute them anew for each.
    """
    nodes, levels = 2**depth, jnp.arange(depth)
    whole = jnp.stack([-style.half[0], style.half[0], -style.half[1], style.half[1]])

    def divide(carry: tuple[Array, Array], level_draws: tuple[Array, Array]) -> tuple[tuple[Array, Array], Splits]:
        boxes, alive = carry
        splits = draw_splits(level_draws[1], style, boxes, alive, level_draws[0])
        return (_children(boxes, splits)[:nodes], jnp.repeat(splits.split, 2)[:nodes]), splits

    start = jnp.broadcast_to(whole, (nodes, 4)), jnp.arange(nodes) == 0
    _, splits = jax.lax.scan(divide, start, (levels, jax.random.uniform(key, (depth, 6, nodes))))

    def descend(labels: Array, level_splits: tuple[Array, Splits]) -> tuple[Array, None]:
        return _descend(labels, level_splits[1], u, v, 2 ** level_splits[0]), None

    labels, _ = jax.lax.scan(descend, jnp.ones(u.shape, jnp.int32), (levels, splits))
    per_level = [splits.corridor[level, : 2**level] > 0 for level in range(depth)]
    return labels, jnp.concatenate([jnp.zeros(1, bool), *per_level, jnp.zeros(nodes + OVERLAYS, bool)])


def inside_outline(style: Style, u: Array, v: Array) -> Array:
    """Which points belong to the building: its rectangle without the notches."""
    inside = (jnp.abs(u) < style.half[0]) & (jnp.abs(v) < style.half[1])
    for cu, cv, hu, hv in style.notches:
        inside &= ~((jnp.abs(u - cu) < hu) & (jnp.abs(v - cv) < hv))
    return inside


def draw_splits(r: Array, style: Style, boxes: Array, alive: Array, level: Array) -> Splits:
    """How the nodes of a level with extents ``boxes`` (n, 4) = (u0, u1, v0, v1) are split; ``r`` (6, n) uniform."""
    sides = jnp.stack([boxes[:, 1] - boxes[:, 0], boxes[:, 3] - boxes[:, 2]])
    width = style.corridor_width * (0.8 + 0.5 * r[0])
    # Corridors alternate in direction, so that each ends at the one before it; walls cut the longer side.
    along_u, corridor = _cut_direction(style, sides, width, r[1], level)
    side = jnp.where(along_u, sides[0], sides[1])
    low = jnp.where(along_u, boxes[:, 0], boxes[:, 2])
    margin = (style.room_size + corridor * width / 2) / side
    fraction = 0.5 + (r[2] - 0.5) * style.irregular * (1 - 2 * margin)
    # A hall much larger than a scan would show the robot nothing.
    hall = (r[3] < style.hall) & (sides.max(0) < LARGEST_HALL)
    other = jnp.where(along_u, boxes[:, 2] + boxes[:, 3], boxes[:, 0] + boxes[:, 1]) / 2
    slope = jnp.where((r[4] < style.slanted) & ~corridor, 0.8 * (r[5] - 0.5), 0.0)
    # A slanted cut must leave room at both of its ends.
    slope = jnp.clip(slope, *(sign * style.room_size / jnp.where(along_u, sides[1], sides[0]) for sign in (-1, 1)))
    split = alive & (margin < 0.5) & ~(hall & ~corridor)
    return Splits(split, along_u, low + fraction * side, other, slope, jnp.where(split & corridor, width / 2, 0.0))


def _cut_direction(style: Style, sides: Array, width: Array, chance: Array, level: Array) -> tuple[Array, Array]:
    """Whether each node is cut at one u, and whether by a corridor; ``sides`` (2, n) metres."""
    root_along_u = style.half[0] < style.half[1]
    alternate = root_along_u ^ (level % 2 == 1)
    needed = 2 * style.room_size + width
    corridor = (level < style.corridor_levels) & (jnp.where(alternate, sides[0], sides[1]) > needed)
    longer = sides[0] * (0.75 + 0.5 * chance) > sides[1]
    return jnp.where(corridor, alternate, longer), corridor


def _descend(labels: Array, splits: Splits, u: Array, v: Array, first: Array) -> Array:
    """Labels one level down, ``first`` that level's first label; corridor cells keep the label of their node."""
    node = jnp.clip(labels - first, 0, first - 1)
    split, along_u, cut, centre, slope, corridor = (value[node] for value in splits)
    across, along = (jnp.where(along_u, *pair) for pair in ((u, v), (v, u)))
    side = across - cut - slope * (along - centre)
    moves = (labels >= first) & split & ~(jnp.abs(side) < corridor)
    return jnp.where(moves, 2 * labels + (side > 0), labels)


def _children(boxes: Array, splits: Splits) -> Array:
    """Extents (2n, 4) of the two halves of every node."""
    low, high = splits.cut - splits.corridor, splits.cut + splits.corridor
    u0, u1, v0, v1 = boxes.T
    first = jnp.stack([u0, jnp.where(splits.along_u, low, u1), v0, jnp.where(splits.along_u, v1, low)], -1)
    second = jnp.stack([jnp.where(splits.along_u, high, u0), u1, jnp.where(splits.along_u, v0, high), v1], -1)
    return jnp.stack([first, second], axis=1).reshape(-1, 4)


def _lay_over(key: Key, style: Style, labels: Array, is_corridor: Array, u: Array, v: Array) -> tuple[Array, Array]:
    """Shapes that ignore the splits: a ring corridor, round rooms, slanted halls."""
    first = is_corridor.shape[0] - OVERLAYS
    for index, r in enumerate(jax.random.uniform(key, (OVERLAYS, 8))):
        size = jnp.where(index == 0, 0.45 + 0.3 * r[0], 0.12 + 0.25 * r[0])
        half = jnp.maximum(size * style.half * (0.7 + 0.3 * r[1:3]), style.room_size)
        centre = (2 * r[3:5] - 1) * jnp.maximum(style.half - half, 0.0)
        turn = jnp.where(r[6] < 3 * style.slanted, (r[6] / (3 * style.slanted) - 0.5) * jnp.pi / 2, 0.0)
        c, s = jnp.cos(turn), jnp.sin(turn)
        a = (c * (u - centre[0]) + s * (v - centre[1])) / half[0]
        b = (c * (v - centre[1]) - s * (u - centre[0])) / half[1]
        # An ellipse or a rectangle; both are 1 on their outline.
        level = jnp.where(r[5] < 0.5, jnp.sqrt(a**2 + b**2), jnp.maximum(jnp.abs(a), jnp.abs(b)))
        inner = jnp.where(index == 0, 1 - style.corridor_width / half.min(), 0.0)
        present = r[7] < jnp.where(index == 0, 0.2, 0.35)
        labels = jnp.where(present & (level < 1) & (level > inner), first + index, labels)
    return labels, is_corridor.at[first].set(True)


def _close_off(key: Key, style: Style, labels: Array, is_corridor: Array) -> Array:
    """Labels with some rooms turned into ``OUTSIDE``; never a corridor, never the largest region."""
    count = is_corridor.shape[0]
    sizes = jnp.zeros(count, jnp.int32).at[labels.ravel()].add(1).at[OUTSIDE].set(0)
    closed = (jax.random.uniform(key, (count,)) < style.void) & ~is_corridor
    closed = closed.at[jnp.argmax(sizes)].set(False)
    return jnp.where(closed[labels], OUTSIDE, labels)
