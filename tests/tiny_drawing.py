"""Drawings that the tests make: a file by what is drawn in it, and a room of 6 m x 4 m."""

from __future__ import annotations

import ezdxf

ROOM = [(0, 0), (6, 0), (6, 4), (0, 4)]


def write(path, draw, units=6, version="R2010", layers=()):
    document = ezdxf.new(version, units=units)
    for name in layers:
        document.layers.add(name)
    draw(document.modelspace())
    document.saveas(path)
    return path


def room(msp, points=ROOM, **attributes):
    msp.add_lwpolyline(points, close=True, dxfattribs=attributes)
