"""The map that a bag brings along: nav_msgs/OccupancyGrid."""

from __future__ import annotations

from pathlib import Path

import jax.numpy as jnp
import numpy as np

from dsom_jax.data.bag import choose, listed, open_bag
from dsom_jax.data.files import check_near
from dsom_jax.data.log import Report
from dsom_jax.data.tf_tree import planar
from dsom_jax.errors import UserError
from dsom_jax.occupancy import OccupancyGrid, from_cells

GRID = "nav_msgs/msg/OccupancyGrid"
OCCUPIED, FREE = 65, 25
"""Percent from which on a cell is occupied and up to which it is free: what map_saver writes for the same message."""


def load_bag_map(path: Path, report: Report | None = None) -> OccupancyGrid:
    """The last map of a bag: of the topic that is no costmap, of several the one called ``map``."""
    with open_bag(path) as reader:
        topics = {c.topic: c.msgtype for c in reader.connections}
        maps = {t: k for t, k in topics.items() if k == GRID and "costmap" not in t}
        if not maps:
            raise UserError(f"{path}: holds no map ({GRID.replace('/msg', '')}); {listed(topics)}")
        called = [topic for topic in maps if topic.rsplit("/", 1)[-1] == "map"]
        topic = called[0] if len(called) == 1 else choose(path, maps, (GRID,), None, "map")
        last, count = None, 0
        for connection, _, raw in reader.messages(connections=[c for c in reader.connections if c.topic == topic]):
            last, count = (raw, connection.msgtype), count + 1
        if last is None:
            raise UserError(f"{path}: topic {topic} holds no map; {listed(topics)}")
        message = reader.deserialize(*last)
    if report is not None and count > 1:
        report.add(f"maps on {topic}, the last one is taken", count=count)
    info = message.info
    cells = np.asarray(message.data, np.int16)
    if cells.size != info.width * info.height or not cells.size or not 0 < info.resolution < np.inf:
        size = f"{info.width} x {info.height} cells of {info.resolution:g} m with {cells.size} values"
        raise UserError(f"{path}: topic {topic}: no map: {size}; record it again")
    cells = cells.reshape(info.height, info.width)
    free = (cells >= 0) & (cells <= FREE)
    if not free.any():
        raise UserError(f"{path}: topic {topic}: the map has no free cell; record it again when it is built")
    origin = planar(info.origin.position, info.origin.orientation)
    check_near(path, origin[:2], "record it in a nearer frame")
    return from_cells(
        jnp.asarray(cells >= OCCUPIED), jnp.asarray(free), resolution=float(info.resolution), origin=origin
    )
