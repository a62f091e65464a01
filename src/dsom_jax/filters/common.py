"""What all filters share: the particle set, the diagnostics, and the two estimates."""

from __future__ import annotations

import math
from typing import NamedTuple

import jax.numpy as jnp

from dsom_jax.geometry import mean_pose, wrap_angle
from dsom_jax.resampling import pick
from dsom_jax.types import Array

CLUSTER_RADIUS = 1.0  # metres
CLUSTER_ANGLE = math.radians(20.0)
_CANDIDATES = 32


class ParticleState(NamedTuple):
    """Particle set P_t of Alg 1.

    Attributes:
        poses: (N, 3) map frame.
        weights: (N,) w, before normalisation, in units of w* of the scan that gave it: the trust T of Alg 1.
        normalised: (N,) w_norm.
        updates: () number of updates made.
    """

    poses: Array
    weights: Array
    normalised: Array
    updates: Array


class Info(NamedTuple):
    """Diagnostics of one update.

    Attributes:
        mean: (3,) weighted mean of all particles, the paper's estimate.
        cluster: (3,) mean of the heaviest cluster, what a robot needs.
        lost: () share of the weight outside of that cluster: the filter's own probability of being wrong.
        redrawn: () share of particles drawn from the proposal.
        restarted: () bool, all weights had vanished and the set was drawn anew.
    """

    mean: Array
    cluster: Array
    lost: Array
    redrawn: Array
    restarted: Array


def normalise(weights: Array) -> Array:
    """Weights (n,) that sum to one; uniform if they are all zero."""
    total = weights.sum()
    return jnp.where(total > 0, weights / jnp.where(total > 0, total, 1.0), 1.0 / weights.shape[0])


def membership(poses: Array, centre: Array) -> Array:
    """Which poses (..., 3) lie within the cluster radius and angle of ``centre`` (..., 3), shapes broadcast."""
    near = ((poses[..., :2] - centre[..., :2]) ** 2).sum(-1) <= CLUSTER_RADIUS**2
    return near & (jnp.abs(wrap_angle(poses[..., 2] - centre[..., 2])) <= CLUSTER_ANGLE)


def heaviest_cluster(poses: Array, normalised: Array) -> tuple[Array, Array]:
    """Mean pose (3,) and weight () of the heaviest cluster.

    The best of 32 particles, picked evenly by weight, is shifted twice to the mean of its neighbours.
    """
    places = (jnp.arange(_CANDIDATES) + 0.5) / _CANDIDATES
    candidates = poses[pick(jnp.cumsum(normalised), places)]
    mass = (membership(poses, candidates[:, None]) * normalised).sum(-1)
    centre = candidates[jnp.argmax(mass)]
    for _ in range(2):
        inside = membership(poses, centre) * normalised
        centre = mean_pose(poses, normalise(inside))
    return centre, jnp.minimum((membership(poses, centre) * normalised).sum(), 1.0)


def describe(poses: Array, normalised: Array, redrawn: Array, restarted: Array) -> Info:
    """Diagnostics of a weighted particle set."""
    cluster, mass = heaviest_cluster(poses, normalised)
    return Info(mean_pose(poses, normalised), cluster, 1.0 - mass, redrawn, restarted)
