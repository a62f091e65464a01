"""Maps of ROS map_server: ``map.yaml`` beside a pgm or png. The only place where image rows are flipped.

Semantics of nav2_map_server (2025): a pixel's occupancy is its darkness in [0, 1], or its brightness with ``negate``;
``trinary``: occupancy >= occupied_thresh is occupied, <= free_thresh free, else unknown; ``scale``: what lies between
is stretched over 0..100 %; ``raw``: the pixel is the percentage itself, above 100 unknown; a pixel that is not opaque
is unknown in the first two. From percentages to cells the rule of amcl: 100 is occupied, 0 is free, all else unknown.
"""

from __future__ import annotations

import io
import math
import ntpath
import os
import warnings
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, get_args

import numpy as np
from msgspec import Meta
from PIL import Image

from dsom_jax.atomic import write_atomic
from dsom_jax.data.documents import fields_as, read_yaml
from dsom_jax.data.files import CELLS, check_near, read_bytes
from dsom_jax.data.log import Report
from dsom_jax.errors import UserError, one_line
from dsom_jax.occupancy import OccupancyGrid, from_cells

Unknown = Literal["blocked-for-robot", "opaque", "free"]
"""Unknown cells: no particles but transparent to rays (default); no particles and rays end; like free cells."""

FORMATS = ("PPM", "PNG", "BMP", "JPEG", "GIF", "TIFF", "WEBP")
"""Pictures that are read, as Pillow calls them; PPM is pgm as well."""
TRUTHS: dict[Any, bool] = {0: False, 1: True, "no": False, "yes": True, "off": False, "on": True}
"""What map_server takes for ``negate``."""
_UNKNOWN = -1
GREY = 205
"""Of unknown pixels, as map_saver writes them: just above 0.196 in occupancy."""
BLOCK = 1 << 22
"""Pixels that are looked at in one go, so that no copy is larger than the picture."""

Share = Annotated[float, Meta(ge=0, le=1)]
_Metres = Annotated[float, Meta(ge=-1e12, le=1e12)]
Yaw = Annotated[float, Meta(ge=-2 * math.pi, le=2 * math.pi)]


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

    image: Annotated[Path, Meta(description="the name of the picture, pgm or png, beside the yaml")]
    resolution: Annotated[float, Meta(ge=1e-3, le=10, description="a number of metres per pixel from 0.001 to 10")]
    origin: Annotated[
        tuple[_Metres, _Metres, Yaw],
        Meta(description="three numbers [x, y, yaw] in metres and radians, yaw within one turn: 90 deg is 1.5708"),
    ]
    occupied_thresh: Annotated[Share, Meta(description="a number from 0 to 1, such as 0.65")]
    free_thresh: Annotated[Share, Meta(description="a number from 0 to 1, such as 0.196")]
    negate: Annotated[bool, Meta(description="0 or 1")]
    mode: Annotated[
        Literal["trinary", "scale", "raw"], Meta(description="one of trinary, scale, raw, or left out for trinary")
    ] = "trinary"


def load_ros_map(
    path: str | Path, unknown: Unknown = "blocked-for-robot", report: Report | None = None
) -> OccupancyGrid:
    """Grid (H, W) of a map_server yaml; ``unknown`` says what unknown cells are to robot and rays.

    ``report`` takes what is odd about it.
    """
    if unknown not in get_args(Unknown):
        raise UserError(f"unknown = {unknown!r}: choose one of {', '.join(get_args(Unknown))}")
    report = Report() if report is None else report
    info = read_map_info(path, report)
    picture = decode_image(info.image)
    report_grey(picture, info, report)
    percent = occupancy_percent(picture, info)[::-1]
    occupied, free = percent == 100, percent == 0
    blank = ~(occupied | free)
    if unknown == "opaque":
        occupied = occupied | blank
    elif unknown == "free":
        free = free | blank
    if not free.any():
        raise UserError(f"{path}: the map has no free cell; check negate ({int(info.negate)}) and free_thresh")
    return from_cells(occupied, free, resolution=info.resolution, origin=info.origin)


def read_map_info(path: str | Path, report: Report | None = None) -> MapInfo:
    """Fields of a map yaml, checked; ``report`` takes what is odd about them."""
    report = Report() if report is None else report
    fields = read_yaml(path, "map yaml")
    negate, mode = fields.get("negate"), fields.get("mode", "trinary")
    fields |= {"negate": TRUTHS.get(negate, negate) if isinstance(negate, int | str) else negate}
    fields |= {"mode": mode.lower() if isinstance(mode, str) else mode}
    info = fields_as(MapInfo, {name: value for name, value in fields.items() if value is not None}, path)
    if info.free_thresh > info.occupied_thresh:
        raise UserError(
            f"{path}: free_thresh = {info.free_thresh}, occupied_thresh = {info.occupied_thresh}: "
            "need 0 <= free_thresh <= occupied_thresh <= 1"
        )
    check_near(path, info.origin[:2], "take the same offset from the origin here and from the reference")
    if abs(yaw := info.origin[2]) > math.pi:
        report.add(f"origin yaw of {yaw:g} is taken for radians, {math.degrees(yaw):.0f} deg")
    return replace(info, image=_image(Path(path), info.image, report))


def _image(path: Path, named: Path, report: Report) -> Path:
    """The picture that the yaml names, or that of the same name beside the yaml: absolute paths do not travel."""
    told = path.parent / os.path.expanduser(named)
    beside = path.parent / ntpath.basename(str(named))
    if os.path.isfile(told) or not os.path.isfile(beside):
        return told
    report.add(f"image {one_line(str(named), 120)} is not there: {beside.name} beside the yaml is taken")
    return beside


class Picture(NamedTuple):
    """Pixels (H, W) as whole numbers from 0 (black) to ``top``, first row at the top, and where it is opaque (H, W);
    None for a picture without alpha."""

    pixels: np.ndarray
    top: int
    opaque: np.ndarray | None = None


def decode_image(path: Path) -> Picture:
    """The picture of a map; one that is damaged or cut off is refused, even where a part could be shown."""
    content = read_bytes(path, "map image (field 'image' of the yaml)")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            # PNG checks its sums only when asked to.
            Image.open(io.BytesIO(content), formats=FORMATS).verify()
            with Image.open(io.BytesIO(content), formats=FORMATS) as image:
                if image.width * image.height > CELLS:
                    raise Image.DecompressionBombError(f"{image.width} x {image.height} pixels")
                return _picture(image)
    except Image.DecompressionBombError as error:
        raise UserError(f"{path}: is too large ({error}), the limit is {CELLS:,} pixels; crop or shrink it") from None
    except MemoryError:
        raise
    except Exception as error:
        # A damaged picture surfaces as whatever its decoder raises: OSError, SyntaxError, ValueError, struct.error, ...
        cause = one_line(str(error).replace(str(io.BytesIO), ""), 120) or type(error).__name__
        raise UserError(
            f"{path}: not a readable image (field 'image'): {cause}; give a whole pgm or png, as map_saver writes them"
        ) from None


def _picture(image: Image.Image) -> Picture:
    """Grey levels of any picture: colours count by their mean."""
    if "transparency" in image.info or image.mode in ("P", "PA"):
        image = image.convert("RGBA" if "transparency" in image.info or image.mode == "PA" else "RGB")
    elif image.mode in ("1", "CMYK", "YCbCr", "LAB", "HSV", "RGBX"):
        image = image.convert("L" if image.mode == "1" else "RGB")
    if image.mode == "L":
        return Picture(np.asarray(image), 255)
    if image.mode.startswith("I"):
        pixels = np.asarray(image)
        if pixels.min() < 0 or pixels.max() > 65535:
            raise ValueError("its pixels have more than 16 bits")
        return Picture(pixels.astype(np.uint16), 65535)
    if image.mode not in ("LA", "RGB", "RGBA"):
        raise ValueError(f"pixels of kind {image.mode}")
    colours = [band for band in image.getbands() if band != "A"]
    total = np.zeros((image.height, image.width), np.uint16)
    for band in colours:
        total += np.asarray(image.getchannel(band))
    opaque = np.asarray(image.getchannel("A")) == 255 if "A" in image.getbands() else None
    return Picture(total, 255 * len(colours), opaque)


def occupancy_percent(picture: Picture, info: MapInfo) -> np.ndarray:
    """Values of nav_msgs/OccupancyGrid: (H, W) int8 0..100, -1 unknown; rows as in the image."""
    of_level = _percent(np.arange(picture.top + 1) / picture.top, info).astype(np.int8)
    percent = np.empty(picture.pixels.shape, np.int8)
    for rows in _blocks(picture.pixels):
        percent[rows] = of_level[picture.pixels[rows]]
    if picture.opaque is not None and info.mode != "raw":
        percent[~picture.opaque] = _UNKNOWN
    return percent


def _percent(brightness: np.ndarray, info: MapInfo) -> np.ndarray:
    """Percentages (N,) of levels of brightness (N,) in [0, 1]."""
    if info.mode == "raw":
        value = np.rint(brightness * 255).astype(int)
        return np.where(value > 100, _UNKNOWN, value)
    occupancy = brightness if info.negate else 1.0 - brightness
    between = np.full(occupancy.shape, _UNKNOWN)
    span = info.occupied_thresh - info.free_thresh
    if info.mode == "scale" and span:
        between = np.rint((occupancy - info.free_thresh) / span * 100).clip(0, 100).astype(int)
    # Thresholds are written in decimals, pixels are n / 255: a last-bit difference must not decide.
    percent = np.where(occupancy <= info.free_thresh + 1e-9, 0, between)
    return np.where(occupancy >= info.occupied_thresh - 1e-9, 100, percent)


def _blocks(pixels: np.ndarray) -> list[slice]:
    """Rows in parts of about :data:`BLOCK` pixels."""
    step = max(1, BLOCK // pixels.shape[1])
    return [slice(first, first + step) for first in range(0, pixels.shape[0], step)]


def report_grey(picture: Picture, info: MapInfo, report: Report) -> None:
    """Note map_saver's grey for unknown where the thresholds make it free, as nav2's default of 0.25 does."""
    taken_for_free = not info.negate and info.mode == "trinary" and info.free_thresh >= 1 - GREY / 255 - 1e-9
    if not taken_for_free:
        return
    counts = np.zeros(picture.top + 1, int)
    for rows in _blocks(picture.pixels):
        counts += np.bincount(picture.pixels[rows].ravel(), minlength=len(counts))
    levels = np.arange(len(counts)) / picture.top
    only = np.isin(np.rint(levels[counts > 0] * 255), (0, GREY, 254, 255)).all()
    grey = int(counts[np.isclose(levels, GREY / 255)].sum())
    if only and 0 < grey < picture.pixels.size:
        report.add(
            f"pixels of grey {GREY}, which map_saver writes for unknown, are free cells by free_thresh = "
            f"{info.free_thresh:g}; if they are unknown, set free_thresh: 0.196 and load it again",
            count=grey,
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
    content = io.BytesIO()
    Image.fromarray(pixels[::-1]).save(content, "PPM")
    write_atomic(image, content.getvalue())
    write_atomic(path, text.encode())
