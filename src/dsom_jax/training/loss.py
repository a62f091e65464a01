"""Losses: the paper's KLD (Eq 5) and a cross-entropy on SIM that makes learning start within minutes."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from dsom_jax.nn.dsom import Outputs
from dsom_jax.training.target import Target, dense, entropy, pooled
from dsom_jax.types import Array

PLACE_AXES = (-3, -2, -1)


class Losses(NamedTuple):
    """Means over a batch, in nats.

    Attributes:
        total: what is minimised.
        kld: Eq 5.
        similarity: cross-entropy of softmax(temperature * SIM) and the pooled ground truth.
    """

    total: Array
    kld: Array
    similarity: Array


def cross_entropy(logits: Array, truth: Array, free: Array) -> Array:
    """-sum GT log softmax(logits) over (x, y, theta), the softmax over free cells only.

    Args:
        logits: (..., H, W, K).
        truth: (..., H, W, K), zero off free cells, sums to one.
        free: (..., H, W) bool.
    """
    # A large finite number, not -inf: 0 * inf in the product with the truth would be NaN.
    logits = jnp.where(free[..., None], logits, -1e9)
    return jax.nn.logsumexp(logits, axis=PLACE_AXES) - (truth * logits).sum(PLACE_AXES)


def kld(logits: Array, truth: Array, free: Array) -> Array:
    """Eq 5: sum GT log(GT / PM) (...) with PM = softmax(logits) on free cells."""
    return cross_entropy(logits, truth, free) - entropy(truth)


def dsom_losses(outputs: Outputs, target: Target, free: Array, similarity_weight: float) -> Losses:
    """Losses of a batch: outputs for N maps x S scans, target factors (N, S, .), free (N, H, W)."""
    free = free[:, None]
    main = kld(outputs.logits, dense(target, free), free).mean()
    side = similarity_loss(outputs.similarity.coarse, target, free)
    if outputs.similarity.fine is not None:
        side += similarity_loss(outputs.similarity.fine, target, free)
    return Losses(main + similarity_weight * side, main, side)


def similarity_loss(similarity: Array, target: Target, free: Array) -> Array:
    """Mean cross-entropy of softmax(SIM), SIM (N, S, h, w, K), and the ground truth pooled to its cells."""
    factor = free.shape[-1] // similarity.shape[-2]
    n, _, h, w = free.shape
    coarse_free = free.reshape(n, 1, h // factor, factor, w // factor, factor).any((3, 5))
    return cross_entropy(similarity, pooled(target, free, factor), coarse_free).mean()
