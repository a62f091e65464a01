"""Hand-written gradients against those JAX derives; cosine similarity against Eq 3."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from dsom_jax.nn import layers
from dsom_jax.nn.layers import (
    EPSILON,
    BatchNormELU,
    CircularBlock,
    Stack,
    batch_norm_elu,
    channel_sum,
    conv3x3,
    own_gradients,
    product,
)
from dsom_jax.nn.similarity import cosine_similarity


def test_convolution_and_its_gradients_equal_jax():
    keys = jax.random.split(jax.random.key(0), 3)
    x, kernel = jax.random.normal(keys[0], (2, 5, 7, 3)), jax.random.normal(keys[1], (3, 3, 3, 4))
    g = jax.random.normal(keys[2], (2, 5, 7, 4))

    def plain(x, kernel):
        return jax.lax.conv_general_dilated(x, kernel, (1, 1), "SAME", dimension_numbers=("NHWC", "HWIO", "NHWC"))

    np.testing.assert_allclose(conv3x3(x, kernel), plain(x, kernel), rtol=1e-5, atol=1e-5)
    for ours, theirs in zip(jax.vjp(conv3x3, x, kernel)[1](g), jax.vjp(plain, x, kernel)[1](g), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-4, atol=1e-4)


def test_batch_norm_elu_and_its_gradients_equal_jax():
    keys = jax.random.split(jax.random.key(1), 4)
    x = 2 + 3 * jax.random.normal(keys[0], (4, 8, 8, 5))
    scale, bias = 1 + 0.1 * jax.random.normal(keys[1], (5,)), jax.random.normal(keys[2], (5,))
    g = jax.random.normal(keys[3], x.shape)

    def plain(x, scale, bias):
        mean, variance = x.mean((0, 1, 2)), x.var((0, 1, 2))
        return jax.nn.elu((x - mean) / jnp.sqrt(variance + EPSILON) * scale + bias)

    out, pullback = jax.vjp(lambda *a: batch_norm_elu(*a)[0], x, scale, bias)
    expected, expected_pullback = jax.vjp(plain, x, scale, bias)
    np.testing.assert_allclose(out, expected, rtol=1e-4, atol=1e-4)
    for ours, theirs in zip(pullback(g), expected_pullback(g), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=2e-3, atol=2e-3)


def test_own_gradients_are_for_cpus_alone(monkeypatch):
    assert own_gradients() == (jax.default_backend() == "cpu")
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert not own_gradients()
    monkeypatch.setattr(layers, "OWN_GRADIENTS", True)
    assert own_gradients()


def test_both_sides_of_the_switch_give_the_same_network_and_gradients(monkeypatch):
    """Float32 sums of up to 3 x 3 x 5 x 128 products: rounding of some 1e-5 of the largest entry."""
    rng = np.random.default_rng(0)
    image, circle = (jnp.asarray(rng.normal(size=shape), jnp.float32) for shape in ((2, 8, 8, 3), (4, 8, 5)))
    graphs = [nnx.split(make, nnx.Param, ...) for make in (Stack(3, [5, 4], rng), CircularBlock(5, 6, rng))]

    def loss(params, graph, rest, x):
        model = nnx.merge(graph, params, rest)
        out = jnp.sin(model(x)).sum()
        return out, nnx.as_pure(nnx.state(model, nnx.BatchStat))

    found = {}
    for own in (True, False):
        monkeypatch.setattr(layers, "OWN_GRADIENTS", own)
        found[own] = [
            jax.value_and_grad(loss, has_aux=True)(nnx.as_pure(params), graph, nnx.as_pure(rest), x)
            for (graph, params, rest), x in zip(graphs, (image, circle), strict=True)
        ]
    for one, other in zip(*(jax.tree.leaves(found[own]) for own in (True, False)), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-3, atol=1e-4 * max(1.0, float(jnp.abs(one).max())))
    x, kernel = image[..., 0], jnp.ones((8, 2))
    np.testing.assert_allclose(product(x, kernel), x @ kernel, rtol=1e-6)


@pytest.mark.parametrize("shape", [(3,), (7, 3), (300, 2), (16, 32, 16, 4)])
def test_channel_sum_is_the_sum(shape):
    x = jax.random.normal(jax.random.key(2), shape)
    expected = np.asarray(x, np.float64).reshape(-1, shape[-1]).sum(0)
    np.testing.assert_allclose(channel_sum(x), expected, rtol=1e-4, atol=1e-3)


def test_batch_norm_keeps_running_statistics():
    norm = BatchNormELU(2)
    x = jnp.asarray([5.0, -3.0]) + jax.random.normal(jax.random.key(3), (64, 2))
    for _ in range(300):
        norm(x)
    np.testing.assert_allclose(norm.mean[...], x.mean(0), rtol=1e-3)
    np.testing.assert_allclose(norm.variance[...], x.var(0), rtol=1e-3)


def test_similarity_is_eq_3():
    keys = jax.random.split(jax.random.key(4), 2)
    scan, environment = jax.random.normal(keys[0], (4, 6)), jax.random.normal(keys[1], (2, 3, 6))
    similarity = np.asarray(cosine_similarity(scan, environment))
    for i, j, k in np.ndindex(2, 3, 4):
        s, m = np.asarray(scan[k]), np.asarray(environment[i, j])
        np.testing.assert_allclose(similarity[i, j, k], s @ m / (np.linalg.norm(s) * np.linalg.norm(m)), rtol=1e-4)


def test_similarity_of_nothing_is_finite():
    gradient = jax.grad(lambda s: cosine_similarity(s, jnp.zeros((1, 1, 3))).sum())(jnp.zeros((2, 3)))
    assert jnp.isfinite(gradient).all()
