"""The distribution decoder F_dec of Eq 4."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from flax import nnx

from dsom_jax.nn.config import DSOMConfig
from dsom_jax.nn.layers import ConvBlock, Stack, conv3x3, normal
from dsom_jax.nn.pooling import max_unpool
from dsom_jax.types import Array


class LinearHead(nnx.Module):
    """Last convolution, without norm and activation, so that the logits are not floored at -1."""

    def __init__(self, inputs: int, outputs: int, rng: np.random.Generator) -> None:
        self.kernel = nnx.Param(normal(rng, (3, 3, inputs, outputs), 0.01))
        self.bias = nnx.Param(jnp.zeros(outputs))

    def __call__(self, x: Array) -> Array:
        """(N, H, W, I) -> (N, H, W, O)."""
        return conv3x3(x, self.kernel[...]) + self.bias[...]


class Decoder(nnx.Module):
    """Conv 4w; unpool [4w, 4w, 4w, 2w]; unpool [2w, 2w, w]; unpool [w, K]."""

    def __init__(self, config: DSOMConfig, rng: np.random.Generator) -> None:
        w, k = config.width, config.headings
        head = ConvBlock if config.paper_head else LinearHead
        self.stages = nnx.List(
            [
                Stack(k, [4 * w], rng),
                Stack(4 * w, [4 * w, 4 * w, 4 * w, 2 * w], rng),
                Stack(2 * w, [2 * w, 2 * w, w], rng),
                Stack(w, [w], rng),
            ]
        )
        self.head = head(w, k, rng)

    def __call__(self, similarity: Array, indices: tuple[Array, ...]) -> Array:
        """SIM (N, S, h, w, K) of S scans in each of N maps -> logits (N, S, 8h, 8w, K).

        ``indices`` are the environment encoder's, (N, ., ., C): all scans of a map share them.
        """
        n, s = similarity.shape[:2]
        x = self.stages[0](similarity.reshape(n * s, *similarity.shape[2:]))
        for stage, index in zip(list(self.stages)[1:], reversed(indices), strict=True):
            x = max_unpool(x.reshape(n, s, *x.shape[1:]), jnp.broadcast_to(index[:, None], (n, s, *index.shape[1:])))
            x = stage(x.reshape(n * s, *x.shape[2:]))
        x = self.head(x)
        return x.reshape(n, s, *x.shape[1:])
