"""Drawings that the tests make: a file by what is drawn in it, and a room of 6 m x 4 m."""

from __future__ import annotations

import ezdxf
import jax.numpy as jnp
import numpy as np

from dsom_jax.data.dxf import Drawing, load_drawing
from dsom_jax.occupancy import OccupancyGrid, is_free

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


def load(tmp_path, draw, report=None, **fields) -> OccupancyGrid:
    return load_drawing(write(tmp_path / "plan.dxf", draw), Drawing(**fields), report)


def occupied_at(grid, points) -> np.ndarray:
    """Whether the cells under map-frame points (N, 2) are walls."""
    local = np.asarray(grid.to_grid(jnp.asarray(np.c_[points, np.zeros(len(points))], jnp.float32)))
    j, i = np.floor(local[:, :2].T / grid.resolution).astype(int)
    return np.asarray(grid.occupied)[i, j]


def free_at(grid, *points) -> list[bool]:
    return np.asarray(is_free(grid, jnp.asarray([[x, y, 0.0] for x, y in points]))).tolist()
