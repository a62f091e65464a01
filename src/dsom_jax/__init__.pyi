"""Public names of the package; ``__init__.py`` imports each from here at its first use."""

from . import checkpoint, filters, judging, logs, maps, montecarlo, motion, nn, plotting, proposals, sensor, simulate
from .data import load_log, load_map, load_ros_map, load_tum, save_ros_map, save_tum, segments, splice, with_reference
from .data.suite import load_suite
from .episode import Episode
from .errors import UserError
from .filters.methods import METHODS, build_filter, make_filter, make_proposal
from .filters.settings import DRAWN, REAL, Settings
from .judging.metrics import measure, pose_error, summarize
from .lidar import LidarConfig
from .live import Answer, Hypothesis, Localizer
from .montecarlo import run, run_keys
from .motion import OdometryMotion, OmniMotion
from .occupancy import OccupancyGrid, from_cells
from .sensor import BeamModel, LikelihoodField, ScoreModel, SensorModel
from .simulate import DriveConfig, make_synthetic
from .types import Filter, Inputs, Motion, Proposal

__all__ = [
    "DRAWN",
    "METHODS",
    "REAL",
    "Answer",
    "BeamModel",
    "DriveConfig",
    "Episode",
    "Filter",
    "Hypothesis",
    "Inputs",
    "LidarConfig",
    "LikelihoodField",
    "Localizer",
    "Motion",
    "OccupancyGrid",
    "OdometryMotion",
    "OmniMotion",
    "Proposal",
    "ScoreModel",
    "SensorModel",
    "Settings",
    "UserError",
    "build_filter",
    "checkpoint",
    "filters",
    "from_cells",
    "judging",
    "load_log",
    "load_map",
    "load_ros_map",
    "load_suite",
    "load_tum",
    "logs",
    "make_filter",
    "make_proposal",
    "make_synthetic",
    "maps",
    "measure",
    "montecarlo",
    "motion",
    "nn",
    "plotting",
    "pose_error",
    "proposals",
    "run",
    "run_keys",
    "save_ros_map",
    "save_tum",
    "segments",
    "sensor",
    "simulate",
    "splice",
    "summarize",
    "with_reference",
]
