"""The map that a bag brings along: nav_msgs/OccupancyGrid."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from dsom_jax.data.bag_file import listed, messages_of_topics, open_bag
from dsom_jax.data.files import check_near
from dsom_jax.data.log import Report
from dsom_jax.data.tf_tree import planar
from dsom_jax.errors import UserError
from dsom_jax.occupancy import OccupancyGrid, from_cells

GRID = "nav_msgs/msg/OccupancyGrid"
_OCCUPIED, _FREE = 65, 25
"""Percent from which on a cell is occupied and up to which it is free: what map_saver writes for the same message."""


def load_bag_map(path: Path, report: Report | None = None) -> OccupancyGrid:
    """The last map of a bag: of the topic that is no costmap, of several the one called ``map``."""
    with open_bag(path) as reader:
        topic = _topic(path, {c.topic: c.msgtype for c in reader.connections})
        message = _last(path, reader, topic, Report() if report is None else report)
    info = message.info
    cells = np.asarray(message.data, np.int16)
    if cells.size != info.width * info.height or not cells.size or not 0 < info.resolution < np.inf:
        size = f"{info.width} x {info.height} cells of {info.resolution:g} m with {cells.size} values"
        raise UserError(f"{path}: topic {topic}: no map: {size}; record it again")
    cells = cells.reshape(info.height, info.width)
    free = (cells >= 0) & (cells <= _FREE)
    if not free.any():
        raise UserError(f"{path}: topic {topic}: the map has no free cell; record it again when it is built")
    origin = planar(info.origin.position, info.origin.orientation)
    check_near(path, origin[:2], "record it in a nearer frame")
    return from_cells(
        jnp.asarray(cells >= _OCCUPIED), jnp.asarray(free), resolution=float(info.resolution), origin=origin
    )


def _topic(path: Path, topics: dict[str, str]) -> str:
    """Where the map is."""
    maps = sorted(topic for topic, kind in topics.items() if kind == GRID and "costmap" not in topic)
    called = [topic for topic in maps if topic.rsplit("/", 1)[-1] == "map"]
    if not maps:
        raise UserError(f"{path}: holds no map ({GRID.replace('/msg', '')}); {listed(topics)}")
    if len(maps) > 1 and len(called) != 1:
        named = "several of them" if called else "none of them"
        fix = "record one alone, or save it by nav2's map_saver"
        raise UserError(f"{path}: several maps, {named} called map: {', '.join(maps)}; {fix}")
    return called[0] if called else maps[0]


def _last(path: Path, reader: Any, topic: str, report: Report) -> Any:
    """The last map of a topic, of those that can be read."""
    last, count = None, 0
    for _, _, message in messages_of_topics(reader, [c for c in reader.connections if c.topic == topic], report):
        last, count = message, count + 1
    if last is None:
        why = f" that can be read ({'; '.join(report.lines())})" if report.counts else ""
        raise UserError(f"{path}: topic {topic} holds no map{why}; record it again")
    if count > 1:
        report.add(f"maps on {topic}, the last one is taken", count=count)
    return last
