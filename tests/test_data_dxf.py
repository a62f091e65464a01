"""Drawings, made with ezdxf on the spot, against geometry by hand and a slow test of every cell."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dsom_jax.data import load_map, save_ros_map, se2
from dsom_jax.data.dxf import Drawing, load_drawing
from dsom_jax.data.log import Report
from dsom_jax.data.rasterize import enclosed, reachable, touched_cells
from dsom_jax.errors import UserError
from tiny_drawing import ROOM, free_at, load, occupied_at, room, write
from tiny_world import grid as tiny_room


def room_to_cells(a, b, size: int) -> np.ndarray:
    """(size, size) signed room between a segment and each unit cell [i, j]: the least maximum-norm distance to its
    centre, minus 1/2. That norm is convex along a segment, so ternary search finds it."""
    centres = np.stack(np.meshgrid(np.arange(size), np.arange(size)), axis=-1) + 0.5
    low, high = np.zeros((size, size, 1)), np.ones((size, size, 1))
    norm = lambda t: np.abs(a + t * (b - a) - centres).max(-1, keepdims=True)  # noqa: E731
    for _ in range(60):
        left, right = low + (high - low) / 3, high - (high - low) / 3
        nearer = norm(left) <= norm(right)
        low, high = np.where(nearer, low, left), np.where(nearer, right, high)
    return norm((low + high) / 2)[..., 0] - 0.5


coordinate = st.floats(0.2, 7.8)


@given(coordinate, coordinate, coordinate, coordinate)
def test_cells_of_a_line_are_exactly_those_that_it_enters(x0, y0, x1, y1):
    a, b = np.array([x0, y0]), np.array([x1, y1])
    cells = touched_cells(np.array([[a, b]]), (8, 8))
    room = room_to_cells(a, b, 8)
    # A line that only grazes a cell may count or not.
    sure = np.abs(room) > 1e-6
    assert (cells == (room < 0))[sure].all() and sure.sum() > 48


def test_lines_leave_the_grid_and_points_are_lines():
    cells = touched_cells(np.array([[[-5.0, 1.5], [9.0, 1.5]], [[2.5, 3.5], [2.5, 3.5]]]), (4, 4))
    assert cells[1].all() and cells.sum() == 5 and cells[3, 2]


def test_reachable_and_enclosed_by_hand():
    walls = np.array([[c == "#" for c in row] for row in (
        "..........", ".########.", ".#..#.#.#.", ".#..#.#.#.", ".########.", "..........",
    )])  # fmt: skip
    inside = reachable(walls, (2, 2))
    assert inside.sum() == 4 and inside[2:4, 2:4].all()
    assert not reachable(walls, (1, 1)).any() and not reachable(walls, (99, 0)).any()
    assert reachable(walls, (0, 0)).sum() == 28
    # All closed regions, then those that are at least as wide as a cell and a half all round: none.
    assert enclosed(walls, 0.0).sum() == 8 and enclosed(walls, 1.0).sum() == 8 and not enclosed(walls, 1.5).any()


def test_a_room_in_metres(tmp_path):
    grid = load(tmp_path, room, resolution=0.25)
    assert grid.resolution == 0.25
    # Walls on round numbers run through the middle of cells: 25 x 17 cells touch the outline.
    assert int(grid.occupied.sum()) == 2 * 25 + 2 * 17 - 4
    assert int(grid.free.sum()) == 23 * 15
    assert free_at(grid, (0.2, 0.2), (5.8, 3.8), (-0.3, 2), (6.3, 2), (0.0, 2.0)) == [True, True, False, False, False]
    assert occupied_at(grid, [(0.05, 2), (5.95, 2), (3, 4.05), (3, -0.05)]).all()


@pytest.mark.parametrize(
    ("code", "units", "factor"),
    [
        (4, "", 0.001),
        (5, "", 0.01),
        (14, "", 0.1),
        (6, "", 1.0),
        (7, "", 1000.0),
        (2, "", 0.3048),
        (1, "", 0.0254),
        (10, "", 0.9144),
        (0, "m", 1.0),
        (4, "m", 1.0),
    ],
)
def test_units_of_the_drawing_or_as_told(tmp_path, code, units, factor):
    path = write(tmp_path / "plan.dxf", lambda m: room(m, [(x / factor, y / factor) for x, y in ROOM]), units=code)
    grid = load_drawing(path, Drawing(resolution=0.25, units=units))
    assert int(grid.free.sum()) == 23 * 15 and free_at(grid, (0.2, 0.2), (5.8, 3.8)) == [True, True]
    # The place to start from is in the drawing's unit, too.
    started = load_drawing(path, Drawing(resolution=0.25, units=units, start=(5 / factor, 1 / factor)))
    assert int(started.free.sum()) == 23 * 15


@pytest.fixture
def furnished(tmp_path):
    """A room on WALLS, a chair in a block on layer 0, inserted on FURNITURE, and lines on OFF and FROZEN layers."""

    def draw(msp):
        chair = msp.doc.blocks.new("CHAIR")
        chair.add_line((0, 0), (1, 0))
        chair.add_line((0, 1), (1, 1), dxfattribs={"layer": "WALLS"})
        room(msp, layer="WALLS")
        msp.add_blockref("CHAIR", (2, 2), dxfattribs={"layer": "FURNITURE"})
        msp.add_line((4, 1), (5, 1), dxfattribs={"layer": "OFF"})
        msp.add_line((4, 2), (5, 2), dxfattribs={"layer": "FROZEN"})
        msp.add_text("Aula", dxfattribs={"layer": "WALLS"})
        msp.doc.layers.get("OFF").off()
        msp.doc.layers.get("FROZEN").freeze()

    return write(tmp_path / "plan.dxf", draw, layers=("WALLS", "FURNITURE", "OFF", "FROZEN"))


@pytest.mark.parametrize(
    ("fields", "drawn"),
    [
        ({}, [True, True, False, False]),
        ({"layers": ("walls",)}, [False, True, False, False]),
        ({"exclude": ("FURN*",)}, [False, False, False, False]),
        ({"layers": ("WALLS", "OFF", "fro?en")}, [False, True, True, True]),
        ({"layers": ("*",), "exclude": ("OFF",)}, [True, True, False, True]),
    ],
)
def test_layers(furnished, fields, drawn):
    """Layer 0 in a block is the layer of the insertion; what is switched off is drawn only when it is named."""
    grid = load_drawing(furnished, Drawing(**fields))
    assert occupied_at(grid, [(2.5, 2), (2.5, 3), (4.5, 1), (4.5, 2)]).tolist() == drawn
    assert occupied_at(grid, [(0, 2), (6, 2)]).all()


def test_what_is_left_out_is_reported(furnished):
    report = Report()
    load_drawing(furnished, Drawing(), report)
    assert report.lines() == ["1 TEXT entities not drawn"]


def test_hidden_entities_and_blocks_that_are_not_there(tmp_path):
    def draw(msp):
        room(msp)
        msp.doc.layers.add("FROZEN").freeze()
        msp.doc.layers.add("OFF").off()
        msp.doc.blocks.new("CHAIR").add_line((0, 0), (1, 0), dxfattribs={"layer": "WALLS"})
        msp.add_blockref("CHAIR", (2, 1), dxfattribs={"layer": "FROZEN"})
        msp.add_blockref("CHAIR", (2, 2), dxfattribs={"layer": "OFF"})
        msp.add_line((2, 3), (3, 3), dxfattribs={"invisible": 1})
        msp.add_blockref("NOWHERE", (2, 3))

    report = Report()
    grid = load(tmp_path, draw, report)
    # As CAD programs do: a frozen insertion hides its block, one that is only switched off does not.
    assert occupied_at(grid, [(2.5, 1), (2.5, 2), (2.5, 3)]).tolist() == [False, True, False]
    assert sorted(report.lines()) == ["1 INSERT entities without their block", "1 invisible entities"]


def test_a_drawing_in_survey_coordinates_names_the_shift(tmp_path):
    far = [(x + 3512345.0, y + 5403210.0) for x, y in ROOM]
    with pytest.raises(UserError, match=r"single precision; move it in a yaml: pose: \[-35123\d\d, -54032\d\d, 0\]"):
        load(tmp_path, lambda msp: room(msp, far))
    grid = load(tmp_path, lambda msp: room(msp, far), pose=(-3512345.0, -5403210.0, 0.0))
    assert occupied_at(grid, [(0, 2), (6, 2)]).all() and free_at(grid, (3, 2)) == [True]


def test_free_is_the_inside_without_the_hollow_of_walls(tmp_path):
    def draw(msp):
        room(msp)
        room(msp, [(-0.3, -0.3), (6.3, -0.3), (6.3, 4.3), (-0.3, 4.3)])

    grid = load(tmp_path, draw, resolution=0.05)
    assert free_at(grid, (3, 2), (-0.15, 2), (3, 4.15), (-1, 2)) == [True, False, False, False]
    everything = load(tmp_path, draw, resolution=0.05, clearance=0.0)
    assert free_at(everything, (3, 2), (-0.15, 2), (3, 4.15), (-1, 2)) == [True, True, True, False]


def test_free_is_what_the_start_can_reach(tmp_path):
    def draw(msp):
        room(msp)
        msp.add_line((3, 0), (3, 4))

    assert free_at(load(tmp_path, draw), (1, 2), (5, 2)) == [True, True]
    assert free_at(load(tmp_path, draw, start=(1, 1)), (1, 2), (5, 2), (-0.15, 2)) == [True, False, False]
    # A start outside is no mistake: courtyards and drawings with open doors need it.
    assert free_at(load(tmp_path, draw, start=(-0.15, 1)), (1, 2), (-0.15, 2)) == [False, True]


def test_slanting_walls_are_tight(tmp_path):
    grid = load(tmp_path, lambda m: room(m, [(0, 0), (3, 1.7), (1.1, 4.9), (-2.3, 2.2)]), resolution=0.07)
    assert free_at(grid, (0.6, 2.2), (3.1, 0.2), (-2.2, 4)) == [True, False, False]


def test_crop_and_pose(tmp_path):
    pose = (10.0, -3.0, 0.7)
    path = write(tmp_path / "plan.dxf", lambda m: room(m, [(1000 * x, 1000 * y) for x, y in ROOM]), units=4)
    whole = load_drawing(path, Drawing(pose=pose))
    part = load_drawing(path, Drawing(pose=pose, crop=(2000, -1000, 9000, 2000), sight=1.0))
    for x, y in [(2.5, 1.0), (5.5, 1.5), (1.0, 1.0), (5.0, 3.0)]:
        place = se2.compose(np.array(pose), np.array([x, y, 0.0]))[:2]
        assert free_at(whole, place) == [True]
        assert free_at(part, place) == [x > 2 and y < 2]
        wall = se2.compose(np.array(pose), np.array([x, 0.0, 0.0]))[None, :2]
        # What is seen from the part belongs to it.
        assert occupied_at(whole, wall).all() and (x < 1 or occupied_at(part, wall).all())
    assert part.size == pytest.approx((5.2, 3.2), abs=0.11)
    # The origin is kept to float32, like that of every map.
    np.testing.assert_allclose(float(part.origin[2]), 0.7, atol=1e-6)


def test_maps_of_every_kind_through_one_door(tmp_path):
    write(tmp_path / "plan.dxf", room)
    (tmp_path / "plan.yaml").write_text("drawing: plan.dxf\nresolution: 0.25\nstart: [1, 1]\npose: [1, 2, 0]\n")
    assert load_map(tmp_path / "plan.dxf").resolution == 0.1
    grid = load_map(tmp_path / "plan.yaml")
    assert grid.resolution == 0.25 and free_at(grid, (2, 3), (0.5, 3)) == [True, False]
    save_ros_map(tiny_room(), tmp_path / "map.yaml")
    assert (np.asarray(load_map(tmp_path / "map.yaml").occupied) == np.asarray(tiny_room().occupied)).all()
