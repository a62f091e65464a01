"""Drawings, made with ezdxf on the spot, against geometry by hand and a slow test of every cell."""

from __future__ import annotations

import math

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dsom_jax.data import load_map, save_ros_map, se2
from dsom_jax.data.dxf import Drawing, load_drawing
from dsom_jax.data.log import Report
from dsom_jax.data.rasterize import enclosed, reachable, touched_cells
from dsom_jax.occupancy import OccupancyGrid, is_free
from tiny_drawing import ROOM, room, write
from tiny_world import grid as tiny_room


def load(tmp_path, draw, report=None, **fields) -> OccupancyGrid:
    return load_drawing(write(tmp_path / "plan.dxf", draw), Drawing(**fields), report)


def occupied_at(grid, points) -> np.ndarray:
    """Whether the cells under map-frame points (N, 2) are walls."""
    local = np.asarray(grid.to_grid(jnp.asarray(np.c_[points, np.zeros(len(points))], jnp.float32)))
    j, i = np.floor(local[:, :2].T / grid.resolution).astype(int)
    return np.asarray(grid.occupied)[i, j]


def free_at(grid, *points) -> list[bool]:
    return np.asarray(is_free(grid, jnp.asarray([[x, y, 0.0] for x, y in points]))).tolist()


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


def on_circle(centre, radius, degrees):
    angles = np.radians(degrees)
    return np.c_[centre[0] + radius * np.cos(angles), centre[1] + radius * np.sin(angles)]


@pytest.mark.parametrize("factor", [0.001, 1.0, 1000.0])
def test_curves_are_round_whatever_the_unit(tmp_path, factor):
    units = {0.001: "mm", 1.0: "m", 1000.0: "km"}[factor]
    path = write(tmp_path / "plan.dxf", lambda m: m.add_circle((0, 0), 9 / factor))
    grid = load_drawing(path, Drawing(resolution=0.1, units=units))
    i, j = np.nonzero(np.asarray(grid.occupied))
    local = (np.stack([j, i, 0 * i], -1) + 0.5) * 0.1
    reach = np.hypot(*np.asarray(grid.from_grid(jnp.asarray(local, jnp.float32)))[:, :2].T)
    # Half a diagonal of a cell, and the 3e-4 of a Bezier arc, and a tenth of a cell for flat pieces.
    assert np.abs(reach - 9).max() < 0.1 * math.sqrt(0.5) + 9 * 3e-4 + 0.01


def test_filled_shapes_and_double_lines_are_drawn_by_their_edges(tmp_path):
    def draw(msp):
        room(msp, [(-10, -10), (10, -10), (10, 10), (-10, 10)])
        # The corners of SOLID and TRACE come in the order of a Z.
        msp.add_solid([(-8, -8), (-5, -8), (-8, -5), (-5, -5)])
        msp.add_trace([(2, -8), (5, -8), (2, -5), (5, -5)])
        msp.add_3dface([(-8, 2, 0), (-5, 2, 1), (-5, 5, 2), (-8, 5, 1)])
        msp.add_mline([(2, 2), (8, 2)], dxfattribs={"scale_factor": 2.0, "justification": 1})
        msp.add_lwpolyline([(2, 7, 0.5), (8, 7, 0.5)], format="xys")
        msp.add_point((0, 0))

    report = Report()
    grid = load(tmp_path, draw, report)
    for x, y in ((-8, -8), (2, -8), (-8, 2)):
        edges = [(x, y + 1.5), (x + 3, y + 1.5), (x + 1.5, y), (x + 1.5, y + 3)]
        assert occupied_at(grid, edges).all() and not occupied_at(grid, [(x + 1.5, y + 1.2)]).any()
    # Two lines two metres apart, one on either side of the way.
    assert occupied_at(grid, [(5, 1), (5, 3), (5, 7)]).all() and not occupied_at(grid, [(5, 2), (5, 7.3)]).any()
    assert sorted(report.lines()) == [
        "1 POINT entities not drawn", "1 polylines with a width, of which the middle line is drawn",
    ]  # fmt: skip


@pytest.mark.parametrize("version", ["R12", "R2000", "R2018"])
def test_every_kind_of_line_is_where_it_should_be(tmp_path, version):
    def draw(msp):
        room(msp, [(-10, -10), (10, -10), (10, 10), (-10, 10)]) if version != "R12" else msp.add_polyline2d(
            [(-10, -10), (10, -10), (10, 10), (-10, 10)], close=True
        )
        msp.add_line((-8, -8, 0), (-5, -6, 3))  # seen from above
        msp.add_arc((0, 0), 3, 90, 200)
        msp.add_circle((6, 6), 2)
        # A bulge of 1 is half a circle to the right of the way, one of tan(angle / 4) an arc of that angle.
        msp.add_polyline2d([(-6, 4, 1), (-2, 4, 0)], format="xyb")
        if version != "R12":
            msp.add_lwpolyline([(2, -6, math.tan(math.pi / 8)), (4, -4, 0)], format="xyb")
            msp.add_ellipse((-6, -2), major_axis=(2, 0), ratio=0.5)
            msp.add_spline_control_frame([(2, 0), (4, 2), (6, 0), (8, 2)])

    grid = load_drawing(write(tmp_path / "plan.dxf", draw, version=version), Drawing(resolution=0.1, units="m"))
    t = np.linspace(0, 1, 50)[:, None]
    wanted = [
        (1 - t) * [-8, -8] + t * [-5, -6], on_circle((0, 0), 3, np.linspace(90, 200, 60)),
        on_circle((6, 6), 2, np.linspace(0, 360, 90)), on_circle((-4, 4), 2, np.linspace(180, 360, 60)),
    ]  # fmt: skip
    empty = [on_circle((0, 0), 3, np.linspace(-150, 80, 60)), on_circle((-4, 4), 2, np.linspace(10, 170, 60))]
    if version != "R12":
        # A quarter circle to the right from (2, -6) to (4, -4) is centred on (2, -4).
        wanted.append(on_circle((2, -4), 2, np.linspace(-90, 0, 40)))
        wanted.append(on_circle((0, 0), 1, np.linspace(0, 360, 80)) * [2, 1] + [-6, -2])
    nudges = 0.06 * np.array([(0, 0), (1, 0), (-1, 0), (0, 1), (0, -1)])
    for points in wanted:
        # Bezier arcs are within 3e-4 of their radius, flat pieces within a tenth of a cell.
        assert np.any([occupied_at(grid, points + nudge) for nudge in nudges], axis=0).all()
    for points in empty:
        assert occupied_at(grid, points).mean() < 0.1


def test_blocks_nested_turned_scaled_and_in_arrays(tmp_path):
    def draw(msp):
        blocks = msp.doc.blocks
        leg = blocks.new("LEG")
        leg.add_line((0, 0), (1, 0))
        table = blocks.new("TABLE")
        table.add_blockref("LEG", (0, 0))
        table.add_blockref("LEG", (0, 2), dxfattribs={"rotation": 90})
        room(msp, [(-20, -20), (20, -20), (20, 20), (-20, 20)])
        msp.add_blockref("TABLE", (5, 5), dxfattribs={"rotation": 180, "xscale": 2, "yscale": 2})
        array = msp.add_blockref("LEG", (-10, -10))
        array.dxf.row_count, array.dxf.column_count = 2, 3
        array.dxf.row_spacing, array.dxf.column_spacing = 4, 3

    grid = load(tmp_path, draw)
    # Turned half round and doubled: the first leg is from (5, 5) to (3, 5), the second from (5, 1) to (5, -1).
    assert occupied_at(grid, [(4.5, 5), (3.2, 5), (5, 0.5), (5, -0.8)]).all()
    assert not occupied_at(grid, [(5.5, 5), (5, 2), (2.5, 5)]).any()
    legs = [(-9.5 + 3 * c, -10 + 4 * r) for c in range(3) for r in range(2)]
    assert occupied_at(grid, legs).all() and not occupied_at(grid, [(-0.5, -10), (-8.5, -10), (-9.5, -2)]).any()


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
