"""Answers from particles: places, spread and verdict, held against clouds whose moments are known."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from dsom_jax.view.answers import HEAD, answers, from_particles, judged, particle_weights, spread, write_answers
from dsom_jax.view.story import Hypotheses

SD = np.array([0.2, 0.1, 0.05])
PLACES = np.array([[2.0, 1.0, 0.5], [9.0, -3.0, -2.0], [5.0, 8.0, np.pi - 0.01]])
SHARES = (0.6, 0.3, 0.1)


def cloud(seed=0, n=3000):
    """(1, N, 3) particles around three places, the third where headings wrap, and even weights (1, N)."""
    rng = np.random.default_rng(seed)
    parts = [place + SD * rng.normal(size=(round(n * share), 3)) for place, share in zip(PLACES, SHARES, strict=True)]
    poses = np.concatenate(parts)
    poses[:, 2] = (poses[:, 2] + np.pi) % (2 * np.pi) - np.pi
    poses = rng.permutation(poses)
    return poses[None], np.full((1, len(poses)), 1 / len(poses))


def test_places_of_a_cloud():
    weights, means, covariances = (part[0] for part in from_particles(*cloud()))
    np.testing.assert_allclose(weights[:3], SHARES, atol=1e-9)  # three standard deviations are well within a metre
    assert not weights[3:].any()
    gap = means[:3] - PLACES
    gap[:, 2] = (gap[:, 2] + np.pi) % (2 * np.pi) - np.pi
    counts = 3000 * np.array(SHARES)[:, None]
    assert (np.abs(gap) < 4 * SD / np.sqrt(counts)).all()
    # The relative standard deviation of a variance of n draws is sqrt(2 / n).
    seen = np.diagonal(covariances[:3], axis1=1, axis2=2)
    assert (np.abs(seen / SD**2 - 1) < 4 * np.sqrt(2 / counts)).all()


def test_weights_count_not_numbers():
    poses, weights = cloud()
    far = np.hypot(*(poses[0, :, :2] - PLACES[1, :2]).T) < 2
    weights = np.where(far, 5.0, 1.0)[None]
    weights /= weights.sum()
    found = from_particles(poses, weights)
    np.testing.assert_allclose(found.weights[0, :3], np.array([1.5, 0.6, 0.1]) / 2.2, atol=1e-9)


def test_spread_around_the_answer():
    poses, weights = cloud()
    sd = spread(PLACES[2:3], poses, weights)
    assert (np.abs(sd[0] / SD - 1) < 4 / np.sqrt(2 * 300)).all()
    # An answer where no particle is: all of them count.
    assert (spread(np.array([[50.0, 50.0, 0.0]]), poses, weights)[0, :2] > 40).all()


def places(*weights):
    padded = np.zeros((1, 6))
    padded[0, : len(weights)] = weights
    return Hypotheses(padded, np.zeros((1, 6, 3)), np.zeros((1, 6, 3, 3)))


@pytest.mark.parametrize(
    ("lost", "weights", "verdict"),
    [
        (0.01, (0.99,), "localized"),
        (0.4, (0.6, 0.4), "ambiguous"),
        (0.5, (0.5, 0.02), "lost"),
        (0.9, (0.1, 0.1, 0.05), "lost"),
    ],
)
def test_verdicts_by_thresholds(lost, weights, verdict):
    assert judged(np.array([lost]), places(*weights)) == (verdict,)


def result(**extra):
    poses, weights = cloud(n=300)
    info = SimpleNamespace(lost=np.array([[0.02]]), **extra)
    return info, SimpleNamespace(poses=poses, log_weights=np.log(weights))


def test_what_a_filter_says_itself_comes_first():
    own = places(0.7, 0.3)
    batched = Hypotheses(*(part[None] for part in own))
    info, kept = result(p_lost=np.array([[0.3]]), verdict=np.array([[1]]), hypotheses=batched)
    said = answers(np.array([3.0]), PLACES[None, :1], info, kept)
    assert said.p_lost == [0.3] and said.verdicts == ("ambiguous",)
    np.testing.assert_array_equal(said.hypotheses.weights, own.weights)
    info, kept = result()
    said = answers(np.array([3.0]), PLACES[None, :1], info, kept)
    assert said.p_lost == [0.02] and said.verdicts == ("localized",) and (said.hypotheses.weights > 0).sum() == 3


def test_states_of_both_kinds_have_weights():
    even = np.full((2, 4), 0.25)
    np.testing.assert_allclose(particle_weights(SimpleNamespace(log_weights=np.log(even))), even)
    np.testing.assert_allclose(particle_weights(SimpleNamespace(normalised=even)), even)


def test_file_of_answers(tmp_path):
    info, kept = result()
    first = answers(np.array([3.0]), PLACES[None, :1], info, kept)
    again = answers(np.array([3.0]), PLACES[None, 1:2], info, kept)
    write_answers(tmp_path / "answers.csv", [first, again])
    head, row = (tmp_path / "answers.csv").read_text().splitlines()
    assert tuple(head.split(",")) == HEAD and row.startswith("3.000000,2,1,0.5,") and row.endswith(",localized,3")
