"""Name space: logs, trajectories and suites, and the episodes that are cut from them."""

from dsom_jax.data import (
    RawLog,
    Trajectory,
    associate,
    load_bag,
    load_carmen,
    load_log,
    load_rawseeds,
    load_tum,
    save_tum,
    segments,
    splice,
    to_episode,
    with_reference,
)
from dsom_jax.data.suite import Suite, load_suite, save_suite
from dsom_jax.episode import Episode

__all__ = [
    "Episode",
    "RawLog",
    "Suite",
    "Trajectory",
    "associate",
    "load_bag",
    "load_carmen",
    "load_log",
    "load_rawseeds",
    "load_suite",
    "load_tum",
    "save_suite",
    "save_tum",
    "segments",
    "splice",
    "to_episode",
    "with_reference",
]
