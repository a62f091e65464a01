"""Maps of ROS map_server: ``map.yaml`` beside a pgm or png. The only place where image rows are flipped.

Semantics of nav2_map_server (2025): a pixel's occupancy is its darkness in [0, 1], or its brightness with ``negate``;
``trinary``: occupancy >= occupied_thresh is occupied, <= free_thresh free, else unknown; ``scale``: what lies between
is stretched over 0..100 %; ``raw``: the pixel is the percentage itself, above 100 unknown; a pixel that is not opaque
is unknown in the first two. From percentages to cells the rule of amcl: 100 is occupied, 0 is free, all else unknown.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

import cv2
import numpy as np

from dsom_jax.atomic import write_atomic
from dsom_jax.data.files import check_near, read_bytes, read_yaml
from dsom_jax.data.log import Report
from dsom_jax.data.pgm import decode_pgm, encode_pgm
from dsom_jax.errors import UserError
from dsom_jax.occupancy import OccupancyGrid, from_cells

Unknown = Literal["blocked-for-robot", "opaque", "free"]
"""Unknown cells: no particles but transparent to rays (default); no particles and rays end; like free cells."""

MODES = ("trinary", "scale", "raw")
UNKNOWN = -1
GREY = 205
"""Of unknown pixels, as map_saver writes them: just above 0.196 in occupancy."""


@dataclass(frozen=True)
class MapInfo:
    """The fields of ``map.yaml``.

    Attributes:
        image: path of the image, resolved against the folder of the yaml.
        resolution: metres per pixel.
        origin: pose (x, y, yaw) of the lower-left corner of the lower-left pixel in the map frame (m, m, rad).
        occupied_thresh: occupancy from which on a pixel is occupied.
        free_thresh: occupancy up to which a pixel is free.
        negate: white is occupied, black is free.
        mode: trinary, scale or raw.
    """

    image: Path
    resolution: float
    origin: tuple[float, float, float]
    occupied_thresh: float
    free_thresh: float
    negate: bool
    mode: str


def load_ros_map(
    path: str | Path, unknown: Unknown = "blocked-for-robot", report: Report | None = None
) -> OccupancyGrid:
    """Grid (H, W) of a map_server yaml; ``unknown`` says what unknown cells are to robot and rays.

    ``report`` takes what is odd about it.
    """
    if unknown not in get_args(Unknown):
        raise UserError(f"unknown = {unknown!r}: choose one of {', '.join(get_args(Unknown))}")
    info = read_map_info(path)
    brightness, opaque = decode_image(info.image)
    if report is not None:
        report_grey(brightness, info, report)
    percent = occupancy_percent(brightness, opaque, info)[::-1]
    occupied, free = percent == 100, percent == 0
    blank = ~(occupied | free)
    if unknown == "opaque":
        occupied = occupied | blank
    elif unknown == "free":
        free = free | blank
    if not free.any():
        raise UserError(f"{path}: the map has no free cell; check negate ({int(info.negate)}) and free_thresh")
    return from_cells(occupied, free, resolution=info.resolution, origin=info.origin)


def read_map_info(path: str | Path) -> MapInfo:
    """Fields of a map yaml, checked."""
    fields = read_yaml(path, "map yaml")
    resolution = _number(path, fields, "resolution")
    if not (resolution > 0 and math.isfinite(resolution)):
        raise UserError(f"{path}: resolution = {resolution}: must be a positive number of metres per pixel")
    if not 1e-3 <= resolution <= 10:
        raise UserError(f"{path}: resolution = {resolution}: not metres per pixel of a building; give 0.001 to 10")
    occupied, free = _number(path, fields, "occupied_thresh"), _number(path, fields, "free_thresh")
    if not 0 <= free < occupied <= 1:
        raise UserError(
            f"{path}: free_thresh = {free}, occupied_thresh = {occupied}: need 0 <= free_thresh < occupied_thresh <= 1"
        )
    mode = str(fields.get("mode", "trinary")).lower()
    if mode not in MODES:
        raise UserError(f"{path}: mode = {mode!r}: choose one of {', '.join(MODES)}")
    image = str(_field(path, fields, "image"))
    return MapInfo(
        Path(path).parent / image, resolution, _origin(path, fields), occupied, free, _negate(path, fields), mode
    )


def _field(path: str | Path, fields: dict[str, Any], name: str) -> Any:
    if fields.get(name) is None:
        raise UserError(f"{path}: field '{name}' is missing; add a line '{name}: ...' as map_saver writes it")
    return fields[name]


def _number(path: str | Path, fields: dict[str, Any], name: str) -> float:
    value = _field(path, fields, name)
    try:
        # PyYAML reads 5e-2 as a string, ROS reads it as a number.
        return float(value)
    except (TypeError, ValueError):
        raise UserError(f"{path}: {name} = {value!r}: must be a number") from None


def _origin(path: str | Path, fields: dict[str, Any]) -> tuple[float, float, float]:
    value = _field(path, fields, "origin")
    try:
        x, y, yaw = (float(v) for v in value)
    except (TypeError, ValueError):
        raise UserError(f"{path}: origin = {value!r}: must be three numbers [x, y, yaw]") from None
    if not all(map(math.isfinite, (x, y, yaw))):
        raise UserError(f"{path}: origin = {value!r}: must be finite")
    check_near(path, (x, y), "take the same offset from the origin here and from the reference")
    return x, y, yaw


def _negate(path: str | Path, fields: dict[str, Any]) -> bool:
    value = _field(path, fields, "negate")
    if not isinstance(value, int):
        raise UserError(f"{path}: negate = {value!r}: must be 0 or 1")
    return bool(value)


def decode_image(path: Path) -> tuple[np.ndarray, np.ndarray | None]:
    """Brightness (H, W) in [0, 1], first row at the top, and where the image is opaque (H, W), None without alpha."""
    content = read_bytes(path, "map image (field 'image' of the yaml)")
    if content[:2] in (b"P2", b"P5"):
        return decode_pgm(content, path), None
    pixels = _decode_cv2(content)
    if pixels is None:
        raise UserError(f"{path}: not a readable image (field 'image'); give a pgm or png that map_saver wrote")
    scale = float(np.iinfo(pixels.dtype).max)
    if pixels.ndim == 2:
        return pixels / scale, None
    opaque = pixels[..., 3] == scale if pixels.shape[2] == 4 else None
    return pixels[..., :3].mean(-1) / scale, opaque


def _decode_cv2(content: bytes) -> np.ndarray | None:
    """Pixels of any image that OpenCV reads, None where it cannot; OpenCV's own messages are kept off the screen."""
    level = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        pixels = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED) if content else None
    except cv2.error:
        pixels = None
    finally:
        cv2.utils.logging.setLogLevel(level)
    return pixels if pixels is not None and np.issubdtype(pixels.dtype, np.unsignedinteger) else None


def occupancy_percent(brightness: np.ndarray, opaque: np.ndarray | None, info: MapInfo) -> np.ndarray:
    """Values of nav_msgs/OccupancyGrid: (H, W) integers 0..100, -1 unknown; rows as in the image."""
    if info.mode == "raw":
        value = np.rint(brightness * 255).astype(int)
        return np.where(value > 100, UNKNOWN, value)
    occupancy = brightness if info.negate else 1.0 - brightness
    between = np.full(occupancy.shape, UNKNOWN)
    if info.mode == "scale":
        between = np.rint((occupancy - info.free_thresh) / (info.occupied_thresh - info.free_thresh) * 100).astype(int)
    # Thresholds are written in decimals, pixels are n / 255: a last-bit difference must not decide.
    percent = np.where(occupancy >= info.occupied_thresh - 1e-9, 100, between)
    percent = np.where(occupancy <= info.free_thresh + 1e-9, 0, percent)
    return percent if opaque is None else np.where(opaque, percent, UNKNOWN)


def report_grey(brightness: np.ndarray, info: MapInfo, report: Report) -> None:
    """Note map_saver's grey for unknown where the thresholds make it free, as nav2's default of 0.25 does."""
    grey = np.isclose(brightness, GREY / 255)
    only = np.isin(np.rint(brightness * 255), (0, GREY, 254, 255)).all()
    taken_for_free = not info.negate and info.mode == "trinary" and info.free_thresh >= 1 - GREY / 255 - 1e-9
    if only and taken_for_free and grey.any() and not grey.all():
        report.add(
            f"pixels of grey {GREY}, which map_saver writes for unknown, are free cells by free_thresh = "
            f"{info.free_thresh:g}; if they are unknown, set free_thresh: 0.196 and load it again",
            count=int(grey.sum()),
        )


def save_ros_map(grid: OccupancyGrid, path: str | Path) -> None:
    """Write ``path`` (yaml) and the pgm of the same name beside it, trinary, as map_saver does."""
    path = Path(path)
    image = path.with_suffix(".pgm")
    pixels = np.full(grid.shape, GREY, np.uint8)
    pixels[np.asarray(grid.free)] = 254
    pixels[np.asarray(grid.occupied)] = 0
    origin = ", ".join(repr(float(v)) for v in np.asarray(grid.origin))
    text = (
        f"image: {image.name}\nmode: trinary\nresolution: {grid.resolution!r}\norigin: [{origin}]\n"
        "negate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"
    )
    # The image first: a yaml is never there without it.
    write_atomic(image, encode_pgm(pixels[::-1]))
    write_atomic(path, text.encode())
