"""The places that hold the belief: weight, mean and covariance of each."""

from __future__ import annotations

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp

from dsom_jax.geometry import mean_pose, pose_covariance, wrap_angle
from dsom_jax.types import Array

PLACES = 8
"""Hypotheses that are told apart."""
_HELD = 0.99
"""Share of the mass that the places have to hold; what is left is none."""
_RADIUS, _ANGLE = 1.5, math.radians(25.0)
"""What lies this near to a place's mean belongs to it, metres and radians."""


class Hypotheses(NamedTuple):
    """Places, the heaviest first.

    Attributes:
        weights: (M,) probabilities; 0 for places that are none. What is missing to one lies elsewhere or off the map.
        means: (M, 3) map frame.
        covariances: (M, 3, 3) of (x, y, theta), m^2, m rad, rad^2.
    """

    weights: Array
    means: Array
    covariances: Array


def gather(poses: Array, mass: Array, count: int = PLACES) -> Hypotheses:
    """Places among poses (S, 3) of equal weight that together stand for ``mass`` () of the belief.

    The pose with most others around it is a place, its neighbours belong to it; then the same with what is left.
    """
    near = _near(poses[:, None], poses).astype(jnp.float32)
    share = mass / poses.shape[0]

    def one(left: Array, _: None) -> tuple[Array, tuple[Array, Array, Array]]:
        centre = poses[jnp.argmax(jnp.where(left, near @ left.astype(jnp.float32), 0))]
        inside = left & _near(poses, centre)
        mean = mean_pose(poses, inside / jnp.maximum(inside.sum(), 1))
        inside = left & (_near(poses, mean) | inside)
        weights = inside / jnp.maximum(inside.sum(), 1)
        mean = mean_pose(poses, weights)
        return left & ~inside, (inside.sum() * share, mean, pose_covariance(poses, weights, mean))

    _, (weights, means, covariances) = jax.lax.scan(one, jnp.ones(poses.shape[0], bool), length=count)
    order = jnp.argsort(-weights)
    weights = weights[order]
    before = jnp.cumsum(weights) - weights
    return Hypotheses(jnp.where(before < _HELD * mass, weights, 0.0), means[order], covariances[order])


def share_at(poses: Array, place: Array) -> Array:
    """Share () of poses (S, 3) that belong to ``place`` (3,)."""
    return _near(poses, place.at[2].set(wrap_angle(place[2]))).mean()


def _near(poses: Array, place: Array) -> Array:
    close = ((poses[..., :2] - place[..., :2]) ** 2).sum(-1) <= _RADIUS**2
    # Headings lie within one turn of each other; a remainder for every pair would take ten times as long.
    turn = jnp.pi - jnp.abs(jnp.pi - jnp.abs(poses[..., 2] - place[..., 2]))
    return close & (turn <= _ANGLE)
