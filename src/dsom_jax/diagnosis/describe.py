"""What is in a log and in a map: the numbers that one looks at first."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from dsom_jax.data import se2
from dsom_jax.data.bag_file import is_bag, open_bag
from dsom_jax.data.files import read_lines
from dsom_jax.data.log import RawLog, travelled
from dsom_jax.occupancy import OccupancyGrid


def describe_log(log: RawLog) -> dict[str, Any]:
    """Scans, beams, ranges, clock, odometry and reference of a log."""
    lidar = log.lidar
    return {
        "path": str(log.path), "scans": len(log), "beams": log.ranges.shape[1],
        "fov_deg": float(np.degrees(lidar.fov)), "angle_min_deg": float(np.degrees(lidar.angle_min)),
        "angle_increment_deg": float(np.degrees(lidar.angle_increment)),
        "range_min_m": lidar.range_min, "range_max_m": lidar.range_max,
        "mount": {"x_m": lidar.mount[0], "y_m": lidar.mount[1], "yaw_deg": float(np.degrees(lidar.mount[2])),
                  "upside_down": lidar.upside_down},
        "ranges": describe_ranges(log.ranges), "clock": describe_clock(log.stamps),
        "odometry": describe_odometry(log), "reference": describe_reference(log), "notes": log.report.lines(),
    }  # fmt: skip


def messages_of(path: Path) -> dict[str, int]:
    """Number of messages by topic and type (bags) or by kind (CARMEN), empty for other logs; the file is readable."""
    if path.is_file() and path.suffix.lower() in (".log", ".clf", ".gz"):
        words = (line.split(None, 1)[0] for line in read_lines(path, "log") if line.strip())
        return dict(Counter(word for word in words if word.isalnum() and word.isupper()).most_common())
    if not is_bag(path):
        return {}
    with open_bag(path) as reader:
        return {f"{topic} ({about.msgtype})": about.msgcount for topic, about in sorted(reader.topics.items())}


def describe_ranges(ranges: np.ndarray) -> dict[str, Any]:
    """Shares of the codes of REP-117, quantiles of the rest, and its most frequent value."""
    finite = ranges[np.isfinite(ranges)]
    shares = {
        "returns": finite.size / ranges.size, "no_return": float(np.isposinf(ranges).mean()),
        "too_close": float(np.isneginf(ranges).mean()), "invalid": float(np.isnan(ranges).mean()),
    }  # fmt: skip
    if not finite.size:
        return {"shares": shares}
    values, counts = np.unique(np.rint(finite * 100).astype(np.int64), return_counts=True)
    levels = (0, 5, 50, 95, 100)
    return {
        "shares": shares,
        "quantiles_m": {f"{q}": float(v) for q, v in zip(levels, np.percentile(finite, levels), strict=True)},
        "most_frequent_m": float(values[counts.argmax()] / 100), "its_share": float(counts.max() / finite.size),
    }  # fmt: skip


def describe_clock(stamps: np.ndarray) -> dict[str, Any]:
    """Duration, rate and gaps."""
    steps = np.diff(stamps)
    forward = steps[steps > 0]
    usual = float(np.median(forward)) if len(forward) else float("nan")
    return {
        "first_s": float(stamps[0]), "duration_s": float(stamps[-1] - stamps[0]), "rate_hz": 1 / usual,
        "longest_gap_s": float(steps.max(initial=0)), "not_newer": int((steps <= 0).sum()),
    }  # fmt: skip


def describe_odometry(log: RawLog) -> dict[str, Any]:
    """Way and turns, the share of steps without any, and the largest step."""
    moves = se2.relative(log.odometry[:-1], log.odometry[1:])
    far, turn = np.hypot(moves[:, 0], moves[:, 1]), np.abs(moves[:, 2])
    return {
        "travelled_m": travelled(log.odometry), "turned_deg": float(np.degrees(turn.sum())),
        "standing": float(((far < 1e-4) & (turn < 1e-4)).mean()) if len(moves) else float("nan"),
        "largest_step_m": float(far.max(initial=0)), "largest_turn_deg": float(np.degrees(turn.max(initial=0))),
    }  # fmt: skip


def describe_reference(log: RawLog) -> dict[str, Any] | None:
    """Which share of the scans has a reference pose, and the box in which they lie."""
    if log.reference is None:
        return None
    known = log.reference[np.isfinite(log.reference).all(1)]
    box = {"x_m": [float(known[:, 0].min()), float(known[:, 0].max())],
           "y_m": [float(known[:, 1].min()), float(known[:, 1].max())]} if len(known) else {}  # fmt: skip
    return {"scans": len(known) / max(len(log), 1), "travelled_m": travelled(log.reference), **box}


def describe_map(path: Path, grid: OccupancyGrid, notes: list[str]) -> dict[str, Any]:
    """Size, resolution, origin and what its cells are."""
    free, occupied = np.asarray(grid.free), np.asarray(grid.occupied)
    x, y, yaw = (float(v) for v in np.asarray(grid.origin))
    return {
        "path": str(path), "cells": list(grid.shape), "resolution_m": grid.resolution, "size_m": list(grid.size),
        "origin": [x, y, yaw], "free_m2": float(free.sum() * grid.resolution**2),
        "shares": {"free": float(free.mean()), "occupied": float(occupied.mean()),
                   "unknown": float((~free & ~occupied).mean())},
        "notes": notes,
    }  # fmt: skip
