"""Max pooling with indices and unpooling against loops, and their gradients against each other."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dsom_jax.nn.pooling import max_pool, max_unpool, pad_to_multiple
from reference import unpool as slow

SIZES = [(2, 2, 1), (4, 6, 3), (16, 8, 5)]


@pytest.mark.parametrize("shape", SIZES)
@pytest.mark.parametrize("levels", [2, 1000])  # two levels: many ties
def test_pool_and_unpool_equal_the_loops(shape, levels):
    rng = np.random.default_rng(shape[0])
    x = rng.integers(0, levels, shape).astype(np.float32)
    pooled, index = max_pool(jnp.asarray(x))
    expected, expected_index = slow.max_pool(x)
    np.testing.assert_array_equal(pooled, expected)
    np.testing.assert_array_equal(index, expected_index)
    values = rng.normal(size=pooled.shape).astype(np.float32)
    np.testing.assert_array_equal(max_unpool(jnp.asarray(values), index), slow.max_unpool(values, expected_index))


@pytest.mark.parametrize("shape", SIZES)
def test_gradients_equal_those_of_the_definition(shape):
    k_x, k_g, k_v = jax.random.split(jax.random.key(0), 3)
    x = jax.random.normal(k_x, shape)
    g = jax.random.normal(k_g, (shape[0] // 2, shape[1] // 2, shape[2]))

    def by_reshape(x):
        return x.reshape(g.shape[0], 2, g.shape[1], 2, g.shape[2]).max((1, 3))

    np.testing.assert_allclose(jax.vjp(lambda x: max_pool(x)[0], x)[1](g)[0], jax.vjp(by_reshape, x)[1](g)[0])
    # Unpooling is linear, so its gradient is its transpose: <unpool(v), u> = <v, transpose(u)>.
    index = max_pool(x)[1]
    v, u = jax.random.normal(k_v, g.shape), x
    transposed = jax.vjp(lambda v: max_unpool(v, index), v)[1](u)[0]
    np.testing.assert_allclose((max_unpool(v, index) * u).sum(), (v * transposed).sum(), rtol=1e-4)


def test_leading_axes_are_batch_axes():
    x = jax.random.normal(jax.random.key(1), (2, 3, 4, 4, 2))
    np.testing.assert_array_equal(max_pool(x)[1], jax.vmap(jax.vmap(lambda x: max_pool(x)[1]))(x))


def test_padding_appends_zeros():
    padded = pad_to_multiple(jnp.ones((9, 16)))
    assert padded.shape == (16, 16)
    assert padded.sum() == 9 * 16 and (padded[9:] == 0).all()
