"""Reading what robots leave behind: maps, logs, trajectories; and cutting logs into episodes."""

from dsom_jax.data.bag import load_bag
from dsom_jax.data.carmen import load_carmen
from dsom_jax.data.cut import segment_indices, segments, splice, thin, to_episode
from dsom_jax.data.dxf import Drawing, load_drawing
from dsom_jax.data.log import RawLog, Report, check_lidar
from dsom_jax.data.log_options import LogOptions
from dsom_jax.data.open_log import load_log
from dsom_jax.data.open_map import load_map
from dsom_jax.data.rawseeds import load_rawseeds
from dsom_jax.data.ros_map import load_ros_map, save_ros_map
from dsom_jax.data.trajectory import Trajectory, associate, load_tum, save_tum, with_reference

__all__ = [
    "Drawing",
    "LogOptions",
    "RawLog",
    "Report",
    "Trajectory",
    "associate",
    "check_lidar",
    "load_bag",
    "load_carmen",
    "load_drawing",
    "load_log",
    "load_map",
    "load_rawseeds",
    "load_ros_map",
    "load_tum",
    "save_ros_map",
    "save_tum",
    "segment_indices",
    "segments",
    "splice",
    "thin",
    "to_episode",
    "with_reference",
]
