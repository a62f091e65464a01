"""Ground truth against loops, Eq 5, and the theorem of section III-C."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dsom_jax.training.loss import kld
from dsom_jax.training.target import dense, heading_weights, make_target, pooled
from reference.ground_truth import ground_truth

SHAPE, HEADINGS, RESOLUTION = (16, 24), 8, 0.5
FREE = jnp.ones(SHAPE, bool)


@pytest.mark.parametrize("pose", [(6.1, 4.2, 0.3), (0.1, 7.9, -3.1), (11.9, 0.2, 3.14), (3.0, 3.0, -math.pi)])
def test_ground_truth_equals_the_loops(pose):
    truth = dense(make_target(jnp.asarray(pose), SHAPE, HEADINGS, RESOLUTION), FREE)
    np.testing.assert_allclose(truth, ground_truth(pose, SHAPE, HEADINGS, RESOLUTION), atol=1e-6)


@pytest.mark.parametrize(("blur", "share"), [(3.0, 0.69), (1.0, 0.99), (0.1, 1.0)])
def test_blur_decides_how_much_truth_lies_within_three_cells(blur, share):
    truth = np.asarray(dense(make_target(jnp.asarray((6.25, 4.25, 0.0)), SHAPE, HEADINGS, RESOLUTION, blur), FREE))
    i, j = np.mgrid[: SHAPE[0], : SHAPE[1]]
    close = np.hypot(i - 8, j - 12) <= 3
    # By hand: 29 of the 49 cells of the blur lie within three cells of its middle.
    weights = np.exp(-0.5 * (np.arange(-3, 4) / blur) ** 2)
    plane = np.outer(weights, weights) / weights.sum() ** 2
    a, b = np.mgrid[-3:4, -3:4]
    expected = plane[np.hypot(a, b) <= 3].sum()
    assert abs(expected - share) < 0.02
    np.testing.assert_allclose(truth.sum(-1)[close].sum(), expected, atol=1e-5)


@settings(max_examples=30, deadline=None)
@given(st.floats(-3.14, 3.14))
def test_heading_weights_average_to_the_heading(theta):
    weights = np.asarray(heading_weights(jnp.float32(theta), HEADINGS))
    assert (weights > 0).sum() <= 2 and abs(weights.sum() - 1) < 1e-5
    angles = -np.pi + np.arange(HEADINGS) * 2 * np.pi / HEADINGS
    difference = (angles - theta + np.pi) % (2 * np.pi) - np.pi
    assert abs((weights * difference)[weights > 0].sum()) < 1e-4


def test_cells_that_are_not_free_have_no_truth():
    free = FREE.at[8, 12:].set(False)
    target = make_target(jnp.asarray([6.1, 4.2, 0.3]), SHAPE, HEADINGS, RESOLUTION)
    truth = dense(target, free)
    assert (truth[~free] == 0).all()
    np.testing.assert_allclose(truth.sum(), 1.0, rtol=1e-5)
    blocks = np.asarray(truth).reshape(2, 8, 3, 8, HEADINGS).sum((1, 3))
    np.testing.assert_allclose(pooled(target, free), blocks, atol=1e-6)


def test_kld_is_zero_at_the_truth_and_log_n_for_uniform():
    truth = dense(make_target(jnp.asarray([6.1, 4.2, 0.3]), SHAPE, HEADINGS, RESOLUTION), FREE)
    np.testing.assert_allclose(kld(jnp.log(truth + 1e-30), truth, FREE), 0.0, atol=1e-4)
    one_hot = jnp.zeros((*SHAPE, HEADINGS)).at[3, 4, 5].set(1.0)
    half = FREE.at[8:].set(False)
    expected = math.log(8 * 24 * HEADINGS)  # only free cells count
    np.testing.assert_allclose(kld(jnp.zeros_like(one_hot), one_hot, half), expected, rtol=1e-5)


@pytest.mark.parametrize("m", [1, 2, 5])
def test_theorem_of_section_3c(m):
    """m identical scans at m poses: the minimum of the summed KLD is 1/m at each, Eq 12."""
    rng = np.random.default_rng(m)
    cells = rng.choice(8 * 8 * 4, m, replace=False)
    truth = jnp.asarray(np.eye(8 * 8 * 4)[cells].reshape(m, 8, 8, 4), jnp.float32)
    free = jnp.ones((8, 8), bool)
    adam = optax.adam(0.3)

    def descend(carry, _):
        logits, moments = carry
        gradient = jax.grad(lambda x: kld(x[None], truth, free).sum())(logits)
        update, moments = adam.update(gradient, moments)
        return (logits + update, moments), None

    start = jnp.asarray(rng.normal(size=(8, 8, 4)), jnp.float32)
    (logits, _), _ = jax.lax.scan(descend, (start, adam.init(start)), length=400)
    pm = np.asarray(jax.nn.softmax(logits.ravel()))
    np.testing.assert_allclose(pm[cells], 1 / m, atol=0.01)
    assert pm[cells].sum() > 0.99
