"""Simulated buildings, obstacles and drives."""

from dsom_jax.simulate.drive import DriveConfig, make_synthetic
from dsom_jax.simulate.obstacles import add_obstacles, remove_structure
from dsom_jax.simulate.worlds import WorldConfig, make_world

__all__ = [
    "DriveConfig",
    "WorldConfig",
    "add_obstacles",
    "make_synthetic",
    "make_world",
    "remove_structure",
]
