"""Floor plans as DXF drawings (Rawseeds calls them executive drawings), through ``ezdxf``.

Drawn are LINE, LWPOLYLINE and POLYLINE (bulges included), ARC, CIRCLE, ELLIPSE, SPLINE, SOLID, TRACE, 3DFACE, MLINE and
whatever of these stands in blocks (INSERT, nested, scaled, in arrays), seen from above; the rest (text, dimensions,
hatches) is counted and left out. Layers that are switched off or frozen are left out unless they are named.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np

from dsom_jax.data import se2
from dsom_jax.data.files import CELLS, MB, check_near, hushed, read_bytes
from dsom_jax.data.log import Report
from dsom_jax.data.rasterize import enclosed, reachable, touched_cells
from dsom_jax.errors import UserError, one_line, shown
from dsom_jax.occupancy import OccupancyGrid, from_cells

UNITS = {"mm": 0.001, "cm": 0.01, "dm": 0.1, "m": 1.0, "km": 1000.0, "in": 0.0254, "ft": 0.3048, "yd": 0.9144}
"""Metres."""
INSUNITS = {1: "in", 2: "ft", 4: "mm", 5: "cm", 6: "m", 7: "km", 10: "yd", 14: "dm"}
"""Codes of the header variable $INSUNITS (DXF reference); 0 says nothing."""
_DRAWN = ("LINE", "LWPOLYLINE", "POLYLINE", "ARC", "CIRCLE", "ELLIPSE", "SPLINE", "SOLID", "TRACE", "3DFACE")
MAX_SIDE = 100_000
"""Cells along one side of a map."""
MAX_INSERTED, MAX_LINES = 250_000, 1_000_000
"""Entities that come out of blocks, and pieces of lines, in one drawing."""
MARGIN = 2
"""Cells around the drawing, so that what is outside hangs together."""


@dataclass(frozen=True)
class Drawing:
    """How a drawing becomes a map: the fields of a yaml beside ``drawing: plan.dxf``.

    Attributes:
        resolution: metres per cell.
        units: unit of the drawing's coordinates (mm, cm, dm, m, km, in, ft, yd); empty: what the drawing says.
        layers: names of the layers to draw, with * and ?; empty: all that are visible.
        exclude: names of layers to leave out, together with the blocks that are inserted on them.
        start: (x, y) in the drawing's own coordinates: free is what can be reached from there. Empty: the inside.
        clearance: metres; without ``start``, a closed region is floor if it is somewhere that far from every line.
        crop: (x_min, y_min, x_max, y_max) in the drawing's own coordinates: the part where the robot is; empty: all.
        sight: metres around ``crop`` whose walls are kept, as they are seen from inside of it.
        pose: (x, y, yaw) of the drawing's frame in the map frame, metres and radians.
    """

    resolution: float = 0.1
    units: str = ""
    layers: tuple[str, ...] = ()
    exclude: tuple[str, ...] = ()
    start: tuple[float, ...] = ()
    clearance: float = 0.3
    crop: tuple[float, ...] = ()
    sight: float = 10.0
    pose: tuple[float, ...] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        if not 1e-3 <= self.resolution <= 10:
            raise ValueError(f"resolution = {self.resolution}: must be a positive number of metres, 0.001 to 10")
        for name in ("clearance", "sight"):
            if not (getattr(self, name) >= 0 and math.isfinite(getattr(self, name))):
                raise ValueError(f"{name} = {getattr(self, name)}: must be metres, not negative")
        if self.units and self.units not in UNITS:
            raise ValueError(f"units = {shown(self.units)}: choose one of {', '.join(UNITS)}")
        for name in ("layers", "exclude"):
            if not all(isinstance(layer, str) for layer in getattr(self, name)):
                raise ValueError(f"{name} = {shown(list(getattr(self, name)))}: must be a list of names of layers")
        for name, wanted in (("start", "x, y"), ("crop", "x_min, y_min, x_max, y_max"), ("pose", "x, y, yaw")):
            _check_numbers(name, getattr(self, name), wanted, optional=name != "pose")
        if not abs(self.pose[2]) <= 2 * math.pi + 1e-3:
            raise ValueError(f"pose = {list(self.pose)}: yaw is in radians, within a turn (90 deg is 1.5708)")
        if self.crop and not (self.crop[0] < self.crop[2] and self.crop[1] < self.crop[3]):
            raise ValueError(f"crop = {list(self.crop)}: need x_min < x_max and y_min < y_max")


def _check_numbers(name: str, values: Any, wanted: str, optional: bool) -> None:
    """ValueError unless ``values`` are as many finite numbers as ``wanted`` names."""
    numbers = all(isinstance(v, int | float) and not isinstance(v, bool) and math.isfinite(v) for v in values)
    if not (numbers and len(values) == wanted.count(",") + 1) and not (optional and not len(values)):
        raise ValueError(f"{name} = {shown(list(values))}: must be [{wanted}]")


def load_drawing(path: str | Path, drawing: Drawing | None = None, report: Report | None = None) -> OccupancyGrid:
    """Grid of a DXF file: lines are occupied, free is the inside or what ``drawing.start`` can reach, the rest unknown.

    Cells lie so that walls on round coordinates run through the middle of cells: neither side gains. ``report`` takes
    what was left out.
    """
    path, drawing, report = Path(path), drawing or Drawing(), report if report is not None else Report()
    segments, scale = _lines(path, drawing, report)
    corner, shape = _extent(path, segments, drawing.resolution)
    occupied = touched_cells((segments - corner) / drawing.resolution, shape)
    free = _floor(path, occupied, drawing, scale, corner)
    return _grid(path, occupied, free, drawing, scale, corner)


def _lines(path: Path, drawing: Drawing, report: Report) -> tuple[np.ndarray, float]:
    """Segments (N, 2, 2) of a file in metres, and what one unit of its coordinates is in metres."""
    try:
        with hushed("ezdxf"):
            document = _open(path)
            scale = _metres_per_unit(path, document, drawing.units)
            _check_expansion(path, document, drawing)
            parts, count = [], 0
            for part in _segments(document, drawing, drawing.resolution / scale, report):
                parts.append(part)
                count += len(part)
                if count > MAX_LINES:
                    raise UserError(f"{path}: more than {MAX_LINES:,} pieces of lines; exclude layers, crop it in CAD")
            if not count:
                names = ", ".join(sorted(layer.dxf.name for layer in document.layers))
                raise UserError(f"{path}: nothing to draw; layers are {names}: check layers and exclude")
    except (UserError, MemoryError):
        raise
    except Exception as error:
        # Broken files surface as whatever the tag in question raises: DXF errors, ValueError, KeyError, ...
        cause = one_line(str(error), 120) or "broken tags"
        raise UserError(f"{path}: not a readable DXF drawing ({cause}); save it again as DXF") from None
    return scale * np.concatenate(parts), scale


def _open(path: Path) -> Any:
    """The ezdxf document of a file, repaired where it has to be."""
    try:
        import ezdxf
        from ezdxf import recover
    except ImportError:
        raise UserError(f"{path}: reading drawings needs ezdxf; run: pip install 'dsom-jax[drawings]'") from None
    content = read_bytes(path, "drawing", 100 * MB)
    if content[:2] == b"AC" and content[2:6].isdigit():
        raise UserError(f"{path}: is a DWG, not a DXF; save it as DXF in a CAD program")
    if not content.strip():
        raise UserError(f"{path}: is empty, not a DXF drawing; copy it again")
    try:
        return ezdxf.readfile(path)
    except Exception:  # what it is will be said by the second reader, which repairs where it can
        return recover.readfile(path)[0]


def _check_expansion(path: Path, document: Any, drawing: Drawing) -> None:
    """UserError if blocks, with what is inserted in them, and arrays of them stand for too many entities."""
    inserts = [
        entity for entity in document.modelspace().query("INSERT") if not _matches(entity.dxf.layer, drawing.exclude)
    ]
    try:
        count = _expanded(inserts, {})
    except RecursionError:
        count = math.inf
    if count == math.inf:
        raise UserError(f"{path}: a block contains itself; repair the drawing in a CAD program")
    if count > MAX_INSERTED:
        raise UserError(
            f"{path}: its blocks and arrays stand for {count:.1e} entities, the limit is {MAX_INSERTED:,}; "
            "exclude the layer they are inserted on, or repair the drawing in a CAD program"
        )


def _expanded(entities: Any, sizes: dict[str, float]) -> float:
    """How many entities ``entities`` are once blocks are expanded; infinitely many where one contains itself.

    ``sizes`` keeps what is known of each block, so that the work is that of the file, not of what it stands for.
    """
    total = 0.0
    for entity in entities:
        if entity.dxftype() != "INSERT":
            total += 1
            continue
        name = str(entity.dxf.get("name", "")).lower()
        if name not in sizes:
            sizes[name] = math.inf  # until it is known: whoever asks meanwhile is inside of it
            block = entity.block()
            sizes[name] = 0.0 if block is None else _expanded(block, sizes)
        if sizes[name]:
            total += max(1, entity.mcount) * sizes[name]
    return total


def _metres_per_unit(path: Path, document: Any, units: str) -> float:
    """What one unit of the coordinates is in metres."""
    code = document.header.get("$INSUNITS", 0)
    if not units and code not in INSUNITS:
        raise UserError(
            f"{path}: does not say its unit ($INSUNITS = {shown(code)}); "
            f"name it in a yaml: drawing: {path.name}, units: m"
        )
    return UNITS[units or INSUNITS[code]]


def _segments(document: Any, drawing: Drawing, cell: float, report: Report) -> Iterator[np.ndarray]:
    """Line segments (N, 2, 2) of each entity in the drawing's coordinates; curves are within a tenth of a cell."""
    from ezdxf import path as paths

    for entity in _visible(document, document.modelspace(), drawing, report, layer=None):
        try:
            # Arcs come as Bezier curves, exact to 3e-4 of their radius.
            curve = paths.make_path(entity)
            ends = _plane(curve.control_vertices())
            if np.isfinite(ends).all() and np.ptp(ends, axis=0).max(initial=0) <= MAX_SIDE * cell:
                ends = _plane(curve.flattening(0.1 * cell))
        except MemoryError:
            raise
        except Exception:
            # What is missing or mistyped in an entity surfaces as any kind of error.
            report.add(f"{entity.dxftype()} entities that cannot be drawn")
            continue
        if not np.isfinite(ends).all():
            report.add(f"{entity.dxftype()} entities without finite coordinates")
            continue
        yield np.stack([ends[:-1], ends[1:]], axis=1)


def _plane(points: Any) -> np.ndarray:
    """(N, 2) points seen from above."""
    return np.array([(p.x, p.y) for p in points], float).reshape(-1, 2)


def _visible(document: Any, entities: Any, drawing: Drawing, report: Report, layer: str | None) -> Iterator[Any]:
    """Entities that can be drawn on layers that shall be; ``layer`` is that of the block they stand in."""
    for entity in entities:
        own = entity.dxf.get("layer", "0")
        # Inside of a block, layer 0 means the layer on which the block is inserted.
        name = layer if layer is not None and own == "0" else own
        if _matches(name, drawing.exclude):
            continue
        kind = entity.dxftype()
        if entity.dxf.get("invisible", 0):
            report.add("invisible entities")
        elif kind == "INSERT":
            if entity.block() is None:
                report.add("INSERT entities without their block")
                continue
            if not drawing.layers and _is_frozen(document, name):
                continue
            for single in entity.multi_insert() if entity.mcount > 1 else [entity]:
                yield from _visible(document, single.virtual_entities(), drawing, report, name)
        elif not (_matches(name, drawing.layers) if drawing.layers else _is_on(document, name)):
            continue
        elif kind == "MLINE":
            yield from _visible(document, entity.virtual_entities(), drawing, report, name)
        elif kind in _DRAWN:
            if kind == "LWPOLYLINE" and entity.has_width:
                report.add("polylines with a width, of which the middle line is drawn")
            yield entity
        else:
            report.add(f"{kind} entities not drawn")


def _matches(layer: str, patterns: tuple[str, ...]) -> bool:
    """Whether a layer is one of those named; names of layers know no case."""
    return any(fnmatch(layer.lower(), pattern.lower()) for pattern in patterns)


def _is_on(document: Any, layer: str) -> bool:
    """Whether a layer is shown; layers without an entry are."""
    if layer not in document.layers:
        return True
    entry = document.layers.get(layer)
    return entry.is_on() and not entry.is_frozen()


def _is_frozen(document: Any, layer: str) -> bool:
    """Whether a layer is frozen: what is inserted on it is hidden whole, on whatever layers its parts are."""
    return layer in document.layers and document.layers.get(layer).is_frozen()


def _extent(path: Path, segments: np.ndarray, resolution: float) -> tuple[np.ndarray, tuple[int, int]]:
    """Lower-left corner (2,) in metres and shape of the grid around all lines."""
    low, high = segments.min((0, 1)) / resolution, segments.max((0, 1)) / resolution
    first = np.round(low) - MARGIN - 0.5
    width, height = (math.ceil(min(side, 1e12)) + MARGIN for side in (high - first).tolist())
    if max(width, height) > MAX_SIDE or width * height > CELLS:
        metres = " m x ".join(f"{side * resolution:.6g}" for side in (width, height))
        raise UserError(
            f"{path}: {metres} m at resolution = {resolution} m is {width * height:.1e} cells; check units, exclude "
            "the layer of what lies far away, or give a coarser resolution"
        )
    return first * resolution, (height, width)


def _floor(path: Path, occupied: np.ndarray, drawing: Drawing, scale: float, corner: np.ndarray) -> np.ndarray:
    """(H, W) cells on which the robot may stand."""
    if not drawing.start:
        free = enclosed(occupied, drawing.clearance / drawing.resolution)
        fix = "the outline has gaps: give start = [x, y] inside, or draw the layer of the doors"
    else:
        cell = np.floor((scale * np.array(drawing.start) - corner) / drawing.resolution).clip(-1, MAX_SIDE)
        free = reachable(occupied, (int(cell[1]), int(cell[0])))
        fix = f"start = {list(drawing.start)} lies on a line or outside of the drawing"
    if not free.any():
        raise UserError(f"{path}: no free cell; {fix}")
    return free


def _grid(
    path: Path, occupied: np.ndarray, free: np.ndarray, drawing: Drawing, scale: float, corner: np.ndarray
) -> OccupancyGrid:
    """The wanted part of the cells, in the map frame."""
    rows, columns = slice(None), slice(None)
    if drawing.crop:
        box = (scale * np.array(drawing.crop).reshape(2, 2) - corner) / drawing.resolution
        part = np.zeros(free.shape, bool)
        part[_cells(box, free.shape)] = True
        free = free & part
        if not free.any():
            raise UserError(f"{path}: crop = {list(drawing.crop)} holds no free cell; it is in the drawing's own units")
        margin = drawing.sight / drawing.resolution
        rows, columns = _cells(box + np.array([[-margin], [margin]]), free.shape)
        corner = corner + drawing.resolution * np.array([columns.start, rows.start])
    x, y, yaw = se2.compose(np.array(drawing.pose, float), np.array([*corner, 0.0])).tolist()
    check_near(path, (x, y), f"move it in a yaml: pose: [{-corner[0]:.0f}, {-corner[1]:.0f}, 0]")
    cells = jnp.asarray(occupied[rows, columns]), jnp.asarray(free[rows, columns])
    return from_cells(*cells, resolution=drawing.resolution, origin=(x, y, yaw))


def _cells(box: np.ndarray, shape: tuple[int, ...]) -> tuple[slice, slice]:
    """Rows and columns of the cells that a box (2, 2) of lower-left and upper-right corner (x, y) in cells touches."""
    low = np.clip(np.floor(box[0]), 0, shape[::-1]).astype(int).tolist()
    high = np.clip(np.ceil(box[1]), 0, shape[::-1]).astype(int).tolist()
    return slice(low[1], high[1]), slice(low[0], high[0])
