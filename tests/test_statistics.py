"""Statistics by drive against closed forms, enumeration, scipy and simulations whose answer is known."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from dsom_jax.judging import statistics as s


def test_one_run_to_a_drive_is_the_plain_bootstrap():
    values = np.random.default_rng(1).gamma(2, size=60)
    low, high = s.interval(values, np.arange(60), resamples=20_000)
    plain = stats.bootstrap((values,), np.mean, method="percentile", n_resamples=20_000, rng=0)
    # Percentiles of 20,000 means, whose standard deviation is that of the mean: noise of a 2.5 % point about 2 % of it.
    tolerance = 0.1 * values.std() / math.sqrt(60)
    assert low == pytest.approx(plain.confidence_interval.low, abs=tolerance)
    assert high == pytest.approx(plain.confidence_interval.high, abs=tolerance)
    assert s.interval(values, np.arange(60), seed=3) == s.interval(values, np.arange(60), seed=3)


def test_drives_widen_the_interval_by_what_theory_says():
    """Variance of the mean of all runs: that of the means of the drives over their number."""
    rng = np.random.default_rng(2)
    groups, size = 40, 25
    values = rng.normal(0, 1, (groups, 1)) + rng.normal(0, 1, (groups, size))
    low, high = s.interval(values.ravel(), np.repeat(np.arange(groups), size), resamples=20_000)
    assert high - low == pytest.approx(2 * 1.96 * values.mean(1).std() / math.sqrt(groups), rel=0.04)
    # Runs taken for independent would give less than a third of it.
    assert high - low > 3 * 2 * 1.96 * values.std() / math.sqrt(groups * size)


def test_the_interval_covers_the_truth_as_often_as_it_says():
    """120 experiments of 20 drives x 10 runs without any difference: 95 % of the intervals should hold 0.

    With 20 drives a percentile interval covers a little less, about 93 %: 104 of 120 is three standard deviations
    below that. Intervals that take runs for independent cover less than half.
    """
    rng = np.random.default_rng(3)
    covered = naive = 0
    for trial in range(120):
        difference = (rng.normal(0, 1, (20, 1)) + rng.normal(0, 0.5, (20, 10))).ravel()
        low, high = s.interval(difference, np.repeat(np.arange(20), 10), seed=trial, resamples=400)
        covered += low <= 0 <= high
        naive += abs(difference.mean()) < 1.96 * difference.std() / math.sqrt(200)
    assert covered >= 104 and naive < 72


def test_unequal_drives_count_by_their_trials():
    values, drives = np.array([1.0, 1, 1, 1, 5]), np.array([0, 0, 0, 0, 1])
    assert s.interval(values, drives) == [1.0, 5.0]
    # Shares of updates: 4 of 4 and 1 of 16. Draws have both, or one twice.
    low, high = s.rate_interval([4, 1], [0, 1], [4, 16])
    assert (low, high) == (1 / 16, 1.0)
    assert s.evidence("", values, drives).estimate == pytest.approx(1.8)


def test_six_drives_out_of_six_say_no_more_than_wilson():
    drives = np.repeat(np.arange(6), 100)
    for found, agreed in ((6, np.ones(600)), (4, np.repeat([1.0, 1, 1, 1, 0, 0], 100))):
        wilson = stats.binomtest(found, 6).proportion_ci(method="wilson")
        assert s.rate_interval(agreed, drives) == pytest.approx([wilson.low, wilson.high])
    almost = np.ones(600)
    almost[0] = 0
    low, high = s.rate_interval(almost, drives)
    assert 0.99 < low < 599 / 600 and high == 1


def test_one_drive_says_nothing_of_others():
    assert np.isnan(s.interval([1.0, 2.0], [0, 0])).all() and np.isnan(s.interval([], [])).all()
    assert s.rate_interval([1.0, 0.0], [0, 0]) == s.rate_interval([], []) == [0.0, 1.0]
    # What every drive says is known without drawing any; an infinite error may be everybody's.
    assert s.interval([2.0, 2.0], [0, 1]) == [2.0, 2.0]
    assert s.interval([np.inf, 2.0], [0, 1]) == [2.0, math.inf]
    with pytest.raises(ValueError, match="one shape"):
        s.interval([1.0], [0, 1])


def enumerated(means) -> float:
    """Two-sided p-value of the mean over all 2^n signs."""
    signs = np.array(list(itertools.product([-1, 1], repeat=len(means))))
    seen = np.abs(means.sum())
    return float((np.abs(signs @ means) >= seen - 1e-9 * max(seen, 1)).mean())


@given(st.lists(st.integers(-8, 8), min_size=2, max_size=7))
@settings(deadline=None, max_examples=25)
def test_drive_test_enumerates_all_signs(means):
    values = np.array(means, float)
    runs, drives = np.repeat(values, 3) + np.tile([-1, 0, 1], len(values)), np.repeat(np.arange(len(values)), 3)
    assert s.drive_test(runs, drives) == pytest.approx(enumerated(values), abs=1e-9)


def test_drive_test_by_hand():
    # Six drives of one sign, however many runs: 2 / 64.
    assert s.drive_test(np.ones(600), np.repeat(np.arange(6), 100)) == pytest.approx(2 / 64)
    assert s.drive_test([1.0, 2.0], [0, 0]) == 1.0 and math.isnan(s.drive_test([], []))
    # 36 drives are too many to enumerate; 2^-35 is drawn never, and counted once in 100,000.
    assert s.drive_test(np.ones(36), np.arange(36)) < 1e-4


def test_paired_evidence_and_its_edges():
    a, b = np.array([1.0, 2.0, np.inf, 4.0]), np.array([0.5, 1.5, 1.0, np.nan])
    piece = s.paired_evidence("", a, b, [0, 1, 1, 2])
    assert (piece.estimate, piece.low, piece.high, piece.pairs, piece.drives) == (0.5, 0.5, 0.5, 2, 2)
    nothing = s.paired_evidence("", [np.nan], [1.0], [0])
    assert math.isnan(nothing.estimate) and nothing.pairs == 0 and nothing.status() == "undecided"
    assert "[" not in str(nothing) and str(nothing).endswith("undecided")
    with pytest.raises(ValueError, match="one shape"):
        s.paired_evidence("", [1.0], [1.0, 2.0], [0])


def test_evidence_is_about_its_bound():
    drives = np.repeat(np.arange(8), 5)
    values = 0.3 + 0.01 * np.random.default_rng(0).normal(size=40)
    less, more, beyond = (s.evidence("", values, drives, side, bound)
                          for side, bound in (("less", 0.4), ("greater", 0.2), ("less", 0.2)))  # fmt: skip
    assert [piece.status() for piece in (less, more, beyond)] == ["supports", "supports", "contradicts"]
    assert less.p == pytest.approx(2 / 256) and "p over 8 drives" in str(less)
    # Three drives cannot decide, whatever they show.
    assert s.evidence("", values[:15], drives[:15], "less", 0.4).status() == "undecided"


def piece(low, high, **rest) -> s.Evidence:
    return s.Evidence("E_pos, m", (low + high) / 2, low, high, **rest)


@pytest.mark.parametrize(
    ("evidence", "status"),
    [
        (piece(-2, -1), "supports"),
        (piece(1, 2), "contradicts"),
        (piece(-1, 1), "undecided"),
        (piece(-2, 0), "undecided"),
        (piece(1, 2, wanted="greater"), "supports"),
        (piece(-2, -1, wanted="greater"), "contradicts"),
        (piece(0.10, 0.14, bound=0.153), "supports"),
        (piece(0.16, 0.18, bound=0.153), "contradicts"),
        (piece(-2, -1, p=0.01), "supports"),
        (piece(-2, -1, p=0.2), "undecided"),
        (piece(1, 2, p=0.2), "undecided"),
        (piece(math.nan, math.nan), "undecided"),
        (piece(-2, -1, p=math.nan), "undecided"),
    ],
)
def test_status_needs_interval_and_test(evidence, status):
    assert evidence.status() == status and str(evidence).endswith(status)


YES, NO, OPEN = piece(-2, -1), piece(1, 2), piece(-1, 1)


@pytest.mark.parametrize(
    ("evidence", "outcome"),
    [
        ([YES], "holds"),
        ([YES, YES], "holds"),
        ([YES, OPEN], "undecided"),
        ([OPEN], "undecided"),
        ([YES, NO], "holds in part"),
        ([YES, NO, OPEN], "holds in part"),
        ([NO], "does not hold here"),
        ([NO, OPEN], "does not hold here"),
    ],
)
def test_decisions(evidence, outcome):
    verdict = s.decide("faster", evidence)
    assert verdict.outcome == outcome and verdict.evidence == tuple(evidence)
    assert str(verdict).splitlines()[0] == f"faster: {outcome}" and len(str(verdict).splitlines()) == 1 + len(evidence)


def test_no_evidence_is_no_decision():
    with pytest.raises(ValueError, match="at least one"):
        s.decide("faster", [])
