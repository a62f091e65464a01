"""Every kind of entity of a drawing, and blocks of them, where geometry says that they are."""

from __future__ import annotations

import math

import jax.numpy as jnp
import numpy as np
import pytest

from dsom_jax.data.dxf import Drawing, load_drawing
from dsom_jax.data.log import Report
from tiny_drawing import load, occupied_at, room, write


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
