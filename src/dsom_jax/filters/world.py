"""What a filter knows before the first scan: the map, and the models of robot and sensor."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import jax

from dsom_jax.lidar import LidarConfig
from dsom_jax.occupancy import OccupancyGrid
from dsom_jax.proposals.uniform import FreeSpace, free_space
from dsom_jax.raycast import RaycastConfig, make_tables
from dsom_jax.sensor import RayTables, SensorModel
from dsom_jax.types import Array, Motion

TABLE = RaycastConfig("table")


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class World:
    """Map and models.

    Attributes:
        grid: the map.
        space: uniform distribution over its free poses.
        tables: what the sensor model needs of the map.
        beam_step: every ``beam_step``-th beam of a scan is used (static).
        motion: model of the drive (static).
        sensor: model of the lidar (static).
    """

    grid: OccupancyGrid
    space: FreeSpace
    tables: Any
    beam_step: int = field(metadata={"static": True})
    motion: Motion = field(metadata={"static": True})
    sensor: SensorModel = field(metadata={"static": True})

    def log_likelihood(self, poses: Array, ranges: Array) -> Array:
        """log p(z | x) (N,) of a whole scan (B,) at poses (N, 3)."""
        return self.sensor.log_likelihood(self.tables, poses, ranges[:: self.beam_step])

    def weigh(self, poses: Array, ranges: Array) -> Array:
        """Weights (N,) of poses (N, 3) in units of the best possible one, w / w* for Eq 15."""
        return self.sensor.weigh(self.tables, poses, ranges[:: self.beam_step])

    @staticmethod
    def on(
        grid: OccupancyGrid,
        lidar: LidarConfig,
        motion: Motion,
        sensor: SensorModel,
        raycast: RaycastConfig = TABLE,
        max_beams: int = 72,
    ) -> World:
        """World of a map, its tables computed; of a scan with more than ``max_beams`` every n-th beam is used."""
        step = -(-lidar.beams // max_beams)
        rays = RayTables(make_tables(grid, raycast, lidar.range_max), lidar.every(step))
        return World(grid, free_space(grid), sensor.tables(rays), step, motion, sensor)
