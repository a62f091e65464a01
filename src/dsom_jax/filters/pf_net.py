"""PF-Net (Karkus, Hsu, Lee 2018): a particle filter whose transition and observation models were learned through it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import jax

from dsom_jax.filters.learned import Learned, Prior, bind, even_log_weights
from dsom_jax.lidar import LidarConfig
from dsom_jax.occupancy import OccupancyGrid
from dsom_jax.resampling import soft_resample
from dsom_jax.types import Array, Inputs, Key


class PFNetState(NamedTuple):
    """Weighted particles after the last scan.

    Attributes:
        poses: (N, 3) map frame.
        log_weights: (N,) normalised.
    """

    poses: Array
    log_weights: Array


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class PFNetFilter(Learned):
    """Soft resampling, learned motion, learned weights."""

    def init(self, key: Key) -> PFNetState:
        """Particles of the prior, or uniform over free space."""
        return self.start(self.first_poses(key))

    def start(self, poses: Array) -> PFNetState:
        """Particles at given poses (N, 3)."""
        return PFNetState(poses, even_log_weights(poses.shape[0]))

    def advance(self, key: Key, state: PFNetState, inputs: Inputs, prepared: Any) -> PFNetState:
        """One update; differentiable."""
        k_resample, k_move = jax.random.split(key)
        network = self.network()
        # Resample
        ancestors, log_weights = soft_resample(k_resample, state.log_weights, network.config.alpha)
        # Move
        noise = jax.random.normal(k_move, state.poses.shape)
        poses = network.move(state.poses[ancestors], inputs.odometry, noise)
        # Weigh
        log_weights = log_weights + network.log_likelihood(self.place, poses, prepared)
        return PFNetState(poses, jax.nn.log_softmax(log_weights))


def pf_net(
    model: Any, grid: OccupancyGrid, lidar: LidarConfig, particles: int, prior: Prior | None = None
) -> PFNetFilter:
    """Filter of a trained :class:`dsom_jax.nn.PFNet` on a map; with a ``prior`` it tracks, without it searches."""
    return bind(PFNetFilter, model, grid, lidar, particles, prior)
