"""Answers of run 0: what the filter says, and the spread of its particles, held against clouds of known moments."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np

from dsom_jax.belief.verdict import Verdict
from dsom_jax.live.answer import said
from dsom_jax.view.answers import HEAD, answers, particle_weights, spreads, write_answers
from dsom_jax.view.story import VERDICTS, DriveHypotheses

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


def test_spread_around_the_answer():
    poses, weights = cloud()
    sd = spreads(PLACES[2:3], poses, weights)
    assert (np.abs(sd[0] / SD - 1) < 4 / np.sqrt(2 * 300)).all()
    # An answer where no particle is: all of them count.
    assert (spreads(np.array([[50.0, 50.0, 0.0]]), poses, weights)[0, :2] > 40).all()


def places(*weights):
    padded = np.zeros((1, 6))
    padded[0, : len(weights)] = weights
    return DriveHypotheses(padded, np.zeros((1, 6, 3)), np.zeros((1, 6, 3, 3)))


def result(verdicts=(Verdict.LOCALIZED,), p_lost=0.02, own=None):
    """Diagnostics and states of one run of as many updates as verdicts, all with the same particles."""
    count, (poses, weights) = len(verdicts), cloud(n=300)
    own = own or places(0.7, 0.3)
    info = SimpleNamespace(
        p_lost=np.full((1, count), p_lost),
        verdict=np.array([verdicts], np.int8),
        hypotheses=DriveHypotheses(*(np.repeat(part[None], count, axis=1) for part in own)),
    )
    kept = SimpleNamespace(poses=np.repeat(poses, count, 0), log_weights=np.log(np.repeat(weights, count, 0)))
    return info, kept


def test_answers_are_what_the_filter_says():
    info, kept = result((Verdict.AMBIGUOUS,), 0.3)
    told = answers(np.array([3.0]), PLACES[None, :1], info, kept)
    assert told.p_lost == [0.3] and told.verdicts == ("ambiguous",)
    np.testing.assert_array_equal(told.hypotheses.weights, places(0.7, 0.3).weights)


def test_a_verdict_has_one_name_wherever_it_is_told():
    names = tuple(verdict.name.lower() for verdict in Verdict)
    info, kept = result(tuple(Verdict))
    assert answers(np.arange(4.0), np.zeros((1, 4, 3)), info, kept).verdicts == names == VERDICTS
    live = [SimpleNamespace(p_lost=0.5, lost=0.5, verdict=np.int8(verdict)) for verdict in Verdict]
    assert tuple(said(info, np.zeros(3), np.eye(3))[1] for info in live) == names
    assert set(names) == {"localized", "ambiguous", "off_map", "lost"}  # the page has colours for these


def test_states_of_both_kinds_have_weights():
    even = np.full((2, 4), 0.25)
    np.testing.assert_allclose(particle_weights(SimpleNamespace(log_weights=np.log(even))), even)
    np.testing.assert_allclose(particle_weights(SimpleNamespace(normalised=even)), even)


def test_file_of_answers(tmp_path):
    info, kept = result(own=places(0.6, 0.3, 0.1))
    first = answers(np.array([3.0]), PLACES[None, :1], info, kept)
    again = answers(np.array([3.0]), PLACES[None, 1:2], info, kept)
    write_answers(tmp_path / "answers.csv", [first, again])
    head, row = (tmp_path / "answers.csv").read_text().splitlines()
    assert tuple(head.split(",")) == HEAD and row.startswith("3.000000,2,1,0.5,") and row.endswith(",localized,3")
