"""Is one method better than another on the same sequences and seeds? Paired tests, intervals, verdicts.

Runs of one sequence share its map, scans and kidnapping, and run r of all methods shares its key
(:func:`dsom_jax.montecarlo.run_keys`). The second makes comparisons paired: the luck of a run is taken out. The first
means that 100 runs of a sequence are not 100 independent experiments: what is hard for one is hard for all. McNemar's
and Wilcoxon's tests do not know that and give p-values that are too small; the bootstrap here does, as it draws
sequences first. Evidence therefore needs both. With as few as six sequences even that interval is on the narrow
side. Host code, float64 NumPy; intervals for single rates and means are in :mod:`dsom_jax.judging.metrics`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple

import numpy as np
from scipy import stats

from dsom_jax.judging.metrics import ratio

ALPHA = 0.05
Outcome = Literal["holds", "holds in part", "does not hold here"]
Status = Literal["supports", "contradicts", "undecided"]


class McNemar(NamedTuple):
    """Exact test whether two methods succeed equally often; ``only_a``: pairs in which a alone did."""

    both: int
    only_a: int
    only_b: int
    neither: int
    p: float


class SignedRank(NamedTuple):
    """Wilcoxon's signed-rank test of a - b; ``pairs`` with two values, ``ties`` of them equal.

    ``median`` is that of the differences; p is two-sided, 1 where nothing differs.
    """

    pairs: int
    ties: int
    median: float
    p: float


class Difference(NamedTuple):
    """Mean of a - b over ``pairs`` with two finite values of ``sequences`` sequences, with a bootstrap interval."""

    mean: float
    low: float
    high: float
    pairs: int
    sequences: int


def mcnemar(a: Any, b: Any) -> McNemar:
    """Exact McNemar test of paired successes (n,): the discordant pairs are fair coins if neither is better."""
    a, b = _paired(a, b, bool)
    only_a, only_b = int((a & ~b).sum()), int((b & ~a).sum())
    discordant = only_a + only_b
    p = float(stats.binomtest(only_a, discordant).pvalue) if discordant else 1.0
    return McNemar(int((a & b).sum()), only_a, only_b, int((~a & ~b).sum()), p)


def signed_rank(a: Any, b: Any) -> SignedRank:
    """Wilcoxon's signed-rank test of paired values (n,), for errors and steps; zero differences ranked (Pratt).

    Pairs in which one is NaN are left out. So are, for steps, the runs that never converged
    (:attr:`.run_table.RunTable.converging_steps`): whether a method converges at all is :func:`mcnemar`'s
    question, and a made-up number of steps would decide the ranks. An infinite error is the worst there is.
    """
    a, b = _paired(a, b, float)
    kept = ~(np.isnan(a) | np.isnan(b))
    a, b = a[kept], b[kept]
    difference = np.subtract(a, b, where=a != b, out=np.zeros(len(a)))
    if not difference.any():
        return SignedRank(len(difference), len(difference), 0.0 if len(difference) else math.nan, 1.0)
    p = float(stats.wilcoxon(difference, zero_method="pratt").pvalue)
    return SignedRank(len(difference), int((difference == 0).sum()), float(np.median(difference)), p)


def paired_difference(
    a: Any, b: Any, sequence: Any, seed: int = 0, resamples: int = 2000, level: float = 1 - ALPHA
) -> Difference:
    """Mean of a - b over runs (n,) of ``sequence`` (n,), with :func:`clustered_bootstrap`; booleans give rates."""
    difference, kept = _differences(a, b)
    clusters = np.asarray(sequence)[kept]
    low, high = clustered_bootstrap(difference, clusters, seed, resamples, level)
    mean = ratio(difference.sum(), len(difference))
    return Difference(mean, low, high, len(difference), len(np.unique(clusters)))


def clustered_bootstrap(
    values: Any, clusters: Any, seed: int = 0, resamples: int = 2000, level: float = 1 - ALPHA
) -> list[float]:
    """Percentile interval of the mean of ``values`` (n,) that belong to ``clusters`` (n,): sequences of runs.

    Each resample draws as many clusters as there are, with replacement, and from each as many of its values. Values of
    one cluster go together: runs of one sequence are not independent, and drawing them one by one
    (:func:`dsom_jax.judging.metrics.bootstrap`) would take what is one sequence's for everybody's. NaN without values.
    """
    values, clusters = np.asarray(values, float), np.asarray(clusters)
    if not len(values):
        return [math.nan, math.nan]
    groups = [values[clusters == name] for name in np.unique(clusters)]
    rng = np.random.default_rng(seed)
    drawn = rng.integers(len(groups), size=(resamples, len(groups)))
    sums, counts = np.zeros(drawn.shape), np.zeros(drawn.shape)
    for number, group in enumerate(groups):
        where = drawn == number
        picks = rng.integers(len(group), size=(int(where.sum()), len(group)))
        sums[where], counts[where] = group[picks].sum(axis=-1), len(group)
    means = sums.sum(axis=-1) / counts.sum(axis=-1)
    tail = 50 * (1 - level)
    return [float(bound) for bound in np.percentile(means, [tail, 100 - tail])]


def holm(p: Sequence[float]) -> list[float]:
    """P-values of a family of tests, adjusted by Holm (1979), in their order: compare each with alpha.

    The chance of any false rejection in the family then is at most alpha, however the tests depend on each other.
    """
    values = np.asarray(p, float)
    order = np.argsort(values, kind="stable")
    steps = values[order] * np.arange(len(values), 0, -1)
    adjusted = np.empty(len(values))
    adjusted[order] = np.minimum(np.maximum.accumulate(steps), 1.0)
    return [float(value) for value in adjusted]


@dataclass(frozen=True)
class Evidence:
    """One number that a claim rests on.

    Attributes:
        what: what the number is, with its unit.
        estimate, low, high: the number and its interval.
        wanted: which side of ``bound`` the claim says it is on.
        bound: 0 for differences, the paper's number for values of its own.
        p: p-value of the test that goes with it, None without one; after :func:`corrected` that of the family.
    """

    what: str
    estimate: float
    low: float
    high: float
    wanted: Literal["less", "greater"] = "less"
    bound: float = 0.0
    p: float | None = None

    def status(self, alpha: float = ALPHA) -> Status:
        """Whether the whole interval is on one side of the bound and the test, if there is one, agrees."""
        if self.p is not None and not self.p < alpha:
            return "undecided"
        below, above = self.high < self.bound, self.low > self.bound
        if not below and not above:
            return "undecided"
        return "supports" if below == (self.wanted == "less") else "contradicts"

    def __str__(self) -> str:
        test = "" if self.p is None else f", p {self.p:.2g}"
        sign = "<" if self.wanted == "less" else ">"
        interval = f"{self.estimate:.3g} [{self.low:.3g}, {self.high:.3g}]"
        return f"{self.what}: {interval}, claimed {sign} {self.bound:g}{test}: {self.status()}"


@dataclass(frozen=True)
class Verdict:
    """What the evidence says about a claim; made by :func:`decide`."""

    claim: str
    outcome: Outcome
    evidence: tuple[Evidence, ...]

    def __str__(self) -> str:
        return f"{self.claim}: {self.outcome}" + "".join(f"\n  {piece}" for piece in self.evidence)


def corrected(evidence: Sequence[Evidence]) -> tuple[Evidence, ...]:
    """The evidence with the p-values of its tests adjusted by :func:`holm` as one family."""
    tested = [piece.p for piece in evidence if piece.p is not None]
    adjusted = iter(holm(tested))
    return tuple(piece if piece.p is None else replace(piece, p=next(adjusted)) for piece in evidence)


def decide(claim: str, evidence: Sequence[Evidence], alpha: float = ALPHA) -> Verdict:
    """``holds`` if all evidence supports the claim, ``does not hold here`` if none does, else ``holds in part``.

    What is undecided does not support: a claim that could not be shown here does not hold here. The p-values are
    taken as they are; correct them first over the family in which they were looked at (:func:`corrected`).
    """
    if not evidence:
        raise ValueError("decide: no evidence; a claim needs at least one number")
    supporting = sum(piece.status(alpha) == "supports" for piece in evidence)
    outcome: Outcome = "holds in part" if supporting else "does not hold here"
    return Verdict(claim, "holds" if supporting == len(evidence) else outcome, tuple(evidence))


def rate_evidence(what: str, a: Any, b: Any, sequence: Any, seed: int = 0) -> Evidence:
    """Evidence that a succeeds more often than b, from paired successes (n,): difference of rates, McNemar's p."""
    difference = paired_difference(np.asarray(a, float), np.asarray(b, float), sequence, seed)
    return Evidence(what, *difference[:3], wanted="greater", p=mcnemar(a, b).p)


def value_evidence(
    what: str, a: Any, b: Any, sequence: Any, seed: int = 0, wanted: Literal["less", "greater"] = "less"
) -> Evidence:
    """Evidence that a is ``wanted`` than b, from paired values (n,): difference of means, Wilcoxon's p."""
    difference = paired_difference(a, b, sequence, seed)
    return Evidence(what, *difference[:3], wanted=wanted, p=signed_rank(a, b).p)


def _paired(a: Any, b: Any, kind: type) -> tuple[np.ndarray, np.ndarray]:
    """Two arrays (n,) of one length."""
    a, b = np.asarray(a, kind), np.asarray(b, kind)
    if a.ndim != 1 or a.shape != b.shape:
        raise ValueError(f"paired values must have one shape (n,), got {a.shape} and {b.shape}")
    return a, b


def _differences(a: Any, b: Any) -> tuple[np.ndarray, np.ndarray]:
    """a - b where both are finite, and where that is (n,)."""
    a, b = _paired(a, b, float)
    kept = np.isfinite(a) & np.isfinite(b)
    return a[kept] - b[kept], kept
