"""Eq 3: how well every heading of the scan fits every cell of the map."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from dsom_jax.types import Array


def cosine_similarity(scan: Array, environment: Array) -> Array:
    """SIM of Eq 3.

    Args:
        scan: S, (..., K, D), one feature vector for each heading.
        environment: M, (..., h, w, D), one feature vector for each cell.

    Returns:
        (..., h, w, K) cosines.
    """
    return jnp.einsum("...hwd,...kd->...hwk", _unit(environment), _unit(scan))


def _unit(x: Array) -> Array:
    """Vectors of the last axis at length one, with a finite gradient at zero."""
    return x * jax.lax.rsqrt(jnp.maximum((x * x).sum(-1, keepdims=True), 1e-12))
