"""Name space: maps, where they come from, and rays in them."""

from dsom_jax.data import Drawing, load_drawing, load_map, load_ros_map, save_ros_map
from dsom_jax.occupancy import OccupancyGrid, from_cells, is_free, pad, resample
from dsom_jax.pose_grid import PoseGrid, ProbabilityMap, probability_map
from dsom_jax.raycast import MapTables, RaycastConfig, cast_rays, make_tables

__all__ = [
    "Drawing",
    "MapTables",
    "OccupancyGrid",
    "PoseGrid",
    "ProbabilityMap",
    "RaycastConfig",
    "cast_rays",
    "from_cells",
    "is_free",
    "load_drawing",
    "load_map",
    "load_ros_map",
    "make_tables",
    "pad",
    "probability_map",
    "resample",
    "save_ros_map",
]
