"""Ground truth GT of section III-B, Eq 6-7, kept as its three factors for as long as possible."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from dsom_jax.types import Array

_RADIUS = 3
SIGMA = 3.0


class Target(NamedTuple):
    """GT[i, j, k] = rows[i] * columns[j] * headings[k] before normalisation.

    Attributes:
        rows: (..., H) blur along y.
        columns: (..., W) blur along x.
        headings: (..., K) interpolation over the two nearest orientations.
    """

    rows: Array
    columns: Array
    headings: Array


def blurred_one_hot(position: Array, size: int, sigma: float = SIGMA) -> Array:
    """One-hot of the cell around ``position`` (...), in cells, blurred over 7 cells with ``sigma``: (..., size)."""
    offset = jnp.arange(size) - jnp.floor(position)[..., None]
    weights = jnp.where(jnp.abs(offset) <= _RADIUS, jnp.exp(-0.5 * (offset / sigma) ** 2), 0.0)
    return weights / weights.sum(-1, keepdims=True)


def heading_weights(theta: Array, headings: int) -> Array:
    """Eq 6: theta (...) radians shared linearly by the two nearest of theta_k = -pi + k 2pi/K: (..., K).

    The nearer orientation gets the larger share (Eq 6 as printed would give it the smaller one).
    """
    place = (theta + jnp.pi) * (headings / (2 * jnp.pi))
    distance = jnp.abs((place[..., None] - jnp.arange(headings) + headings / 2) % headings - headings / 2)
    return jnp.maximum(0.0, 1.0 - distance)


def make_target(poses: Array, shape: tuple[int, int], headings: int, resolution: float, sigma: float = SIGMA) -> Target:
    """Factors of GT for poses (..., 3) in the grid's own frame (metres from its lower-left corner, radians).

    ``sigma`` is the blur in cells; the paper's is 3.
    """
    return Target(
        blurred_one_hot(poses[..., 1] / resolution, shape[0], sigma),
        blurred_one_hot(poses[..., 0] / resolution, shape[1], sigma),
        heading_weights(poses[..., 2], headings),
    )


def dense(target: Target, free: Array) -> Array:
    """Eq 7: GT (..., H, W, K) on the free cells (..., H, W), normalised."""
    plane = target.rows[..., :, None] * target.columns[..., None, :] * free
    plane = plane / jnp.maximum(plane.sum((-2, -1), keepdims=True), 1e-12)
    return plane[..., None] * target.headings[..., None, None, :]


def pooled(target: Target, free: Array, factor: int = 8) -> Array:
    """GT summed over ``factor`` x ``factor`` cells: (..., H / factor, W / factor, K), the auxiliary target of SIM."""
    plane = target.rows[..., :, None] * target.columns[..., None, :] * free
    *batch, h, w = plane.shape
    plane = plane.reshape(*batch, h // factor, factor, w // factor, factor).sum((-3, -1))
    plane = plane / jnp.maximum(plane.sum((-2, -1), keepdims=True), 1e-12)
    return plane[..., None] * target.headings[..., None, None, :]


def entropy(probabilities: Array) -> Array:
    """Entropy (...) in nats over the last three axes."""
    return -jax.scipy.special.xlogy(probabilities, probabilities).sum((-3, -2, -1))
