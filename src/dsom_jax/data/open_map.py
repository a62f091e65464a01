"""One entry for every kind of map."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from dsom_jax.data.bag_file import is_bag
from dsom_jax.data.bag_map import load_bag_map
from dsom_jax.data.documents import read_yaml
from dsom_jax.data.dxf import Drawing, load_drawing
from dsom_jax.data.files import check_path
from dsom_jax.data.log import Report
from dsom_jax.data.ros_map import load_ros_map
from dsom_jax.errors import UserError, shown
from dsom_jax.occupancy import OccupancyGrid, resample
from dsom_jax.training.options import override


def load_map(path: str | Path, report: Report | None = None) -> OccupancyGrid:
    """A ROS map_server yaml, a bag with a map, a DXF drawing, or a yaml with ``drawing: FILE.dxf`` and how to read it.

    A drawing that is named without a yaml is read with the defaults. ``report`` takes what was left out or is odd.
    """
    path = Path(path)
    check_path(path, "map")
    if is_bag(path):
        return load_bag_map(path, report)
    if path.suffix.lower() in (".dxf", ".dwg"):
        return load_drawing(path, report=report)
    fields = read_yaml(path, "map yaml")
    if "drawing" not in fields:
        return load_ros_map(path, report=report)
    plan = fields.pop("drawing")
    if not isinstance(plan, str):
        raise UserError(f"{path}: drawing = {shown(plan)}: must be the name of a DXF file")
    return load_drawing(path.parent / plan, override(Drawing(), fields, str(path)), report)


def load_maps(paths: Sequence[Path], resolution: float, finer: bool = False) -> list[OccupancyGrid]:
    """Maps at ``resolution`` metres per cell; UserError for one without free space.

    ``finer``: at their own resolution where it is finer, the finest of them for all.
    """
    given = [load_map(path) for path in paths]
    coarse = [resample(grid, resolution) for grid in given]
    for path, grid in zip(paths, coarse, strict=True):
        if not bool(grid.free.any()):
            raise UserError(f"{path}: no free cell at {resolution:.3f} m per cell; give a map with free space")
    finest = min([resolution, *(grid.resolution for grid in given)])
    if not finer or finest > resolution - 1e-4:
        return coarse
    return [grid if grid.resolution == finest else resample(grid, finest) for grid in given]
