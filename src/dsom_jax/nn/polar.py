"""A scan as the polar encoder reads it: features at evenly spaced bearings, whatever the lidar."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp

from dsom_jax.geometry import wrap_angle
from dsom_jax.lidar import LidarConfig
from dsom_jax.nn.config import DSOMConfig
from dsom_jax.types import Array


def polar_channels(config: DSOMConfig) -> int:
    """Number of features of one bearing: visible, no return, range, and the radial basis."""
    return 3 + config.radial_bins


def radial_basis(reach: Array, config: DSOMConfig) -> Array:
    """Range (...) in metres as hat functions (..., R) with centres evenly spread over (0, range_max)."""
    centres = (jnp.arange(config.radial_bins) + 0.5) * config.range_max / config.radial_bins
    return jnp.maximum(0.0, 1.0 - jnp.abs(reach[..., None] - centres) * config.radial_bins / config.range_max)


def range_features(distance: Array, returned: Array, config: DSOMConfig) -> Array:
    """No return, range / range_max and radial basis (..., 2 + R) of rays with distances (...) in metres."""
    basis = jnp.where(returned[..., None], radial_basis(distance, config), 0.0)
    return jnp.concatenate([~returned[..., None], distance[..., None] / config.range_max, basis], axis=-1)


def bin_centres(bins: int) -> Array:
    """(bins,) bearings in the middle of evenly spaced bins from -pi on."""
    return -jnp.pi + (jnp.arange(bins) + 0.5) * (2 * jnp.pi / bins)


def beam_geometry(ranges: Array, lidar: LidarConfig, limit: Array) -> tuple[Array, Array]:
    """Bearing and distance (B,) of the beams' ends seen from the base; a beam without return ends at ``limit``."""
    angles = jnp.asarray(lidar.angles())
    length = jnp.clip(jnp.nan_to_num(ranges, nan=0.0, posinf=jnp.inf, neginf=0.0), 0.0, limit)
    x = lidar.mount[0] + length * jnp.cos(angles)
    y = lidar.mount[1] + length * jnp.sin(angles)
    return jnp.arctan2(y, x), jnp.hypot(x, y)


def beam_weights(bearings: Array, gap: Array | float, bins: int) -> Array:
    """Share (bins, B) of each beam in each bearing bin: a hat as wide as a bin or a gap between beams, if wider."""
    width = jnp.maximum(2 * jnp.pi / bins, 1.01 * gap)
    return jnp.maximum(0.0, 1.0 - jnp.abs(wrap_angle(bin_centres(bins)[:, None] - bearings)) / width)


class Conditions(NamedTuple):
    """How a scan is poorer than its lidar's configuration says; training varies it from scan to scan.

    Attributes:
        reach: () maximal range, metres.
        gap: () angle between the beams that are left, radians; the others are NaN.
    """

    reach: Array | float
    gap: Array | float


def polar_features(
    ranges: Array, lidar: LidarConfig, config: DSOMConfig, conditions: Conditions | None = None
) -> Array:
    """What the polar encoder reads of one scan.

    Args:
        ranges: (B,) metres, REP-117; NaN (invalid) and -inf (too close) beams count as not seen.
        lidar: geometry of the beams.
        config: of the network.
        conditions: of this scan; the lidar's own if not given.

    Returns:
        (A, 3 + R): visible, no return, range / range_max, radial basis, in bins of bearing from -pi on.
    """
    conditions = conditions or Conditions(lidar.range_max, abs(lidar.angle_increment))
    limit = jnp.minimum(min(lidar.range_max, config.range_max), conditions.reach)
    seen = jnp.isfinite(ranges) | jnp.isposinf(ranges)
    returned = jnp.isfinite(ranges) & (ranges < limit)
    bearings, distance = beam_geometry(ranges, lidar, limit)
    weights = beam_weights(bearings, conditions.gap, config.angular_bins) * seen
    total = weights.sum(-1, keepdims=True)
    features = weights @ range_features(distance, returned, config) / jnp.maximum(total, 1e-6)
    visible = jnp.minimum(total, 1.0)
    return jnp.concatenate([visible, features * visible], axis=-1)
