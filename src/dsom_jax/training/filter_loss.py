"""What PF-Net and PFRNN minimise: the error of the weighted mean, and PFRNN's likelihood of the particles."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from dsom_jax.geometry import wrap_angle
from dsom_jax.types import Array


class FilterLosses(NamedTuple):
    """Means over a batch.

    Attributes:
        total: what is minimised.
        prediction: error of the weighted mean pose.
        particles: PFRNN's second term.
    """

    total: Array
    prediction: Array
    particles: Array


def prediction_loss(poses: Array, log_weights: Array, truth: Array, heading_weight: float) -> Array:
    """Squared error (...) of the weighted mean of poses (..., N, 3): PF-Net's and PFRNN's prediction loss.

    metres^2 up to one metre and linear beyond, so that a lost sequence does not drown the others; plus
    ``heading_weight`` times 2 - 2 (the mean direction's component along the truth), which is rad^2 for small angles.
    """
    weights = jnp.exp(log_weights)[..., None]
    error = (weights * poses[..., :2]).sum(-2) - truth[..., :2]
    turn = poses[..., 2] - truth[..., None, 2]
    along = (weights[..., 0] * jnp.cos(turn)).sum(-1)
    return huber((error**2).sum(-1)) + heading_weight * 2.0 * (1.0 - along)


def huber(squared: Array) -> Array:
    """d^2 (...) up to d = 1, 2 d - 1 beyond."""
    return jnp.where(squared < 1.0, squared, 2.0 * jnp.sqrt(jnp.maximum(squared, 1.0)) - 1.0)


def particle_loss(poses: Array, truth: Array, sigma_xy: float, sigma_theta: float) -> Array:
    """- log 1/N sum_i p(y | h_i) (...), p Gaussian about the pose of particle i: PFRNN's sampled evidence lower bound.

    ``poses`` (..., N, 3); constants of the Gaussian are left out, so that it is zero if all are at the truth.
    """
    distance = ((poses[..., :2] - truth[..., None, :2]) ** 2).sum(-1) / sigma_xy**2
    turn = wrap_angle(poses[..., 2] - truth[..., None, 2]) ** 2 / sigma_theta**2
    return jnp.log(poses.shape[-2]) - jax.nn.logsumexp(-0.5 * (distance + turn), axis=-1)
