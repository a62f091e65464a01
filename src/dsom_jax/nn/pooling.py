"""2 x 2 max pooling that remembers where each maximum was, and its inverse.

Both are linear once the indices are known and each is the transpose of the other, which is how their gradients are
written: selections that fuse with their neighbours, where ``reduce_window``'s own gradient is a slow scatter.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from dsom_jax.types import Array


def _quarters(x: Array) -> tuple[Array, Array, Array, Array]:
    """The four interleaved images (..., H/2, W/2, C) of x (..., H, W, C): index 2 * row + column within a window."""
    return x[..., ::2, ::2, :], x[..., ::2, 1::2, :], x[..., 1::2, ::2, :], x[..., 1::2, 1::2, :]


def _interleave(quarters: tuple[Array, Array, Array, Array]) -> Array:
    """Inverse of :func:`_quarters`."""
    a, b, c, d = quarters
    rows = jnp.stack([jnp.stack([a, b], axis=-2), jnp.stack([c, d], axis=-2)], axis=-4)
    *batch, h, _, w, _, channels = rows.shape
    return rows.reshape(*batch, 2 * h, 2 * w, channels)


def _select(x: Array, index: Array) -> Array:
    """Of each 2 x 2 window of x (..., H, W, C) the entry that ``index`` (..., H/2, W/2, C) names."""
    a, b, c, d = _quarters(x)
    return jnp.where(index < 2, jnp.where(index == 0, a, b), jnp.where(index == 2, c, d))


def _spread(x: Array, index: Array) -> Array:
    """Put x (..., h, w, C) at the places that ``index`` names, zero elsewhere: (..., 2h, 2w, C)."""
    a, b, c, d = (jnp.where(index == n, x, 0) for n in range(4))
    return _interleave((a, b, c, d))


@jax.custom_vjp
def max_pool(x: Array) -> tuple[Array, Array]:
    """Maximum of each 2 x 2 window and where it was.

    Args:
        x: (..., H, W, C), H and W even.

    Returns:
        (..., H/2, W/2, C) maxima and their int8 index 2 * row + column; ties go to the lower index.
    """
    a, b, c, d = _quarters(x)
    top, bottom = jnp.maximum(a, b), jnp.maximum(c, d)
    index = jnp.where(top >= bottom, jnp.where(a >= b, 0, 1), jnp.where(c >= d, 2, 3))
    return jnp.maximum(top, bottom), index.astype(jnp.int8)


def _max_pool_fwd(x: Array) -> tuple[tuple[Array, Array], Array]:
    pooled, index = max_pool(x)
    return (pooled, index), index


def _max_pool_bwd(index: Array, gradients: tuple[Array, Array]) -> tuple[Array]:
    return (_spread(gradients[0], index),)


max_pool.defvjp(_max_pool_fwd, _max_pool_bwd)


@jax.custom_vjp
def max_unpool(x: Array, index: Array) -> Array:
    """Unpooling of the paper's decoder: each entry returns to where the environment's maximum was.

    Args:
        x: (..., h, w, C).
        index: int8 of :func:`max_pool`, the same shape.

    Returns:
        (..., 2h, 2w, C), zero where nothing was put.
    """
    return _spread(x, index)


def _max_unpool_fwd(x: Array, index: Array) -> tuple[Array, Array]:
    return max_unpool(x, index), index


def _max_unpool_bwd(index: Array, gradient: Array) -> tuple[Array, None]:
    return _select(gradient, index), None


max_unpool.defvjp(_max_unpool_fwd, _max_unpool_bwd)


def pad_to_multiple(x: Array, multiple: int = 8) -> Array:
    """Pad axes -2 and -1 of x (..., H, W) with zeros at their ends up to multiples of ``multiple``."""
    padding = [(0, 0)] * (x.ndim - 2) + [(0, -x.shape[-2] % multiple), (0, -x.shape[-1] % multiple)]
    return jnp.pad(x, padding)
