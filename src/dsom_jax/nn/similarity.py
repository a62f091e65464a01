"""Eq 3: how well every heading of the scan fits every cell of the map."""

from __future__ import annotations

import jax.numpy as jnp

from dsom_jax.types import Array


def cosine_similarity(scan: Array, environment: Array, epsilon: float = 1e-6) -> Array:
    """SIM of Eq 3.

    Args:
        scan: S, (..., K, D), one feature vector for each heading.
        environment: M, (..., h, w, D), one feature vector for each cell.
        epsilon: keeps the quotient finite.

    Returns:
        (..., h, w, K) cosines.
    """
    products = jnp.einsum("...hwd,...kd->...hwk", environment, scan)
    norms = _norm(environment)[..., None] * _norm(scan)[..., None, None, :]
    return products / jnp.maximum(norms, epsilon)


def _norm(x: Array) -> Array:
    """Length of the vectors of the last axis, with a finite gradient at zero."""
    return jnp.sqrt(jnp.maximum((x * x).sum(-1), 1e-12))
