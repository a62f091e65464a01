"""Public names of the filters; ``__init__.py`` imports each from here at its first use."""

from .adam import AdamMCL
from .adam_memory import AdamMemory
from .adam_robust import AdamRobust, RobustConfig, RobustState
from .common import Info, ParticleState, describe
from .learned import Prior
from .mcl import MCL
from .methods import METHODS, STANDARD, build_filter, make_filter, make_proposal
from .mixture import MixtureMCL
from .pf_net import PFNetFilter
from .pfrnn import PFRNNFilter
from .settings import DRAWN, REAL, Settings, with_motion, with_sensor
from .updates import FilterConfig
from .world import World

__all__ = [
    "DRAWN",
    "MCL",
    "METHODS",
    "REAL",
    "STANDARD",
    "AdamMCL",
    "AdamMemory",
    "AdamRobust",
    "FilterConfig",
    "Info",
    "MixtureMCL",
    "PFNetFilter",
    "PFRNNFilter",
    "ParticleState",
    "Prior",
    "RobustConfig",
    "RobustState",
    "Settings",
    "World",
    "build_filter",
    "describe",
    "make_filter",
    "make_proposal",
    "with_motion",
    "with_sensor",
]
