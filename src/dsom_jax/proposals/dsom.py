"""The paper's proposal: the probability map of DSOM."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from typing import Any

import jax
from flax import nnx

from dsom_jax import pose_grid as pg
from dsom_jax.lidar import LidarConfig
from dsom_jax.nn import DSOM, DSOMConfig, MapFeatures, encode_map, log_probability_map
from dsom_jax.nn.panorama import finer_ranges
from dsom_jax.occupancy import OccupancyGrid, resample
from dsom_jax.types import Array, Inputs, Key


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class DSOMProposal:
    """PM of a trained network on one map; the map's features are computed once.

    Attributes:
        weights: parameters and batch statistics of the network.
        features: what the environment encoder says of the map.
        pose_grid: (H, W, K) cells of PM.
        graph: structure of the network (static).
        lidar: geometry of the whole scan (static).
        sharpness: exponent of PM before it is normalised again (static).
    """

    weights: Any
    features: MapFeatures
    pose_grid: pg.PoseGrid
    graph: Any = field(metadata={"static": True})
    lidar: LidarConfig = field(metadata={"static": True})
    sharpness: float = field(default=1.0, metadata={"static": True})

    @property
    def free(self) -> Array:
        """(H, W) bool, cells of PM with free space."""
        return self.features.free

    def log_map(self, inputs: Inputs) -> Array:
        """Log PM (H, W, K) of one scan as the network gives it: a pass of the scan encoder and the decoder."""
        return log_probability_map(nnx.merge(self.graph, self.weights), self.features, inputs.ranges, self.lidar)

    def begin(self) -> tuple[()]:
        """No memory: each scan is taken on its own."""
        return ()

    def prepare(self, memory: tuple[()], inputs: Inputs) -> tuple[pg.ProbabilityMap, tuple[()]]:
        """PM of one scan, sharpened."""
        return pg.from_log(self.pose_grid, self.sharpness * self.log_map(inputs), self.features.free), memory

    def sample(self, key: Key, prepared: pg.ProbabilityMap, n: int) -> tuple[Array, Array]:
        """``n`` poses (n, 3) from PM and their log densities."""
        return pg.sample(key, prepared, n)


def dsom(
    model: DSOM, grid: OccupancyGrid, lidar: LidarConfig, sharpness: float = 1.0, surface: float = 0.0
) -> DSOMProposal:
    """Proposal of an evaluation view of a network, on a map resampled to its scale; ``sharpness`` is an exponent.

    What is seen from where is cast in the map as it was given; ``surface``: how deep in its occupied cells beams end.
    """
    same = abs(grid.resolution - model.config.resolution) < 1e-4
    scaled = grid if same else resample(grid, model.config.resolution)
    graph, weights = nnx.split(model)
    weights = nnx.as_pure(weights)
    views = None if same and not surface else _views(grid, model.config, scaled.shape, surface)
    features = _features(graph, weights, scaled, views)
    return DSOMProposal(weights, features, pg.over(scaled, model.config.headings), graph, lidar, sharpness)


@partial(jax.jit, static_argnames=("config", "shape"))
def _views(grid: OccupancyGrid, config: DSOMConfig, shape: tuple[int, int], surface: float) -> Array | None:
    """Expected ranges for a network that compares views, from every second of ``shape`` cells and their padding."""
    if not config.panorama:
        return None
    height, width = (side + -side % 8 for side in shape)
    return finer_ranges(grid.occupied, config, (height, width), grid.resolution, surface * grid.resolution)


@partial(jax.jit, static_argnames="graph")
def _features(graph: Any, weights: Any, grid: OccupancyGrid, views: Array | None) -> MapFeatures:
    return encode_map(nnx.merge(graph, weights), grid.occupied, grid.free, views)
