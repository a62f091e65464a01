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
from dsom_jax.resampling import pick, pick_in_rows

SCHEMES = ["systematic", "multinomial"]
resample = jax.jit(resampling.resample, static_argnums=(2, 3))


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
        ancestors = jax.jit(jax.vmap(lambda k, m=method: resampling.resample(k, weights, 50, m)))(keys)
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
