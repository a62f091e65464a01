"""Rooms of maps drawn by hand, and answers in the right one."""

from __future__ import annotations

import numpy as np
import pytest

from dsom_jax.judging.rooms import in_right_room, room_at, rooms_of
from dsom_jax.occupancy import from_cells

PLAN = (
    "####################",
    "#        #         #",
    "#        #         #",
    "#                  #",
    "#                  #",
    "#        #         #",
    "#        #         #",
    "####################",
    "####################",
    "#    ###############",
    "####################",
)


def drawn(resolution: float, origin=(0.0, 0.0, 0.0)):
    """The plan with row 0 at the bottom; the door is 2 cells wide, the closet at the bottom 1 by 4."""
    cells = np.array([[c == "#" for c in row] for row in PLAN[::-1]])
    return from_cells(cells, ~cells, resolution=resolution, origin=origin)


@pytest.mark.parametrize(("resolution", "count"), [(0.5, 3), (2.0, 2)])
def test_a_door_parts_two_rooms_and_a_wide_passage_does_not(resolution, count):
    # Two cells of 0.5 m are a door of 1 m, of 2 m a passage; the closet, narrower than any door, is a room as well.
    rooms = rooms_of(drawn(resolution))
    assert rooms.count == count
    left, right, closet = (rooms.labels[row, col] for row, col in ((7, 3), (7, 15), (1, 2)))
    assert (left != right) == (count == 3) and closet not in (left, right, 0)


def test_every_free_cell_has_a_room_and_walls_belong_to_what_is_near():
    grid = drawn(0.5)
    rooms = rooms_of(grid)
    assert (rooms.labels[np.asarray(grid.free)] > 0).all()
    # One cell into the outer wall is within half a metre, the middle of the thick wall below is not.
    assert rooms.labels[3, 3] == rooms.labels[4, 3] and rooms.labels[1, 15] == 0
    # The watershed runs through the door: cells left of it belong to the left.
    assert rooms.labels[7, 7] == rooms.labels[7, 3] and rooms.labels[7, 11] == rooms.labels[7, 15]


def test_rooms_are_looked_up_in_the_map_frame():
    grid = drawn(0.5, origin=(-4.0, 2.0, np.pi / 2))
    rooms = rooms_of(grid)
    # Cell (7, 3) has its centre at (1.75, 3.75) in the grid's frame; turned by 90 deg that is (-3.75, 1.75).
    pose = np.array([-4.0 - 3.75, 2.0 + 1.75, 0.3])
    assert room_at(rooms, pose) == rooms.labels[7, 3]
    assert room_at(rooms, np.full(3, np.nan)) == room_at(rooms, [99.0, 99.0, 0.0]) == 0


def test_share_of_updates_in_the_right_room():
    rooms = rooms_of(drawn(0.5))
    left, right, nowhere, unknown = [1.75, 3.75, 0.0], [7.75, 3.75, 0.0], [7.75, 0.75, 0.0], [np.nan] * 3
    truth = np.array([left, right, nowhere, unknown, left])
    poses = np.array([[left, left, left, left, unknown], [left, right, right, right, nowhere]])
    # Updates 0, 1 and 4 are judged, of two runs; an answer that is none is in no room.
    assert in_right_room(rooms, poses, truth) == (3, 6)


def test_a_map_without_free_space_has_no_rooms():
    cells = np.ones((4, 4), bool)
    rooms = rooms_of(from_cells(cells, ~cells, resolution=1.0))
    assert rooms.count == 0 and not rooms.labels.any()
