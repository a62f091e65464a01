"""Ancestors: how often, and never one of zero weight."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dsom_jax import resampling
from dsom_jax.resampling import pick, pick_in_rows, soft_resample

SCHEMES = ["systematic", "multinomial"]
resample = jax.jit(resampling.draw_ancestors, static_argnums=(2, 3))


def some_weights(seed: int, n: int = 50) -> np.ndarray:
    weights = np.random.default_rng(seed).exponential(size=n).astype(np.float32)
    weights[::7] = 0.0
    return weights


@pytest.mark.parametrize("method", SCHEMES)
@pytest.mark.parametrize("scale", [1.0, 1e-20, 1e20])
def test_shares_are_the_weights(method, scale):
    weights = some_weights(0)
    n = 40_000
    ancestors = resample(jax.random.key(1), jnp.asarray(weights * np.float32(scale)), n, method)
    shares = np.bincount(ancestors, minlength=50) / n
    assert np.abs(shares - weights / weights.sum()).max() < 5 * 0.5 / math.sqrt(
        n
    )  # a binomial deviates by 0.5 / sqrt(n)
    assert (shares[weights == 0] == 0).all()


@given(st.integers(0, 10_000))
def test_systematic_counts_are_floor_or_ceil(seed):
    weights = some_weights(seed)
    counts = np.bincount(resample(jax.random.key(seed), jnp.asarray(weights), 50, "systematic"), minlength=50)
    expected = weights.astype(float) / weights.sum() * 50
    assert (counts >= np.floor(expected - 1e-4)).all() and (counts <= np.ceil(expected + 1e-4)).all()
    assert counts.sum() == 50


def test_systematic_has_less_variance_than_multinomial():
    weights = jnp.asarray(some_weights(3))
    keys = jax.random.split(jax.random.key(0), 300)
    spread = {}
    for method in SCHEMES:
        ancestors = jax.jit(jax.vmap(lambda k, m=method: resampling.draw_ancestors(k, weights, 50, m)))(keys)
        counts = np.stack([np.bincount(row, minlength=50) for row in np.asarray(ancestors)])
        spread[method] = counts.var(0).sum()
    assert spread["systematic"] < 0.5 * spread["multinomial"]


@pytest.mark.parametrize("method", SCHEMES)
def test_a_single_survivor(method):
    weights = jnp.zeros(100).at[37].set(1e-30)
    np.testing.assert_array_equal(resample(jax.random.key(0), weights, 64, method), 37)
    assert resample(jax.random.key(0), jnp.array([2.0]), 5, method).tolist() == [0] * 5


@pytest.mark.parametrize("seed", range(4))
def test_float32_sums_that_fall_short_never_reach_a_zero_weight(seed):
    # Ten thousand float32 terms sum to 1 - 1e-5 or so; the last hundred weights are zero.
    rng = np.random.default_rng(seed)
    weights = rng.random(10_000).astype(np.float32)
    weights[-100:] = 0.0
    weights[:50] = 0.0
    weights /= weights.sum()
    cumulative = jnp.cumsum(jnp.asarray(weights))
    extremes = jnp.array([0.0, 1e-45, 0.5, 1.0 - 2.0**-24, 1.0, float(np.nextafter(np.float32(1), np.float32(0)))])
    chosen = np.asarray(pick(cumulative, extremes))
    assert (weights[chosen] > 0).all()
    drawn = np.asarray(pick(cumulative, jax.random.uniform(jax.random.key(seed), (20_000,))))
    assert (weights[drawn] > 0).all()


def test_pick_by_hand():
    cumulative = jnp.array([0.0, 0.25, 0.25, 1.0, 1.0])
    np.testing.assert_array_equal(pick(cumulative, jnp.array([0.0, 0.2, 0.25, 0.5, 0.999])), [1, 1, 3, 3, 3])
    assert pick(cumulative, jnp.array([0.5])).dtype == jnp.int32


def test_a_key_is_a_draw():
    weights = jnp.asarray(some_weights(5))
    first, again, other = (resample(jax.random.key(k), weights, 50, "multinomial") for k in (0, 0, 1))
    np.testing.assert_array_equal(first, again)
    assert (first != other).any()


@given(st.integers(0, 10_000), st.integers(1, 70))
def test_picking_in_rows_is_picking_in_each_row(seed, width):
    rng = np.random.default_rng(seed)
    weights = rng.exponential(size=(6, width)).astype(np.float32) * (rng.random((6, width)) < 0.5)
    weights[:, rng.integers(width)] = 1.0
    cumulative = jnp.cumsum(jnp.asarray(weights), -1)
    rows, positions = rng.integers(0, 6, 40), jnp.asarray(rng.random(40), jnp.float32)
    found = pick_in_rows(cumulative, jnp.asarray(rows, jnp.int32), positions)
    alone = [int(pick(cumulative[row], position)) for row, position in zip(rows, positions, strict=True)]
    assert found.tolist() == alone
    assert (weights[rows, np.asarray(found)] > 0).all()


WEIGHTS = np.array([0.5, 0.3, 0.15, 0.05, 0.0])


def draw_softly(alpha, draws=4000, method="systematic"):
    """Ancestors and log weights (draws, 5)."""
    with np.errstate(divide="ignore"):
        logs = jnp.asarray(np.log(WEIGHTS), jnp.float32)
    keys = jax.random.split(jax.random.key(3), draws)
    drawn = jax.jit(jax.vmap(lambda key: soft_resample(key, logs, alpha, method)))(keys)
    return (np.asarray(part) for part in drawn)


@pytest.mark.parametrize("method", ["systematic", "multinomial"])
def test_soft_resampling_draws_from_the_mixture(method):
    ancestors, _ = draw_softly(0.5, method=method)
    mixture = 0.5 * WEIGHTS + 0.1
    counts = (ancestors[..., None] == np.arange(5)).sum(1)
    # The standard error of a count is at most that of multinomial draws; five of them.
    error = 5 * np.sqrt(5 * mixture * (1 - mixture) / len(counts))
    assert (np.abs(counts.mean(0) - 5 * mixture) < error).all()
    if method == "systematic":
        assert (np.abs(counts - 5 * mixture) < 1).all()


def test_soft_weights_are_unbiased():
    ancestors, logs = draw_softly(0.5)
    ratio = (WEIGHTS / (0.5 * WEIGHTS + 0.1))[ancestors]
    np.testing.assert_allclose(np.exp(logs), ratio / ratio.sum(1, keepdims=True), atol=1e-6)
    np.testing.assert_allclose(np.exp(logs).sum(1), 1.0, atol=1e-5)
    # sum_i w_i / q_i [a_i = k] / n has the expectation w_k: importance weights before they are normalised.
    shares = np.stack([(ratio * (ancestors == k)).mean(1) for k in range(5)], 1)
    error = 5 * shares.std(0) / np.sqrt(len(shares))
    assert (np.abs(shares.mean(0) - WEIGHTS) <= error + 1e-7).all()


def test_hard_resampling_is_the_special_case():
    ancestors, logs = draw_softly(1.0, draws=50)
    np.testing.assert_allclose(np.exp(logs), 0.2, rtol=1e-5)
    assert not (ancestors == 4).any()


@pytest.mark.parametrize("alpha", [0.3, 1.0])
def test_soft_weights_have_a_finite_gradient_which_hard_ones_lack(alpha):
    logs = jnp.array([0.0, -1.0, -2.0, -30.0, -jnp.inf])

    def estimate(logs):
        ancestors, weights = soft_resample(jax.random.key(0), logs, alpha)
        return (jnp.exp(weights) * jnp.arange(1.0, 6.0)[ancestors]).sum()

    gradient = np.asarray(jax.grad(estimate)(logs))
    assert np.isfinite(gradient).all()
    assert (np.abs(gradient).max() > 1e-3) == (alpha < 1)
