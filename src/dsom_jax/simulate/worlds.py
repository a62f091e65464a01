"""Procedural buildings: ``make_world(key, config)``, pure, jittable, vmappable, with static shapes."""

from __future__ import annotations

import math
from dataclasses import dataclass

import jax
import jax.numpy as jnp

from dsom_jax import checks
from dsom_jax.occupancy import OccupancyGrid, from_cells
from dsom_jax.simulate.floorplan import Style, building_frame, room_labels
from dsom_jax.simulate.furnish import furnish
from dsom_jax.simulate.morphology import clear_of, components, grow, largest_component
from dsom_jax.simulate.walls import build_walls
from dsom_jax.types import Array, Key


@dataclass(frozen=True)
class WorldConfig:
    """What kinds of buildings are drawn; every building draws its own character within these.

    Attributes:
        cells: side of the square map, cells.
        resolution: metres per cell.
        room_size: smallest side of a room, metres, drawn from this interval per building.
        corridor_width: metres, drawn from this interval per building.
        corridors: probabilities of buildings with 0, 1, 2, 3 levels of corridors.
        door_width: metres, of narrow and of wide doors; rounded to an odd number of cells.
        hall: largest probability that a region stays undivided at a split.
        void: probability that a room is closed and unknown; some buildings take much more.
        merge: largest probability that the wall between two rooms is missing.
        slanted: largest fraction of walls that are not parallel to the building.
        curved: probability of a building with curved walls; the same again for a kinked one.
        rotated: probability that the building is turned against the map.
        symmetric: probability of a building whose splits are all in the middle.
        notched: probability of each of three notches in the outline.
        thick: probability of walls two cells thick.
        furniture: largest mean density of furniture in rooms, 0 to 1.
        pillars: largest probability that a room has pillars.
        shelves: largest probability that a stretch of wall carries something.
    """

    cells: int = 128
    resolution: float = 1 / 3
    room_size: tuple[float, float] = (2.2, 6.0)
    corridor_width: tuple[float, float] = (1.8, 3.8)
    corridors: tuple[float, float, float, float] = (0.2, 0.3, 0.35, 0.15)
    door_width: tuple[float, float] = (1.0, 1.67)
    hall: float = 0.3
    void: float = 0.12
    merge: float = 0.3
    slanted: float = 0.2
    curved: float = 0.2
    rotated: float = 0.6
    symmetric: float = 0.08
    notched: float = 0.3
    thick: float = 0.1
    furniture: float = 0.8
    pillars: float = 0.25
    shelves: float = 0.35

    def __post_init__(self) -> None:
        checks.count(self, "cells", 32)
        checks.within(self, "resolution", 0.05, 0.5, "give 0.05 to 0.5 metres per cell")
        checks.low_high(self, "room_size corridor_width door_width", 0.0)
        checks.share(self, "hall void merge slanted curved rotated symmetric notched thick furniture pillars shelves")
        levels = self.corridors
        if not (len(levels) == 4 and all(p >= 0 for p in levels) and abs(sum(levels) - 1) < 1e-6):
            raise ValueError(checks.message(self, "corridors", "give four probabilities that sum to one"))
        if self.room_size[0] < 4 * self.resolution or self.corridor_width[0] < 4 * self.resolution:
            raise ValueError("rooms and corridors need at least 4 cells; use finer cells")

    @property
    def depth(self) -> int:
        """Levels of splits: enough for rooms of about 4 m side."""
        return max(3, min(10, round(2 * math.log2(self.cells * self.resolution / 4.0))))

    @property
    def door_cells(self) -> tuple[int, int]:
        """Half widths of narrow and wide doors, cells beside the middle one."""
        narrow, wide = (max(1, round((width / self.resolution - 1) / 2)) for width in self.door_width)
        return narrow, wide


def make_world(key: Key, config: WorldConfig) -> OccupancyGrid:
    """A random building. Every free cell is 4-connected to every other and shares no edge with an occupied one.

    What cannot be reached (closed rooms, courtyards, the surroundings) is neither free nor occupied.
    """
    k_style, k_rooms, k_walls, k_things = jax.random.split(key, 4)
    style = draw_style(k_style, config)
    u, v = building_frame(style, *cell_centres(config))
    labels, is_corridor = room_labels(k_rooms, style, u, v, config.depth)
    walls, doorways = build_walls(k_walls, style, labels, is_corridor, config.door_cells)
    things = furnish(k_things, style, labels, is_corridor, walls, u, v) & ~doorways & (labels > 0)
    occupied = walls | (things & ~_blocked(labels, walls, things, is_corridor.shape[0]))
    free = largest_component(clear_of(occupied) & (labels > 0))
    occupied &= _seen_from(free, occupied)
    return from_cells(occupied, free, resolution=config.resolution)


def _seen_from(free: Array, occupied: Array) -> Array:
    """(H, W) bool, cells beside the open space that ``free`` belongs to: nobody maps the inside of closed rooms."""
    labels = components(~occupied)
    return grow(free | ((labels == labels.ravel()[jnp.argmax(free)]) & ~occupied), 2)


def _blocked(labels: Array, walls: Array, things: Array, count: int) -> Array:
    """(H, W) bool, cells of the rooms in which things cut a good part of the floor off; they are cleared."""
    floor = largest_component(clear_of(walls) & (labels > 0))
    lost = floor & clear_of(things) & ~largest_component(floor & clear_of(walls | things))
    shares = jnp.zeros((count, 2)).at[labels.ravel()].add(jnp.stack([lost.ravel(), floor.ravel()], -1))
    # Small pockets behind a table may stay; when whole rooms are cut off, every room with a pocket may be the cause.
    tolerated = jnp.where(lost.sum() > 0.05 * floor.sum(), 0.0, 0.15)
    return (shares[:, 0] > tolerated * shares[:, 1])[labels]


def cell_centres(config: WorldConfig) -> tuple[Array, Array]:
    """(x, y), each (H, W), of the cell centres, metres from the middle of the map."""
    ticks = (jnp.arange(config.cells) + 0.5 - config.cells / 2) * config.resolution
    y, x = jnp.meshgrid(ticks, ticks, indexing="ij")
    return x, y


def draw_style(key: Key, config: WorldConfig) -> Style:
    """The character of one building."""
    shape, bend, r, t = jnp.split(jax.random.uniform(key, (40,)), (16, 23, 35))
    turn, half, notches = _draw_outline(shape, config)
    levels = jnp.searchsorted(jnp.cumsum(jnp.asarray(config.corridors)), r[0] * 0.9999 * sum(config.corridors))
    # A sixth of the buildings with corridors are little else: their rooms are closed.
    mostly_closed = (levels > 0) & (r[1] < 1 / 6)
    return Style(
        turn=turn,
        half=half,
        notches=notches,
        bend=_draw_bend(bend, config),
        corridor_levels=levels,
        corridor_width=_between(config.corridor_width, r[2] ** 1.5),
        room_size=_between(config.room_size, r[3] ** 1.5),
        irregular=jnp.where(r[4] < config.symmetric, 0.0, 0.4 + 0.6 * r[5]),
        hall=config.hall * r[6] ** 2,
        slanted=config.slanted * r[7] ** 2,
        void=jnp.where(mostly_closed, 0.6, 2 * config.void * r[8]),
        merge=config.merge * r[9] ** 2,
        room_doors=0.4 * r[10],
        wide_doors=0.5 * r[11],
        thick=t[0] < config.thick,
        furniture=config.furniture * t[1],
        pillars=config.pillars * t[2] ** 2,
        shelves=config.shelves * t[3] ** 2,
    )


def _between(interval: tuple[float, float], fraction: Array) -> Array:
    return interval[0] + (interval[1] - interval[0]) * fraction


def _draw_outline(r: Array, config: WorldConfig) -> tuple[Array, Array, Array]:
    """Rotation, half extents (2,) and notches (3, 4) of the outline, from 16 uniform draws."""
    turn = jnp.where(r[0] < config.rotated, (2 * r[1] - 1) * jnp.pi / 4, 0.0)
    shape = jnp.stack([1.0, 0.45 + 0.55 * r[2]])
    shape = jnp.where(r[3] < 0.5, shape, shape[::-1])
    c, s = jnp.abs(jnp.cos(turn)), jnp.abs(jnp.sin(turn))
    needed = jnp.maximum(shape[0] * c + shape[1] * s, shape[0] * s + shape[1] * c)
    # Up to 15 % may be cut off by the border of the map.
    half = shape / needed * (0.85 + 0.3 * r[4]) * config.cells * config.resolution / 2
    present = r[5:8] < config.notched
    corner = jnp.where(r[8:14].reshape(3, 2) < 0.5, -1.0, 1.0) * half
    size = half * (0.15 + 0.35 * jnp.stack([r[13:16], r[10:13]], -1))
    notches = jnp.concatenate([corner, size], axis=-1)
    return turn, half, jnp.where(present[:, None], notches, jnp.nan)


def _draw_bend(r: Array, config: WorldConfig) -> Array:
    """(5,) amplitude, wavelength and phase of curved walls, slope and place of a kink, from 7 uniform draws."""
    amplitude = jnp.where(r[0] < config.curved, 0.4 + 1.4 * r[1], 0.0)
    kink = jnp.where(r[4] < config.curved, 1.2 * (r[5] - 0.5), 0.0)
    place = (r[6] - 0.5) * config.cells * config.resolution / 2
    return jnp.stack([amplitude, 12.0 + 20.0 * r[2], 2 * jnp.pi * r[3], kink, place])
