"""What a lidar would see from every second cell of a map, and its features: the map's side of a scan matcher.

The environment encoder of the paper has to learn from the picture of a map what is visible from where. Ray casting
knows it exactly; what is left to learn is which differences between the expected and the actual view matter.
"""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from dsom_jax.marching import empty_squares, march
from dsom_jax.nn.config import DSOMConfig
from dsom_jax.nn.layers import CircularBlock, Dense
from dsom_jax.nn.polar import bin_centres, range_features
from dsom_jax.types import Array

STRIDE = 2
"""Cells between neighbouring points of view."""

_CAP = 31


def expected_ranges(occupied: Array, config: DSOMConfig) -> Array:
    """Ranges (H/2, W/2, A) in metres from the centres of the 2 x 2 blocks of ``occupied`` (H, W); inf for no return."""
    return finer_ranges(occupied, config, (occupied.shape[0], occupied.shape[1]), config.resolution)


def finer_ranges(
    occupied: Array, config: DSOMConfig, shape: tuple[int, int], resolution: float, surface: float = 0.0
) -> Array:
    """The same for a map of ``shape`` (H, W) at the network's scale, cast in the finer one that it is made of.

    Resampled so that thin walls survive, a map has thicker walls and fewer gaps: at 1/3 m per cell 4 to 5 beams in ten
    of real logs end more than 0.5 m behind the walls of their map, at 0.1 m one.

    Args:
        occupied: (h, w) cells of ``resolution`` metres with the same lower-left corner.
        config: of the network.
        shape: H, W.
        resolution: metres per cell of ``occupied``.
        surface: metres behind the near edge of a wall at which beams end.
    """
    ratio = config.resolution / resolution
    # Points of view beyond the map see it from outside.
    beyond = [(0, max(math.ceil(side * ratio) - own, 0)) for side, own in zip(shape, occupied.shape, strict=True)]
    whole = jnp.pad(occupied.astype(bool), beyond)
    squares = empty_squares(jnp.pad(whole, 1, constant_values=True), _CAP)
    step = STRIDE * ratio
    y, x = jnp.meshgrid(*(step * (jnp.arange(side // STRIDE) + 0.5) for side in shape), indexing="ij")
    limit = (config.range_max - surface) / resolution
    return resolution * march(squares, x, y, jnp.zeros_like(x), bin_centres(config.angular_bins), limit) + surface


def view_features(ranges: Array, config: DSOMConfig) -> Array:
    """Features (..., K, 2 + R) of expected ranges (..., A), averaged over every heading's bearings."""
    ranges = ranges.reshape(*ranges.shape[:-1], config.headings, -1)
    return range_features(jnp.minimum(ranges, config.range_max), jnp.isfinite(ranges), config).mean(-2)


class PanoramaEncoder(nnx.Module):
    """A circular convolution over the headings and a projection; every heading's features have length one."""

    def __init__(self, config: DSOMConfig, rng: np.random.Generator) -> None:
        self.config = config
        self.block = CircularBlock(2 + config.radial_bins, 2 * config.width, rng)
        self.project = Dense(2 * config.width, config.channels, rng)

    def __call__(self, occupied: Array) -> Array:
        """M_env (N, H, W) -> (N, H/2, W/2, K * channels)."""
        # One map after the other: rays of a batch of maps would all wait for the last one.
        return self.encode(jax.lax.map(lambda one: expected_ranges(one, self.config), occupied))

    def encode(self, ranges: Array) -> Array:
        """Expected ranges (N, H/2, W/2, A) -> (N, H/2, W/2, K * channels)."""
        views = view_features(ranges, self.config)
        x = self.project(self.block(views.reshape(-1, *views.shape[-2:])))
        x = x * jax.lax.rsqrt((x * x).sum(-1, keepdims=True) + 1e-6)
        return x.reshape(*views.shape[:-2], -1)
