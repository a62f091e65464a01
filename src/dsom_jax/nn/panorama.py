"""What a lidar would see from every second cell of a map, and its features: the map's side of a scan matcher.

The environment encoder of the paper has to learn from the picture of a map what is visible from where. Ray casting
knows it exactly; what is left to learn is which differences between the expected and the actual view matter.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from dsom_jax.nn.config import DSOMConfig
from dsom_jax.nn.layers import CircularBlock, Dense
from dsom_jax.nn.polar import bin_centres, range_features
from dsom_jax.raycast import empty_squares, march
from dsom_jax.types import Array

STRIDE = 2
"""Cells between neighbouring points of view."""

_CAP = 31


def expected_views(occupied: Array, config: DSOMConfig) -> Array:
    """What is seen from the centres of the 2 x 2 blocks of ``occupied`` (H, W), averaged over every heading's bearings.

    Returns:
        (H/2, W/2, K, 2 + R) range features.
    """
    squares = empty_squares(jnp.pad(occupied.astype(bool), 1, constant_values=True), _CAP)
    h, w = (side // STRIDE for side in occupied.shape)
    bearings = bin_centres(config.angular_bins)
    y, x = jnp.meshgrid(STRIDE * (jnp.arange(h) + 0.5), STRIDE * (jnp.arange(w) + 0.5), indexing="ij")
    limit = config.range_max / config.resolution
    cells = march(squares, x, y, jnp.zeros_like(x), bearings, limit)
    cells = cells.reshape(h, w, config.headings, -1)
    distance = jnp.minimum(cells * config.resolution, config.range_max)
    return range_features(distance, jnp.isfinite(cells), config).mean(-2)


class PanoramaEncoder(nnx.Module):
    """A circular convolution over the headings and a projection; every heading's features have length one."""

    def __init__(self, config: DSOMConfig, rng: np.random.Generator) -> None:
        self.config = config
        self.block = CircularBlock(2 + config.radial_bins, 2 * config.width, rng)
        self.project = Dense(2 * config.width, config.channels, rng)

    def __call__(self, occupied: Array) -> Array:
        """M_env (N, H, W) -> (N, H/2, W/2, K * channels)."""
        # One map after the other: rays of a batch of maps would all wait for the last one.
        views = jax.lax.map(lambda one: expected_views(one, self.config), occupied)
        x = self.project(self.block(views.reshape(-1, *views.shape[-2:])))
        x = x * jax.lax.rsqrt((x * x).sum(-1, keepdims=True) + 1e-6)
        return x.reshape(*views.shape[:-2], -1)
