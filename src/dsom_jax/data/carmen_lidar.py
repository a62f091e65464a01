"""Geometry and limits of the lidar behind a CARMEN log, which says little about either."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from msgspec import Meta

from dsom_jax.data.documents import fields_as, read_yaml
from dsom_jax.data.range_codes import ABSURD, detect_no_return
from dsom_jax.errors import UserError
from dsom_jax.lidar import LidarConfig

INCREMENT_DEG = {181: 1.0, 180: 1.0, 361: 0.5, 360: 0.5, 401: 0.25, 400: 0.25}
"""CARMEN's table for messages without angles (carmen_laser_guess_angle_increment); else 180 deg / (beams - 1)."""


Radians = Annotated[float, Meta(ge=-2 * math.pi - 1e-3, le=2 * math.pi + 1e-3)]
_Metres = Annotated[float, Meta(ge=-100, le=100)]


@dataclass(frozen=True)
class LogMeta:
    """Fields of ``meta.yaml`` beside a log, for what the log itself does not say; those left out are None.

    Attributes:
        beams: ranges in a scan; must be those of the log.
        angle_min, angle_increment: bearing of the first beam and between beams, radians.
        range_min, range_no_return: metres; from the second on a reading is no return.
        mount: pose (x, y, yaw) of the lidar on the base.
        upside_down: whether it hangs head down.
    """

    beams: Annotated[int | None, Meta(description="the whole number of ranges in a scan")] = None
    angle_min: Annotated[float | None, Meta(description="a number of radians")] = None
    angle_increment: Annotated[float | None, Meta(description="a number of radians, not 0")] = None
    range_min: Annotated[float | None, Meta(description="a number of metres")] = None
    range_no_return: Annotated[float | None, Meta(description="a number of metres")] = None
    mount: Annotated[
        tuple[_Metres, _Metres, Radians] | None,
        Meta(description="[x, y, yaw] in metres and radians, at most 100 m and one turn (90 deg is 1.5708)"),
    ] = None
    upside_down: Annotated[bool | None, Meta(description="true or false")] = None


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
    ranges = np.where(ranges < ABSURD, ranges, np.inf)
    meta = _meta(path.parent / "meta.yaml", ranges.shape[1])
    limit = range_max or _no_return(meta.range_no_return, _stated_limit(config, params, ranges), ranges)
    longest = ranges[np.isfinite(ranges)].max(initial=0.0)
    offset = (_float(params.get("robot_frontlaser_offset")) or 0.0, 0.0, 0.0)
    try:
        return LidarConfig(
            beams=ranges.shape[1],
            angle_min=_first(meta.angle_min, config.start_angle),
            angle_increment=_first(meta.angle_increment, config.resolution),
            range_min=_first(meta.range_min, 0.0),
            # Without any no-return value every reading is a wall.
            range_max=float(limit or max(longest + 0.01, 1.0)),
            mount=meta.mount or (offset if mount is None else (float(mount[0]), float(mount[1]), float(mount[2]))),
            upside_down=bool(meta.upside_down),
        )
    except (ValueError, TypeError) as error:
        raise UserError(f"{path}: {error}; put the right value into meta.yaml beside the log") from None


def _first(described: float | None, stated: float) -> float:
    """What ``meta.yaml`` says, or else the log."""
    return stated if described is None else described


def _no_return(described: float | None, stated: float | None, ranges: np.ndarray) -> float | None:
    """Where no-return begins: as ``meta.yaml`` describes (flicker included), else the lower of stated and detected."""
    detected = detect_no_return(ranges)
    if described is not None:
        return detected if detected is not None and described - 0.1 <= detected <= described else described
    return min((limit for limit in (stated, detected) if limit is not None), default=None)


def _meta(path: Path, beams: int) -> LogMeta:
    """Fields of ``meta.yaml``, empty where there is none; its beams must be those of the log."""
    meta = fields_as(LogMeta, read_yaml(path, "description of the log"), path) if os.path.lexists(path) else LogMeta()
    if meta.beams not in (None, beams):
        raise UserError(
            f"{path}: beams = {meta.beams}, but the scans of the log beside it have {beams}: "
            "wrong lidar for the log; correct beams and the angles or remove the file"
        )
    for name in ("angle_min", "angle_increment", "range_min", "range_no_return"):
        value = getattr(meta, name)
        if value is not None and (not math.isfinite(value) or (name == "angle_increment" and not value)):
            raise UserError(f"{path}: {name} = {value:g}: must be a finite number{', not 0' * (not value)}")
    return meta


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
