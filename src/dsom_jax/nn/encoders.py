"""Encoders of the map and of the scan, Eq 1 and 2."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from flax import nnx

from dsom_jax.nn.config import DSOMConfig
from dsom_jax.nn.layers import CircularBlock, Dense, Stack, elu
from dsom_jax.nn.polar import polar_channels
from dsom_jax.nn.pooling import max_pool
from dsom_jax.types import Array


class EnvironmentEncoder(nnx.Module):
    """F_enc^env of Eq 2: [w, w] pool, [2w, 2w, 2w] pool, [4w, 4w, 4w, 4w] pool."""

    def __init__(self, config: DSOMConfig, rng: np.random.Generator) -> None:
        w = config.width
        self.stages = nnx.List([Stack(1, [w] * 2, rng), Stack(w, [2 * w] * 3, rng), Stack(2 * w, [4 * w] * 4, rng)])
        self.project = Dense(4 * w, config.depth, rng) if config.encoder == "polar" else None

    def __call__(self, occupied: Array) -> tuple[Array, tuple[Array, ...]]:
        """M_env (N, H, W) -> M (N, H/8, W/8, D) and the three int8 argmax indices of the pools."""
        x, indices = occupied[..., None].astype(jnp.float32), []
        for stage in self.stages:
            x, index = max_pool(stage(x))
            indices.append(index)
        return (x if self.project is None else self.project(x)), tuple(indices)


class PaperScanEncoder(nnx.Module):
    """The paper's F_enc^scan and MLP, Eq 1: five blocks of 2-D convolutions, then 16 cells -> 32 -> 32 -> K."""

    def __init__(self, config: DSOMConfig, rng: np.random.Generator) -> None:
        w = config.width
        sizes = [(1, w), (w, w), (w, 2 * w), (2 * w, 4 * w), (4 * w, 4 * w)]
        self.stages = nnx.List([Stack(i, [o, o], rng) for i, o in sizes])
        # 128 cells take five pools to 4 x 4, 64 cells four: then the first block does not pool.
        self.unpooled = 0 if config.scan_size == 128 else 1
        layers = [(16, 32), (32, 32), (32, config.headings)]
        self.mlp = nnx.List([Dense(i, o, rng) for i, o in layers])

    def __call__(self, images: Array) -> Array:
        """M_scan (N, size, size) -> S (N, K, 4w)."""
        x = images[..., None].astype(jnp.float32)
        for number, stage in enumerate(self.stages):
            x = stage(x)
            x = x if number < self.unpooled else max_pool(x)[0]
        x = x.reshape(x.shape[0], 16, -1).transpose(0, 2, 1)
        x = self.mlp[2](elu(self.mlp[1](elu(self.mlp[0](x)))))
        return x.transpose(0, 2, 1)


class PolarScanEncoder(nnx.Module):
    """Circular 1-D CNN over the bearings; the heading is not learnt but is a rotation of the features."""

    def __init__(self, config: DSOMConfig, rng: np.random.Generator) -> None:
        w = config.width
        self.headings = config.headings
        sizes = [(polar_channels(config), 2 * w), (2 * w, 2 * w), (2 * w, 4 * w), (4 * w, 4 * w), (4 * w, 4 * w)]
        self.blocks = nnx.List([CircularBlock(i, o, rng) for i, o in sizes])
        self.project = Dense(4 * w, config.channels, rng)

    def __call__(self, features: Array) -> Array:
        """Polar features (N, 4K, C) -> S (N, K, D): entry k holds the scan as it looks in the map frame at theta_k."""
        x = features
        for number, block in enumerate(self.blocks):
            x = block(x)
            if number in (1, 3):
                x = x.reshape(x.shape[0], -1, 2, x.shape[-1]).max(2)
        seen = features[..., 0].reshape(x.shape[0], self.headings, -1).mean(-1)
        return roll_to_headings(self.project(x) * seen[..., None])


def roll_to_headings(x: Array) -> Array:
    """Features (N, K, C) by bearing -> (N, K, K * C): row k rolled by k - K/2 bins, for theta_k = -pi + k 2pi/K."""
    k = x.shape[1]
    source = (jnp.arange(k)[None, :] - jnp.arange(k)[:, None] + k // 2) % k
    return x[:, source].reshape(x.shape[0], k, -1)
