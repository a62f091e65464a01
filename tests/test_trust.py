"""How good p_lost is: against closed forms and against counting everything there is."""

from __future__ import annotations

import math
from itertools import combinations, product

import numpy as np
import pytest

from dsom_jax.judging import trust as t

RNG = np.random.default_rng(4)
# Tenths, so that there are ties within and between the two kinds.
P = RNG.integers(0, 11, 40) / 10
WRONG = RNG.random(40) < 0.2 + 0.6 * P


def test_auroc_counts_pairs():
    pairs = [(a > b) + 0.5 * (a == b) for a, b in product(P[WRONG], P[~WRONG])]
    assert t.auroc(P, WRONG) == pytest.approx(np.mean(pairs), abs=1e-12)
    assert t.auroc(WRONG.astype(float), WRONG) == 1 and t.auroc(1.0 - WRONG, WRONG) == 0
    assert t.auroc(np.full(40, 0.3), WRONG) == 0.5


def test_auroc_of_two_uniform_laws():
    # Wrong ones uniform on (0.25, 1), right ones on (0, 0.75): P(a > b) = 1 - (1/2) (0.5 / 0.75)^2 = 7 / 9.
    n = 4000
    u = (np.arange(n) + 0.5) / n
    p, wrong = np.concatenate([0.25 + 0.75 * u, 0.75 * u]), np.repeat([True, False], n)
    assert t.auroc(p, wrong) == pytest.approx(7 / 9, abs=2 / n)


@pytest.mark.parametrize("tpr", [0.5, 0.8, 0.95, 1.0])
def test_fpr_is_the_least_of_all_thresholds_that_catch_enough(tpr):
    found = [(P[~WRONG] >= c).mean() for c in np.unique(P) if (P[WRONG] >= c).mean() >= tpr - 1e-12]
    assert t.fpr_at_tpr(P, WRONG, tpr) == min(found)


def test_nineteen_of_twenty_failures_are_95_per_cent():
    p = np.concatenate([[0.1], np.full(19, 0.9), [0.5, 0.05]])
    wrong = np.arange(22) < 20
    # The one failure at 0.1 need not be caught: neither of the right answers raises an alarm at 0.9.
    assert t.fpr_at_tpr(p, wrong) == 0


def test_ece_bin_by_bin():
    total = 0.0
    for low in range(t.BINS):
        inside = (np.floor(P * t.BINS) == low) | ((P == 1) & (low == t.BINS - 1))
        if inside.any():
            total += inside.sum() / 40 * abs(P[inside].mean() - WRONG[inside].mean())
    assert t.ece(P, WRONG) == pytest.approx(total, abs=1e-12)


def test_calibrated_probabilities_have_no_calibration_error():
    # Of 100 answers at each of 0.2, 0.5 and 0.9 exactly so many are wrong.
    p = np.repeat([0.2, 0.5, 0.9], 100)
    wrong = np.concatenate([np.arange(100) < 100 * q for q in (0.2, 0.5, 0.9)])
    assert t.ece(p, wrong) == pytest.approx(0, abs=1e-12)
    # The Brier score of calibrated answers is the mean of p (1 - p).
    assert t.brier(p, wrong) == pytest.approx(np.mean(p * (1 - p)), abs=1e-12)
    assert t.ece(np.zeros(10), np.ones(10, bool)) == t.brier(np.zeros(10), np.ones(10, bool)) == 1


@pytest.mark.parametrize("coverage", [0.25, 0.5, 0.75, 1.0])
def test_risk_averages_over_all_ways_to_break_ties(coverage):
    p, wrong = np.array([0.1, 0.1, 0.1, 0.3, 0.3, 0.3, 0.3, 0.8]), np.array([0, 1, 0, 1, 1, 0, 0, 1], bool)
    count = round(8 * coverage)
    # All sets of so many answers that leave out none of a smaller p_lost.
    taken = [s for s in combinations(range(8), count)
             if all(p[i] >= p[list(s)].max() for i in set(range(8)) - set(s))]  # fmt: skip
    assert t.risk_at_coverage(p, wrong, coverage) == pytest.approx(np.mean([wrong[list(s)].mean() for s in taken]))


def test_risk_of_a_perfect_order_begins_when_the_right_ones_run_out():
    p, wrong = np.arange(100) / 100, np.arange(100) >= 90
    assert t.risk_at_coverage(p, wrong, 0.9) == 0
    assert t.risk_at_coverage(p, wrong, 0.95) == pytest.approx(5 / 95)


def test_nothing_to_say_is_nan():
    for wrong in (np.zeros(40, bool), np.ones(40, bool)):
        assert math.isnan(t.auroc(P, wrong)) and math.isnan(t.fpr_at_tpr(P, wrong))
    empty = t.trust([], [])
    assert empty.pop("answers") == 0 and all(math.isnan(v) for v in empty.pop("risk_at_coverage").values())
    assert all(math.isnan(v) for v in empty.values())


def test_trust_is_all_of_it():
    found = t.trust(P, WRONG)
    assert found["answers"] == 40 and found["wrong"] == pytest.approx(WRONG.mean())
    assert found["risk_at_coverage"].keys() == {"50", "80", "90", "95"}
    assert found["auroc"] == t.auroc(P, WRONG) and found["ece"] == t.ece(P, WRONG)


@pytest.mark.parametrize(("p", "wrong"), [([0.5, 1.2], [0, 1]), ([0.5, math.nan], [0, 1]), ([0.5], [0, 1])])
def test_what_is_no_probability_is_refused(p, wrong):
    with pytest.raises(ValueError, match="p_lost"):
        t.brier(p, wrong)
