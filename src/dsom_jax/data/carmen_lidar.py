"""Geometry and limits of the lidar behind a CARMEN log, which says little about either."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dsom_jax.data.documents import read_yaml
from dsom_jax.data.range_codes import detect_no_return
from dsom_jax.errors import UserError
from dsom_jax.lidar import LidarConfig

INCREMENT_DEG = {181: 1.0, 180: 1.0, 361: 0.5, 360: 0.5, 401: 0.25, 400: 0.25}
"""CARMEN's table for messages without angles (carmen_laser_guess_angle_increment); else 180 deg / (beams - 1)."""


NUMBERS = ("angle_min", "angle_increment", "range_min", "range_no_return")
"""Numeric fields of ``meta.yaml`` beside a log; ``mount`` and ``upside_down`` are read too."""


@dataclass(frozen=True)
class LaserConfig:
    """Geometry as a message gives it.

    Attributes:
        start_angle: bearing of the first beam, radians.
        resolution: bearing between beams, radians.
        maximum_range: metres; None where the message does not say.
    """

    start_angle: float
    resolution: float
    maximum_range: float | None


def guess_config(beams: int) -> LaserConfig:
    """CARMEN's own guess for FLASER and LASER: the first beam points to the right, -90 deg."""
    degrees = INCREMENT_DEG.get(beams) or 180.0 / max(beams - 1, 1)
    return LaserConfig(-math.pi / 2, math.radians(degrees), None)


def lidar_of(
    path: Path,
    ranges: np.ndarray,
    config: LaserConfig,
    params: dict[str, str],
    mount: np.ndarray | None,
    range_max: float | None,
) -> LidarConfig:
    """Lidar of scans (N, B): the caller's ``range_max``, then ``meta.yaml``, then the log's messages, then a guess."""
    meta = _meta(path.parent / "meta.yaml", ranges.shape[1])
    limit = range_max or _no_return(meta.get("range_no_return"), _stated_limit(config, params, ranges), ranges)
    longest = ranges[np.isfinite(ranges)].max(initial=0.0)
    offset = (_float(params.get("robot_frontlaser_offset")) or 0.0, 0.0, 0.0)
    pose = offset if mount is None else tuple(float(v) for v in mount)
    try:
        return LidarConfig(
            beams=ranges.shape[1],
            angle_min=float(meta.get("angle_min", config.start_angle)),
            angle_increment=float(meta.get("angle_increment", config.resolution)),
            range_min=float(meta.get("range_min", 0.0)),
            # Without any no-return value every reading is a wall.
            range_max=float(limit or max(longest + 0.01, 1.0)),
            mount=tuple(meta.get("mount", pose)),
            upside_down=bool(meta.get("upside_down", False)),
        )
    except (ValueError, TypeError) as error:
        raise UserError(f"{path}: {error}; put the right angles into meta.yaml beside the log") from None


def _no_return(described: float | None, stated: float | None, ranges: np.ndarray) -> float | None:
    """Where no-return begins: as ``meta.yaml`` describes (flicker included), else the lower of stated and detected."""
    detected = detect_no_return(ranges)
    if described is not None:
        return detected if detected is not None and described - 0.1 <= detected <= described else described
    return min((limit for limit in (stated, detected) if limit is not None), default=None)


def _meta(path: Path, beams: int) -> dict[str, Any]:
    """Fields of ``meta.yaml``, empty where there is none; its beams must be those of the log."""
    fields = read_yaml(path, "description of the log") if path.is_file() else {}
    if fields.get("beams", beams) != beams:
        raise UserError(
            f"{path}: beams = {fields['beams']}, but the scans of the log beside it have {beams}: "
            "wrong lidar for the log; correct beams and the angles or remove the file"
        )
    known = {name: fields[name] for name in (*NUMBERS, "mount", "upside_down") if name in fields}
    for name, value in known.items():
        wanted, right = ("a number", isinstance(value, int | float))
        if name == "mount":
            wanted = "[x, y, yaw] in metres and radians"
            right = isinstance(value, list) and len(value) == 3 and all(isinstance(v, int | float) for v in value)
        if not right:
            raise UserError(f"{path}: {name} = {value!r}: must be {wanted}")
    return known


def _stated_limit(config: LaserConfig, params: dict[str, str], ranges: np.ndarray) -> float | None:
    """Maximum range that the log states, if its readings respect it: many logs state one that does not hold."""
    for limit in (config.maximum_range, _float(params.get("robot_front_laser_max"))):
        if limit and limit > 0 and (ranges < limit).mean() > 0.5:
            return limit
    return None


def _float(text: str | None) -> float | None:
    try:
        return float(text) if text is not None else None
    except ValueError:
        return None
