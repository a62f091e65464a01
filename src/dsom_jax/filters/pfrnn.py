"""PFRNN (Ma, Karkus, Hsu, Lee 2020) as a filter: latent particles that stand somewhere."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from dsom_jax.filters.learned import Learned, Prior, bind, even_log_weights
from dsom_jax.geometry import compose
from dsom_jax.lidar import LidarConfig
from dsom_jax.occupancy import OccupancyGrid
from dsom_jax.resampling import soft_resample
from dsom_jax.types import Array, Inputs, Key


class PFRNNState(NamedTuple):
    """Latent particles after the last scan.

    Attributes:
        poses: (N, 3) map frame, what the head made of them.
        hidden: (N, D) latent particles h.
        log_weights: (N,) normalised.
    """

    poses: Array
    hidden: Array
    log_weights: Array


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class PFRNNFilter(Learned):
    """Soft resampling, the particle filter GRU, and a head that corrects poses."""

    def init(self, key: Key) -> PFRNNState:
        """Latent particles that know nothing, at poses of the prior, or anywhere in free space."""
        return self.start(self.first_poses(key))

    def start(self, poses: Array) -> PFRNNState:
        """Latent particles at given poses (N, 3)."""
        n = poses.shape[0]
        return PFRNNState(poses, jnp.zeros((n, self.network().config.hidden)), even_log_weights(n))

    def advance(self, key: Key, state: PFRNNState, inputs: Inputs, prepared: Any) -> PFRNNState:
        """One update; differentiable."""
        k_resample, k_cell = jax.random.split(key)
        network = self.network()
        # Resample
        ancestors, log_weights = soft_resample(k_resample, state.log_weights, network.config.alpha)
        # Move
        poses = compose(state.poses[ancestors], inputs.odometry)
        # Update the latent particles
        noise = jax.random.normal(k_cell, state.hidden.shape)
        moved = (poses, state.hidden[ancestors], inputs.odometry, prepared, noise)
        poses, hidden, log_likelihood = network.update(self.place, *moved)
        return PFRNNState(poses, hidden, jax.nn.log_softmax(log_weights + log_likelihood))


def pfrnn(
    model: Any, grid: OccupancyGrid, lidar: LidarConfig, particles: int, prior: Prior | None = None
) -> PFRNNFilter:
    """Filter of a trained :class:`dsom_jax.nn.PFRNN` on a map; with a ``prior`` it tracks, without it searches."""
    return bind(PFRNNFilter, model, grid, lidar, particles, prior)
