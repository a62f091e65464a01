"""Find a lidar robot on a known map: DSOM and AdaM MCL in JAX.

The public functions and types are here under their own names (``dsom_jax.run``, ``dsom_jax.load_ros_map``, ...);
each is imported at its first use, so that ``import dsom_jax`` costs nothing.
"""

from __future__ import annotations

import os
import sys
from importlib import import_module
from typing import Any

if sys.argv[:1] == ["-m"]:  # a command line of this package, before JAX is there
    # XLA's alarms (slow folding of constants, features of other processors) say nothing to who looks for a robot.
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")

_PUBLIC = {
    "checkpoint": ("load", "load_provenance", "save"),
    "data": (
        "Drawing", "RawLog", "load_bag", "load_carmen", "load_drawing", "load_log", "load_map", "load_rawseeds",
        "load_ros_map", "load_tum", "save_ros_map", "save_tum", "segments", "splice", "to_episode", "with_reference",
    ),
    "data.suite": ("Suite", "load_suite", "save_suite"),
    "episode": ("Episode",),
    "errors": ("UserError",),
    "filters.adam": ("AdamMCL",),
    "filters.adam_robust": ("AdamRobust", "RobustConfig"),
    "filters.mcl": ("MCL",),
    "filters.methods": ("DRAWN", "METHODS", "REAL", "Settings", "build_filter", "make_filter", "make_proposal"),
    "filters.mixture": ("MixtureMCL",),
    "filters.learned": ("Prior",),
    "filters.pf_net": ("PFNetFilter", "pf_net"),
    "filters.pfrnn": ("PFRNNFilter", "pfrnn"),
    "filters.world": ("World", "make_world"),
    "filters.updates": ("FilterConfig",),
    "geometry": ("compose", "inverse", "relative", "transform_points", "wrap_angle"),
    "lidar": ("LidarConfig", "LidarNoise", "apply_limits", "observe", "scan_image", "scan_points"),
    "judging.metrics": ("measure", "pose_error", "retention", "summarize"),
    "montecarlo": ("run", "run_keys"),
    "motion": ("OdometryMotion", "OmniMotion"),
    "nn": (
        "DSOM", "DSOMConfig", "PFNet", "PFNetConfig", "PFRNN", "PFRNNConfig", "create", "create_pf_net", "create_pfrnn",
        "encode_map", "evaluation_view", "log_probability_map",
    ),
    "occupancy": ("OccupancyGrid", "from_cells", "is_free", "resample"),
    "pose_grid": ("PoseGrid", "ProbabilityMap", "probability_map"),
    "proposals.dsom": ("DSOMProposal", "dsom"),
    "proposals.dual_features": ("DualFeatures", "DualFeaturesConfig", "dual_features", "with_episode"),
    "proposals.hybrid": ("Hybrid", "HybridConfig"),
    "proposals.likelihood_grid": ("LikelihoodGrid", "LikelihoodGridConfig", "likelihood_grid"),
    "proposals.uniform": ("FreeSpace", "free_space"),
    "raycast": ("MapTables", "RaycastConfig", "cast_rays", "make_tables"),
    "judging.run_table": ("RunTable", "paired"),
    "judging.statistics": ("Decision", "Evidence", "decide", "evidence", "paired_evidence"),
    "judging.trust": ("trust",),
    "sensor": (
        "BeamModel", "LikelihoodField", "ScoreModel", "beam_log_likelihood", "beam_score", "field_log_likelihood",
        "perfect_score",
    ),
    "simulate.drive": ("DriveConfig", "make_synthetic"),
    "simulate.obstacles": ("add_obstacles", "remove_structure"),
    "simulate.worlds": ("WorldConfig", "make_world"),
    "types": ("Filter", "Inputs", "Motion", "Proposal"),
}  # fmt: skip
_HOME = {name: module for module, names in _PUBLIC.items() for name in names}
__all__ = sorted(_HOME)


def __getattr__(name: str) -> Any:
    """Import a public name from its module at first use."""
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f"{__name__}.{_HOME[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *_HOME})
