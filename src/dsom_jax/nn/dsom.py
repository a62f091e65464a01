"""DSOM: (map, scan) -> probability map PM over (x, y, theta). Section III of the paper."""

from __future__ import annotations

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from dsom_jax.lidar import LidarConfig, scan_image
from dsom_jax.nn.config import DSOMConfig
from dsom_jax.nn.decoder import Decoder, Similarity
from dsom_jax.nn.encoders import EnvironmentEncoder, PaperScanEncoder, PolarScanEncoder
from dsom_jax.nn.panorama import PanoramaEncoder
from dsom_jax.nn.polar import Conditions, polar_features
from dsom_jax.nn.pooling import pad_to_multiple
from dsom_jax.nn.similarity import cosine_similarity
from dsom_jax.types import Array


class MapFeatures(NamedTuple):
    """What the environment encoder says of one map; compute it once for each map.

    Attributes:
        features: M of Eq 2, (h, w, D) with h = ceil(H / 8), w = ceil(W / 8).
        indices: int8 argmax of the three pools, (4h, 4w, w), (2h, 2w, 2w), (h, w, 4w).
        panorama: (4h, 4w, D) features of the views from every second cell, or None.
        free: (H, W) bool, cells that may receive probability.
    """

    features: Array
    indices: tuple[Array, ...]
    panorama: Array | None
    free: Array


class Outputs(NamedTuple):
    """Logits (N, S, H, W, K) of PM before the softmax, and SIM, for the auxiliary loss."""

    logits: Array
    similarity: Similarity


class DSOM(nnx.Module):
    """The network; batched over N maps with S scans each, so that scans share the environment encoder's pass."""

    def __init__(self, config: DSOMConfig, rng: np.random.Generator) -> None:
        self.config = config
        self.environment = EnvironmentEncoder(config, rng)
        self.scan = PolarScanEncoder(config, rng) if config.encoder == "polar" else PaperScanEncoder(config, rng)
        self.panorama = PanoramaEncoder(config, rng) if config.panorama else None
        self.decoder = Decoder(config, rng)
        # Sharpness of a softmax over SIM itself: of the auxiliary loss, and of the panorama's share of the logits.
        self.log_temperature = nnx.Param(jnp.full((), math.log(10.0), jnp.float32))
        self.log_sharpness = nnx.Param(jnp.full((), math.log(30.0), jnp.float32)) if config.panorama else None

    def observation(self, ranges: Array, lidar: LidarConfig, conditions: Conditions | None = None) -> Array:
        """What the scan encoder reads of one scan (B,): polar features (A, C) or the scan image (size, size)."""
        if self.config.encoder == "polar":
            return polar_features(ranges, lidar, self.config, conditions)
        limit = jnp.minimum(self.config.range_max, lidar.range_max if conditions is None else conditions.reach)
        ranges = jnp.where(ranges < limit, ranges, jnp.inf)
        return scan_image(ranges, lidar, self.config.resolution, self.config.scan_size)

    def encode(self, occupied: Array, free: Array, views: Array | None = None) -> MapFeatures:
        """Features of maps (N, H, W), H and W multiples of 8: Eq 2, and the panorama.

        ``views`` (N, H/2, W/2, A): expected ranges of maps that were finer, in place of those of ``occupied``.
        """
        features, indices = self.environment(occupied)
        if self.panorama is None:
            return MapFeatures(features, indices, None, free)
        return MapFeatures(
            features, indices, self.panorama(occupied) if views is None else self.panorama.encode(views), free
        )

    def similarity(self, maps: MapFeatures, observations: Array) -> Similarity:
        """Eq 1 and 3, sharpened, for N maps and observations (N, S, ...)."""
        n, s = observations.shape[:2]
        scan = self.scan(observations.reshape(n * s, *observations.shape[2:]))
        scan = scan.reshape(n, s, *scan.shape[1:])
        coarse = cosine_similarity(scan, maps.features[:, None]) * jnp.exp(self.log_temperature[...])
        if maps.panorama is None or self.log_sharpness is None:
            return Similarity(coarse, None)
        fine = cosine_similarity(scan, maps.panorama[:, None])
        return Similarity(coarse, fine * jnp.exp(self.log_sharpness[...]))

    def decode(self, maps: MapFeatures, observations: Array) -> Outputs:
        """Eq 1, 3 and 4 for N maps and observations (N, S, ...)."""
        similarity = self.similarity(maps, observations)
        return Outputs(self.decoder(similarity, maps.indices), similarity)

    def __call__(self, occupied: Array, observations: Array, views: Array | None = None) -> Outputs:
        """Maps (N, H, W), H and W multiples of 8, with observations (N, S, ...); ``views`` as for :meth:`encode`."""
        return self.decode(self.encode(occupied, ~occupied.astype(bool), views), observations)


def create(config: DSOMConfig, seed: int = 0) -> DSOM:
    """A network with fresh weights, in training mode."""
    return DSOM(config, np.random.default_rng(seed))


def evaluation_view(model: DSOM) -> DSOM:
    """The same weights, normalising with the stored statistics: what filters close over."""
    return nnx.view(model, use_running_average=True)


def encode_map(model: DSOM, occupied: Array, free: Array | None = None, views: Array | None = None) -> MapFeatures:
    """Environment features of one map at the network's resolution.

    Args:
        model: an evaluation view.
        occupied: (H, W) bool, cells that stop rays; any H and W.
        free: (H, W) bool, where the robot may stand; all that is not occupied if not given.
        views: (H'/2, W'/2, A) expected ranges of a finer map (:func:`dsom_jax.nn.panorama.finer_ranges`), H' and W'
            padded to multiples of 8.
    """
    free = ~occupied.astype(bool) if free is None else free
    views = None if views is None else views[None]
    return jax.tree.map(lambda x: x[0], model.encode(pad_to_multiple(occupied)[None], free[None], views))


def masked_log_softmax(logits: Array, free: Array) -> Array:
    """Log PM (..., H, W, K) from logits (..., H', W', K): -inf where ``free`` (..., H, W) is false, padding cut off."""
    h, w = free.shape[-2:]
    logits = jnp.where(free[..., None], logits[..., :h, :w, :], -jnp.inf)
    return logits - jax.nn.logsumexp(logits, axis=(-3, -2, -1), keepdims=True)


def log_probability_map(model: DSOM, features: MapFeatures, ranges: Array, lidar: LidarConfig) -> Array:
    """Log PM (H, W, K) of one scan (B,) on one map, theta_k = -pi + k 2pi/K; zero probability off free space."""
    return masked_log_softmax(one_scan(model, features, model.observation(ranges, lidar)), features.free)


def one_scan(model: DSOM, features: MapFeatures, observation: Array) -> Array:
    """Logits (H', W', K) of one scan on one map."""
    maps = jax.tree.map(lambda x: x[None], features)
    return model.decode(maps, observation[None, None]).logits[0, 0]
