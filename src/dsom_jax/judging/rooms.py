"""The rooms of a map, and how often an answer is in the right one: what counts where walls are drawn metres off."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np
from scipy import ndimage

from dsom_jax.occupancy import OccupancyGrid

DOOR = 1.2
"""Metres: a passage narrower than this parts two rooms."""
_REACH = 0.5
"""Metres about a room within which a pose still counts as in it: into a doorpost, a wall, a thing that is not there."""


@dataclass(frozen=True)
class Rooms:
    """Attributes: labels (H, W), 1 and up, 0 in no room; the grid that they lie on; how many there are."""

    labels: np.ndarray
    grid: OccupancyGrid
    count: int


def rooms_of(grid: OccupancyGrid, door: float = DOOR) -> Rooms:
    """The free space of a map, parted where it is narrower than ``door`` metres.

    The watershed of the distance to the nearest cell that is not free (Bormann et al., ICRA 2016, "distance-based"):
    it is flooded from every patch whose distance is more than half a door, and from every free patch without one.
    """
    free = np.asarray(grid.free)
    # Without a rim, space that is free up to the edge of the map would count as endlessly wide.
    distance = ndimage.distance_transform_edt(np.pad(free, 1))[1:-1, 1:-1] * grid.resolution
    seeds, count = ndimage.label(distance > door / 2)
    patches, _ = ndimage.label(free)
    narrow = free & ~np.isin(patches, np.unique(patches[seeds > 0]))
    more, extra = ndimage.label(narrow)
    seeds = np.where(narrow, more + count, seeds)
    # Deep in the middle of a room is low ground, walls are the highest.
    depth = np.where(free, 65_000 * (1 - distance / max(distance.max(), grid.resolution)), 65_535)
    flooded = ndimage.watershed_ift(depth.astype(np.uint16), seeds.astype(np.int32))
    labels = np.where(free, flooded, 0)
    away, nearest = ndimage.distance_transform_edt(labels == 0, return_indices=True)
    labels = np.where(away * grid.resolution <= _REACH, labels[tuple(nearest)], 0) if labels.any() else labels
    return Rooms(labels, grid, count + extra)


def room_at(rooms: Rooms, poses: Any) -> np.ndarray:
    """Label (...) of the room that map-frame poses (..., 3) are in; 0 for none, and for poses that are not known."""
    local = np.asarray(rooms.grid.to_grid(jnp.asarray(poses)))
    known = np.isfinite(local).all(-1)
    cells = np.floor(np.where(known[..., None], local, -1.0)[..., :2] / rooms.grid.resolution).astype(int)
    column, row = cells[..., 0], cells[..., 1]
    height, width = rooms.labels.shape
    inside = known & (row >= 0) & (row < height) & (column >= 0) & (column < width)
    return np.where(inside, rooms.labels[np.where(inside, row, 0), np.where(inside, column, 0)], 0)


def in_right_room(rooms: Rooms, poses: Any, truth: Any) -> tuple[int, int]:
    """Updates of all runs with poses (R, T, 3) in the room of the truth (T, 3), and updates whose truth has a room."""
    here, there = room_at(rooms, poses), room_at(rooms, truth)
    judged = np.broadcast_to(there > 0, here.shape)
    return int((judged & (here == there)).sum()), int(judged.sum())
