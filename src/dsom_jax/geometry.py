"""SE(2): poses are arrays (..., 3) = (x, y, theta) in metres and radians, counter-clockwise (REP-103)."""

from __future__ import annotations

import jax.numpy as jnp

from dsom_jax.types import Array


def wrap_angle(angle: Array) -> Array:
    """Angle in [-pi, pi), radians."""
    return (angle + jnp.pi) % (2 * jnp.pi) - jnp.pi


def rotate(theta: Array, x: Array, y: Array) -> tuple[Array, Array]:
    """Coordinates of the vector (x, y) turned by ``theta``."""
    c, s = jnp.cos(theta), jnp.sin(theta)
    return c * x - s * y, s * x + c * y


def compose(a: Array, b: Array) -> Array:
    """Pose ``b``, given in the frame of ``a``, in the frame of ``a``'s parent; shapes broadcast."""
    x, y = rotate(a[..., 2], b[..., 0], b[..., 1])
    return jnp.stack([a[..., 0] + x, a[..., 1] + y, wrap_angle(a[..., 2] + b[..., 2])], axis=-1)


def relative(a: Array, b: Array) -> Array:
    """Pose ``b`` seen from ``a``: inverse(a) compose b; shapes broadcast."""
    x, y = rotate(-a[..., 2], b[..., 0] - a[..., 0], b[..., 1] - a[..., 1])
    return jnp.stack([x, y, wrap_angle(b[..., 2] - a[..., 2])], axis=-1)


def inverse(a: Array) -> Array:
    """The pose that composed with ``a`` gives the identity."""
    return relative(a, jnp.zeros(3, a.dtype))


def transform_points(pose: Array, points: Array) -> Array:
    """Points (..., n, 2) of the frame ``pose`` (..., 3) in the parent frame."""
    x, y = rotate(pose[..., None, 2], points[..., 0], points[..., 1])
    return jnp.stack([pose[..., None, 0] + x, pose[..., None, 1] + y], axis=-1)


def circular_mean(angles: Array, weights: Array) -> Array:
    """Direction of the weighted resultant over the last axis, radians."""
    return jnp.arctan2((weights * jnp.sin(angles)).sum(-1), (weights * jnp.cos(angles)).sum(-1))


def mean_pose(poses: Array, weights: Array) -> Array:
    """Weighted mean of poses (..., n, 3) with weights (..., n) that sum to one: (..., 3)."""
    xy = (weights[..., None] * poses[..., :2]).sum(-2)
    return jnp.concatenate([xy, circular_mean(poses[..., 2], weights)[..., None]], axis=-1)


def pose_covariance(poses: Array, weights: Array, mean: Array) -> Array:
    """Covariance (..., 3, 3) about ``mean`` (..., 3) of poses (..., n, 3) whose weights (..., n) sum to one."""
    gap = poses - mean[..., None, :]
    gap = gap.at[..., 2].set(wrap_angle(gap[..., 2]))
    # A sum, not a product of matrices: that would add up in an order which depends on how many there are.
    return (weights[..., None, None] * gap[..., :, None] * gap[..., None, :]).sum(-3)
