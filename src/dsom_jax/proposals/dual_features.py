"""The three hand-made features of Thrun et al. 2001, looked up in scans collected beforehand."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import partial

import jax
import jax.numpy as jnp

from dsom_jax import checks
from dsom_jax import pose_grid as pg
from dsom_jax.episode import Episode
from dsom_jax.lidar import LidarConfig, scan_points
from dsom_jax.occupancy import OccupancyGrid
from dsom_jax.proposals.uniform import free_space
from dsom_jax.raycast import RaycastConfig, cast_rays, make_tables
from dsom_jax.simulate.obstacles import add_obstacles
from dsom_jax.types import Array, Inputs, Key


@dataclass(frozen=True)
class DualFeaturesConfig:
    """How scans are collected and compared.

    Attributes:
        samples: scans collected in the map, over ``layouts`` draws of ``obstacles`` random obstacles each.
        bandwidth: standard deviation of the Gaussian kernel on the features, metres.
        headings: K of the grid that the samples are laid on.
    """

    samples: int = 20_000
    layouts: int = 10
    obstacles: int = 20
    bandwidth: float = 0.3
    headings: int = 32

    def __post_init__(self) -> None:
        checks.count(self, "layouts headings")
        checks.count(self, "samples", self.layouts)
        checks.count(self, "obstacles", 0)
        checks.positive(self, "bandwidth")


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class DualFeatures:
    """Samples of (features, pose), and PM as the kernel-weighted histogram of their poses.

    Attributes:
        features: (M, 3) centre of gravity x, y and mean range of each sample's scan, metres.
        cells: (M,) int32 flat cell (i, j, k) of each sample's pose.
        updates: (M,) int32 number of the update that a sample was taken from, -1 for none: never shown to itself.
        free: (H, W) bool.
        pose_grid: (H, W, K) cells.
        lidar, config: static.
    """

    features: Array
    cells: Array
    updates: Array
    free: Array
    pose_grid: pg.PoseGrid
    lidar: LidarConfig = field(metadata={"static": True})
    config: DualFeaturesConfig = field(metadata={"static": True})

    def begin(self) -> tuple[()]:
        """No memory: each scan is taken on its own."""
        return ()

    def prepare(self, memory: tuple[()], inputs: Inputs) -> tuple[pg.ProbabilityMap, tuple[()]]:
        """Histogram of the poses of all samples, each weighted by how alike its features are."""
        gap = (self.features - scan_features(inputs.ranges, self.lidar)) / self.config.bandwidth
        log_weight = -0.5 * (gap**2).sum(-1)
        log_weight = jnp.where(self.updates == inputs.index, -jnp.inf, log_weight)
        weight = pg.exp_or_zero(log_weight - log_weight.max())
        mass = jnp.zeros(math.prod(self.pose_grid.shape)).at[self.cells].add(weight, mode="drop")
        return pg.probability_map(self.pose_grid, mass.reshape(self.pose_grid.shape)), memory

    def sample(self, key: Key, prepared: pg.ProbabilityMap, n: int) -> tuple[Array, Array]:
        """``n`` poses (n, 3) from PM and their log densities."""
        return pg.sample(key, prepared, n)


def scan_features(ranges: Array, lidar: LidarConfig) -> Array:
    """(3,) centre of gravity x, y of the end points in the base frame, and mean range, metres.

    Beams without return count with ``range_max`` in the mean and not in the centre; a scan without any gives zeros.
    """
    points, valid = scan_points(ranges, lidar)
    centre = (points * valid[:, None]).sum(0) / jnp.maximum(valid.sum(), 1)
    seen = ranges > -jnp.inf
    reach = jnp.where(seen, jnp.minimum(jnp.where(seen, ranges, 0.0), lidar.range_max), 0.0)
    return jnp.append(centre, reach.sum() / jnp.maximum(seen.sum(), 1))


def dual_features(key: Key, grid: OccupancyGrid, lidar: LidarConfig, config: DualFeaturesConfig) -> DualFeatures:
    """Proposal from scans simulated in the test map with random obstacles (Mixture MCL of the paper)."""
    parts = [_collect(k, grid, lidar, config) for k in jax.random.split(key, config.layouts)]
    features, cells = (jnp.concatenate(part) for part in zip(*parts, strict=True))
    never = jnp.full(len(cells), -1, jnp.int32)
    return DualFeatures(features, cells, never, grid.free, pg.over(grid, config.headings), lidar, config)


@partial(jax.jit, static_argnames=("lidar", "config"))
def _collect(key: Key, grid: OccupancyGrid, lidar: LidarConfig, config: DualFeaturesConfig) -> tuple[Array, Array]:
    """Features (m, 3) and pose cells (m,) of random scans among one layout of random obstacles."""
    k_things, k_pose = jax.random.split(key)
    cluttered = add_obstacles(k_things, grid, config.obstacles)
    poses, _ = free_space(cluttered).sample(k_pose, None, config.samples // config.layouts)
    ranges = cast_rays(make_tables(cluttered, RaycastConfig("exact"), lidar.range_max), poses, lidar)
    return _described(pg.over(grid, config.headings), ranges, poses, lidar)


@partial(jax.jit, static_argnames="lidar")
def _described(pose_grid: pg.PoseGrid, ranges: Array, poses: Array, lidar: LidarConfig) -> tuple[Array, Array]:
    """Features (m, 3) of scans (m, B) and the cells (m,) of the poses (m, 3) that they were taken at."""
    return jax.vmap(lambda r: scan_features(r, lidar))(ranges), flat_cells(pose_grid, poses)


def with_episode(proposal: DualFeatures, episode: Episode) -> DualFeatures:
    """The cheating proposal of Mixture MCL*: the samples contain the test sequence but for the current scan.

    The first of the collected samples give way, so that both proposals share one compilation.
    """
    features, cells = _described(proposal.pose_grid, episode.ranges, episode.poses, proposal.lidar)
    updates = jnp.arange(len(cells), dtype=jnp.int32)
    left = min(len(updates), len(proposal.cells))
    return replace(
        proposal,
        features=jnp.concatenate([proposal.features[left:], features]),
        cells=jnp.concatenate([proposal.cells[left:], cells]),
        updates=jnp.concatenate([proposal.updates[left:], updates]),
    )


def flat_cells(pose_grid: pg.PoseGrid, poses: Array) -> Array:
    """(n,) int32 flat index of the cell of each map-frame pose (n, 3); beyond the last one where off the grid."""
    i, j, k, on_grid = pg.nearest_cell(pose_grid, poses)
    return jnp.where(on_grid, (i * pose_grid.width + j) * pose_grid.headings + k, math.prod(pose_grid.shape))
