"""Drawings and yamls of drawings that cannot be read: one line that names file, field and fix."""

from __future__ import annotations

import sys

import pytest

from dsom_jax.data import load_map
from dsom_jax.errors import UserError
from tiny_drawing import ROOM, room, write


@pytest.mark.parametrize(
    ("text", "fragments"),
    [
        ("drawing: 3", ["plan.yaml", "drawing = 3", "DXF file"]),
        ("drawing: nowhere.dxf", ["nowhere.dxf", "no such drawing"]),
        ("drawing: plan.dxf\nscale: 2", ["plan.yaml", "unknown field scale", "resolution"]),
        ("drawing: plan.dxf\nresolution: 0", ["plan.yaml", "resolution = 0.0", "positive"]),
        ("drawing: plan.dxf\nresolution: fine", ["plan.yaml", "resolution", "'fine'"]),
        ("drawing: plan.dxf\nunits: miles", ["plan.yaml", "units = 'miles'", "mm, cm"]),
        ("drawing: plan.dxf\nlayers: [1]", ["plan.yaml", "layers = [1]", "names"]),
        ("drawing: plan.dxf\nlayers: [NONE]", ["plan.dxf", "nothing to draw", "Defpoints"]),
        ("drawing: plan.dxf\nstart: [1]", ["plan.yaml", "start = [1]", "[x, y]"]),
        ("drawing: plan.dxf\nstart: [0, 0]", ["plan.dxf", "no free cell", "start = [0, 0]"]),
        ("drawing: plan.dxf\nstart: [99, 0]", ["plan.dxf", "start = [99, 0]", "outside"]),
        ("drawing: plan.dxf\nclearance: -1", ["plan.yaml", "clearance = -1.0"]),
        ("drawing: plan.dxf\nsight: -1", ["plan.yaml", "sight = -1.0"]),
        ("drawing: plan.dxf\nclearance: 9", ["plan.dxf", "no free cell", "start"]),
        ("drawing: plan.dxf\ncrop: [1, 2, 1, 4]", ["plan.yaml", "crop = [1, 2, 1, 4]", "x_min < x_max"]),
        ("drawing: plan.dxf\ncrop: [50, 50, 60, 60]", ["plan.dxf", "crop = [50, 50, 60, 60]", "units"]),
        ("drawing: plan.dxf\npose: [1, 2, true]", ["plan.yaml", "pose", "True"]),
        ("drawing: plan.dxf\nunits: km\n", ["plan.dxf", "cells", "units"]),
        ("drawing: unitless.dxf", ["unitless.dxf", "$INSUNITS = 0", "units: m"]),
        ("drawing: open.dxf", ["open.dxf", "no free cell", "gaps"]),
        ("drawing: words.dxf", ["words.dxf", "not a readable DXF"]),
        ("drawing: empty.dxf", ["empty.dxf", "is empty"]),
        ("drawing: plan.dwg", ["plan.dwg", "DWG", "save it as DXF"]),
        ("drawing: knot.dxf", ["knot.dxf", "block contains itself"]),
    ],
)
def test_spoilt_drawings_are_one_line(tmp_path, text, fragments, capfd):
    def knot(msp):
        msp.doc.blocks.new("KNOT").add_blockref("KNOT", (0, 0))
        msp.add_blockref("KNOT", (0, 0))

    write(tmp_path / "plan.dxf", room)
    write(tmp_path / "unitless.dxf", room, units=0)
    write(tmp_path / "open.dxf", lambda m: m.add_lwpolyline(ROOM))
    write(tmp_path / "knot.dxf", knot)
    (tmp_path / "words.dxf").write_text("to be or\nnot to be\n")
    (tmp_path / "empty.dxf").touch()
    (tmp_path / "plan.dwg").write_bytes(b"AC1027" + bytes(100))
    (tmp_path / "plan.yaml").write_text(text)
    capfd.readouterr()
    with pytest.raises(UserError) as error:
        load_map(tmp_path / "plan.yaml")
    assert all(fragment in str(error.value) for fragment in fragments), error.value
    assert "\n" not in str(error.value) and capfd.readouterr() == ("", "")


def test_without_ezdxf_the_extra_is_named(tmp_path, monkeypatch):
    path = write(tmp_path / "plan.dxf", room)
    monkeypatch.setitem(sys.modules, "ezdxf", None)
    with pytest.raises(UserError, match=r"dsom-jax\[drawings\]"):
        load_map(path)
