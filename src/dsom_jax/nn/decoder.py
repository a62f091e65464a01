"""The distribution decoder F_dec of Eq 4."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from flax import nnx

from dsom_jax.nn.config import DSOMConfig
from dsom_jax.nn.layers import ConvBlock, Stack, conv3x3, normal
from dsom_jax.nn.pooling import max_unpool
from dsom_jax.types import Array


class Similarity(NamedTuple):
    """SIM of Eq 3 times the learnt sharpness of its softmax.

    Attributes:
        coarse: (N, S, h, w, K) with the environment encoder's features, h = H / 8.
        fine: (N, S, 4h, 4w, K) with the panorama's, or None.
    """

    coarse: Array
    fine: Array | None


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
        fine = k if config.panorama else 0
        head = ConvBlock if config.paper_head else LinearHead
        self.stages = nnx.List(
            [
                Stack(k + fine, [4 * w], rng),
                Stack(4 * w, [4 * w, 4 * w, 4 * w, 2 * w], rng),
                Stack(2 * w + fine, [2 * w, 2 * w, w], rng),
                Stack(w, [w], rng),
            ]
        )
        self.head = head(w, k, rng)

    def __call__(self, similarity: Similarity, indices: tuple[Array, ...]) -> Array:
        """SIM of S scans in each of N maps -> logits (N, S, 8h, 8w, K).

        ``indices`` are the environment encoder's, (N, ., ., C): all scans of a map share them.
        """
        n, s = similarity.coarse.shape[:2]
        coarse = similarity.coarse.reshape(n * s, *similarity.coarse.shape[2:])
        fine = None if similarity.fine is None else similarity.fine.reshape(n * s, *similarity.fine.shape[2:])
        x = self.stages[0](coarse if fine is None else jnp.concatenate([coarse, block_max(fine, 4)], axis=-1))
        for level, index in enumerate(reversed(indices)):
            x = max_unpool(x.reshape(n, s, *x.shape[1:]), jnp.broadcast_to(index[:, None], (n, s, *index.shape[1:])))
            x = x.reshape(n * s, *x.shape[2:])
            x = self.stages[level + 1](x if fine is None or level != 1 else jnp.concatenate([x, fine], axis=-1))
        x = self.head(x)
        x = x if fine is None else x + jnp.repeat(jnp.repeat(fine, 2, axis=1), 2, axis=2)
        return x.reshape(n, s, *x.shape[1:])


def block_max(x: Array, side: int) -> Array:
    """Maximum of each ``side`` x ``side`` block of x (N, H, W, C)."""
    n, h, w, c = x.shape
    return x.reshape(n, h // side, side, w // side, side, c).max((2, 4))
