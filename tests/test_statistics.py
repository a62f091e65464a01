"""Paired statistics against closed forms, enumeration, scipy and simulations whose answer is known."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from dsom_jax.judging import statistics as s
from dsom_jax.judging.metrics import bootstrap

flags = st.lists(st.tuples(st.booleans(), st.booleans()), max_size=60)


@given(flags)
def test_mcnemar_is_a_sum_of_binomial_coefficients(pairs):
    a, b = (np.array([pair[side] for pair in pairs], bool) for side in (0, 1))
    test = s.mcnemar(a, b)
    n, k = test.only_a + test.only_b, min(test.only_a, test.only_b)
    tail = sum(math.comb(n, i) for i in range(k + 1)) / 2**n
    # Both tails are alike, and overlap in the middle.
    assert test.p == pytest.approx(min(1.0, 2 * tail), rel=1e-9)
    assert sum(test[:4]) == len(pairs) and test.both == sum(x and y for x, y in pairs)


def test_mcnemar_by_hand():
    # 8 pairs for a, none for b: two tails of 1 / 256.
    assert s.mcnemar([1] * 10, [1, 1] + [0] * 8) == (2, 8, 0, 0, pytest.approx(2 / 256))
    assert s.mcnemar([1, 0], [0, 1]).p == 1.0 and s.mcnemar([1, 1], [1, 1]).p == 1.0 and s.mcnemar([], []).p == 1.0


def enumerated(differences) -> float:
    """Two-sided p-value of the signed-rank statistic over all 2^n signs, for differences without ties."""
    ranks = stats.rankdata(np.abs(differences))
    seen = abs(ranks[differences > 0].sum() - ranks.sum() / 2)
    signs = np.array(list(itertools.product([0, 1], repeat=len(ranks))))
    return float((np.abs(signs @ ranks - ranks.sum() / 2) >= seen - 1e-9).mean())


@given(st.lists(st.floats(-9, 9).filter(lambda v: abs(v) > 1e-3), min_size=2, max_size=9, unique_by=abs))
def test_signed_rank_enumerates_all_signs(differences):
    a = np.array(differences)
    test = s.signed_rank(a, np.zeros(len(a)))
    assert test.p == pytest.approx(enumerated(a), abs=1e-9)
    assert test.median == pytest.approx(np.median(a)) and (test.pairs, test.ties) == (len(a), 0)


def test_signed_rank_leaves_out_what_has_no_number_and_keeps_ties():
    a, b = [1.0, 2.0, np.inf, np.nan, 5.0, 6.0, np.inf], [1.0, 3.0, 1.0, 2.0, np.nan, 9.0, np.inf]
    test = s.signed_rank(a, b)
    # Differences 0, -1, inf, -3, 0: an infinite error counts as the worst, two of them as equal.
    assert (test.pairs, test.ties, test.median) == (5, 2, 0.0)
    assert test.p == s.signed_rank([0.0, -1, 99, -3, 0], np.zeros(5)).p
    assert s.signed_rank([1.0, 2.0], [1.0, 2.0]) == (2, 2, 0.0, 1.0)
    empty = s.signed_rank([np.nan], [1.0])
    assert empty.pairs == 0 and empty.p == 1.0 and math.isnan(empty.median)
    rng = np.random.default_rng(0)
    x, y = rng.normal(size=80), rng.normal(0.4, 1, 80)
    assert s.signed_rank(x, y).p == pytest.approx(stats.wilcoxon(x, y).pvalue, rel=1e-12)


def test_zero_differences_take_ranks_but_no_side():
    """Pratt 1959: the ranks of zeros are given away before those of the others; normal approximation."""
    difference = np.random.default_rng(0).normal(0.3, 1, 80)
    difference[::4] = 0.0
    ranks, n, zeros = stats.rankdata(np.abs(difference)), 80, 20
    positive = ranks[difference > 0].sum()
    mean = (n * (n + 1) - zeros * (zeros + 1)) / 4
    variance = (n * (n + 1) * (2 * n + 1) - zeros * (zeros + 1) * (2 * zeros + 1)) / 24
    p = 2 * stats.norm.sf(abs(positive - mean) / math.sqrt(variance))
    assert s.signed_rank(difference, np.zeros(n)).p == pytest.approx(p, rel=1e-6)


@given(st.lists(st.floats(0, 1), min_size=1, max_size=12))
def test_holm_is_the_stepwise_procedure(p):
    """Rejected at alpha is exactly what stepping through the sorted p-values rejects (Holm 1979)."""
    adjusted = s.holm(p)
    for alpha in (0.01, 0.05, 0.2, 0.5):
        rejected = set()
        for step, index in enumerate(np.argsort(p, kind="stable")):
            if p[index] * (len(p) - step) > alpha:
                break
            rejected.add(int(index))
        assert {i for i, value in enumerate(adjusted) if value <= alpha} == rejected


def test_holm_by_hand():
    assert s.holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert s.holm([0.9, 0.8]) == [1.0, 1.0] and s.holm([0.03]) == [0.03] and s.holm([]) == []


def test_one_value_to_a_cluster_is_the_plain_bootstrap():
    values = np.random.default_rng(1).gamma(2, size=60)
    low, high = s.clustered_bootstrap(values, np.arange(60), resamples=20_000)
    plain = stats.bootstrap((values,), np.mean, method="percentile", n_resamples=20_000, random_state=0)
    # Percentiles of 20,000 means, whose standard deviation is that of the mean: noise of a 2.5 % point about 2 % of it.
    tolerance = 0.1 * values.std() / math.sqrt(60)
    assert low == pytest.approx(plain.confidence_interval.low, abs=tolerance)
    assert high == pytest.approx(plain.confidence_interval.high, abs=tolerance)


def test_clusters_widen_the_interval_by_what_theory_says():
    """Variance of the two-stage mean: that of cluster means over S, plus that within over all runs."""
    rng = np.random.default_rng(2)
    groups, size = 40, 25
    centres = rng.normal(0, 1, groups)
    values = (centres[:, None] + rng.normal(0, 1, (groups, size))).ravel()
    clusters = np.repeat(np.arange(groups), size)
    low, high = s.clustered_bootstrap(values, clusters, resamples=20_000)
    means, within = values.reshape(groups, size).mean(1), values.reshape(groups, size).var(1).mean()
    sigma = math.sqrt(means.var() / groups + within / (groups * size))
    assert high - low == pytest.approx(2 * 1.96 * sigma, rel=0.04)
    narrow = bootstrap(values)
    assert high - low > 3 * (narrow[1] - narrow[0])
    assert s.clustered_bootstrap(values, clusters)[0] == s.clustered_bootstrap(values, clusters)[0]


def test_the_interval_covers_the_truth_as_often_as_it_says():
    """120 experiments of 20 sequences x 10 runs without any difference: 95 % of the intervals should hold 0.

    With 20 clusters a percentile interval covers a little less, about 93 %: 104 of 120 is three standard deviations
    below that. Intervals that take runs for independent cover less than half.
    """
    rng = np.random.default_rng(3)
    covered = naive = 0
    for trial in range(120):
        difference = (rng.normal(0, 1, (20, 1)) + rng.normal(0, 0.5, (20, 10))).ravel()
        low, high = s.clustered_bootstrap(difference, np.repeat(np.arange(20), 10), trial, resamples=400)
        covered += low <= 0 <= high
        low, high = bootstrap(difference, trial, resamples=100)
        naive += low <= 0 <= high
    assert covered >= 104 and naive < 72


def test_within_one_cluster_it_is_the_plain_bootstrap_too():
    values = np.random.default_rng(5).normal(size=60)
    low, high = s.clustered_bootstrap(values, np.zeros(60), resamples=20_000)
    assert high - low == pytest.approx(2 * 1.96 * values.std() / math.sqrt(60), rel=0.05)
    assert [low, high] != s.clustered_bootstrap(values, np.zeros(60), seed=1, resamples=20_000)
    (only, same) = s.clustered_bootstrap(values, np.zeros(60), resamples=1)
    assert only == same != values.mean()


def test_unequal_clusters_count_by_their_runs():
    values, clusters = np.array([1.0, 1, 1, 1, 5]), np.array([0, 0, 0, 0, 1])
    low, high = s.clustered_bootstrap(values, clusters)
    assert (low, high) == (1.0, 5.0)
    # Half of the draws have both clusters: (4 * 1 + 5) / 5. A quarter each has one of them twice.
    assert s.clustered_bootstrap(values, clusters, level=0.4) == [1.8, 1.8]
    assert s.paired_difference(values, np.zeros(5), clusters).mean == pytest.approx(1.8)


def test_paired_difference_and_its_edges():
    a, b = np.array([1.0, 2.0, np.inf, 4.0]), np.array([0.5, 1.5, 1.0, np.nan])
    assert s.paired_difference(a, b, [0, 1, 1, 2]) == (0.5, 0.5, 0.5, 2, 2)
    nothing = s.paired_difference([np.nan], [1.0], [0])
    assert math.isnan(nothing.mean) and math.isnan(nothing.low) and nothing.pairs == nothing.sequences == 0
    for wrong in (([1.0], [1.0, 2.0]), ([[1.0]], [[1.0]])):
        with pytest.raises(ValueError, match="one shape"):
            s.paired_difference(*wrong, [0])


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
        ([YES, OPEN], "holds in part"),
        ([YES, NO], "holds in part"),
        ([OPEN], "does not hold here"),
        ([NO, OPEN], "does not hold here"),
    ],
)
def test_verdicts(evidence, outcome):
    verdict = s.decide("faster", evidence)
    assert verdict.outcome == outcome and verdict.evidence == tuple(evidence)
    assert str(verdict).splitlines()[0] == f"faster: {outcome}" and len(str(verdict).splitlines()) == 1 + len(evidence)


def test_how_sure_one_wants_to_be():
    assert s.decide("", [piece(-2, -1, p=0.1)]).outcome == "does not hold here"
    assert s.decide("", [piece(-2, -1, p=0.1)], alpha=0.2).outcome == "holds"


def test_evidence_has_the_p_value_of_its_test_and_the_wanted_side():
    sequence = np.repeat(np.arange(10), 4)
    b = np.random.default_rng(0).normal(size=40)
    a = b - np.random.default_rng(1).uniform(0.5, 1, 40)
    less, greater = (s.value_evidence("E_pos, m", a, b, sequence, wanted=side) for side in ("less", "greater"))
    assert less.p == greater.p == s.signed_rank(a, b).p < 1e-6
    assert (less.status(), greater.status()) == ("supports", "contradicts")
    rate = s.rate_evidence("converged", b > 0, a > 0, sequence)
    assert rate.p == s.mcnemar(b > 0, a > 0).p and rate.wanted == "greater"
    assert rate.estimate == pytest.approx((b > 0).mean() - (a > 0).mean())


def test_no_evidence_is_no_verdict():
    with pytest.raises(ValueError, match="at least one"):
        s.decide("faster", [])


def test_a_family_is_corrected_together():
    family = [piece(-2, -1, p=0.03), YES, piece(-2, -1, p=0.04)]
    corrected = s.corrected(family)
    assert [e.p for e in corrected] == [pytest.approx(0.06), None, pytest.approx(0.06)]
    assert s.decide("", family).outcome == "holds" and s.decide("", corrected).outcome == "holds in part"
