"""Resampling: which ancestors survive."""

from __future__ import annotations

from typing import Literal

import jax
import jax.numpy as jnp

from dsom_jax.types import Array, Key

Resampling = Literal["systematic", "multinomial"]


def pick(cumulative: Array, positions: Array) -> Array:
    """Index of the first entry of ``cumulative`` (n,) above each of ``positions`` in [0, 1): never a zero weight.

    Positions are scaled by the last entry, as float32 sums fall short of one, and kept below it.
    """
    return pick_in_rows(cumulative[None], jnp.zeros(positions.shape, jnp.int32), positions)


def pick_in_rows(cumulative: Array, rows: Array, positions: Array) -> Array:
    """As :func:`pick`, each of ``positions`` (n,) in its own row ``rows`` (n,) of ``cumulative`` (m, k).

    Bisection that reads one entry at a time: no row is ever copied.
    """
    width = cumulative.shape[1]
    flat, first = cumulative.reshape(-1), rows * width
    total = flat[first + width - 1].astype(positions.dtype)
    scaled = jnp.minimum(positions * total, jnp.nextafter(total, jnp.zeros_like(total)))
    found = jnp.zeros_like(rows)
    for step in (2**power for power in reversed(range(width.bit_length()))):
        behind = (found + step <= width) & (flat[first + jnp.minimum(found + step, width) - 1] <= scaled)
        found = jnp.where(behind, found + step, found)
    return found.astype(jnp.int32)


def positions(key: Key, n: int, method: Resampling) -> Array:
    """(n,) positions in [0, 1): one stratum each for ``systematic``, independent for ``multinomial``."""
    if method == "systematic":
        return (jnp.arange(n) + jax.random.uniform(key)) / n
    return jax.random.uniform(key, (n,))


def draw_ancestors(key: Key, weights: Array, n: int, method: Resampling = "systematic") -> Array:
    """(n,) ancestors drawn by ``weights`` (m,), which need not be normalised (Probabilistic Robotics, table 4.4)."""
    return pick(jnp.cumsum(weights), positions(key, n, method))


def soft_resample(key: Key, log_weights: Array, alpha: float, method: Resampling = "systematic") -> tuple[Array, Array]:
    """Ancestors (n,) drawn from q = alpha w + (1 - alpha) / n, and their log weights (n,), proportional to w / q.

    PF-Net, Karkus et al. 2018, section 4: unlike weights that resampling makes equal, these have a gradient.
    ``log_weights`` (n,) need not be normalised; those returned are.
    """
    n = log_weights.shape[0]
    log_weights = jax.nn.log_softmax(log_weights)
    mixture = alpha * jnp.exp(log_weights) + (1 - alpha) / n
    ancestors = draw_ancestors(key, jax.lax.stop_gradient(mixture), n, method)
    # For alpha = 1 a particle of no weight is never drawn, but its 0 / 0 would be everybody's gradient.
    ratio = log_weights - jnp.log(jnp.maximum(mixture, jnp.finfo(mixture.dtype).tiny))
    return ancestors, jax.nn.log_softmax(ratio[ancestors])
