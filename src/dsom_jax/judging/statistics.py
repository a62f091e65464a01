"""How sure is a number, and is one method better than another? Intervals and tests by drive.

Runs of one drive share its map, scans and kidnapping: what is hard for one is hard for all, and 100 runs of a drive are
not 100 experiments. So every interval here draws drives, with all their runs, and every test is over drives. Run r of
all methods shares its key (:func:`dsom_jax.montecarlo.run_keys`), which makes comparisons paired: the luck of a run is
taken out. What so few drives cannot decide is called undecided. Host code, float64.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from scipy import stats

ALPHA = 0.05
RESAMPLES = 2000
Side = Literal["less", "greater"]
Status = Literal["supports", "contradicts", "undecided"]


def interval(values: Any, drives: Any, trials: Any = 1.0, seed: int = 0, resamples: int = RESAMPLES) -> list[float]:
    """95 % interval of sum(values) / sum(trials) over runs (n,) of ``drives`` (n,), a mean if every run is one trial.

    A percentile bootstrap that draws as many drives as there are, each with all of its runs. NaN for fewer than two:
    one drive does not say how others differ from it.
    """
    sums, counts = _by_drive(values, drives, trials)
    if len(sums) < 2:
        return [math.nan, math.nan]
    if np.ptp(sums / counts) == 0:
        return [float(sums[0] / counts[0])] * 2
    found = stats.bootstrap((sums, counts), lambda s, c, axis: s.sum(axis) / c.sum(axis), paired=True, vectorized=True,
                            n_resamples=resamples, method="percentile", confidence_level=1 - ALPHA,
                            rng=np.random.default_rng(seed))  # fmt: skip
    return [float(bound) for bound in found.confidence_interval]


def rate_interval(successes: Any, drives: Any, trials: Any = 1.0, seed: int = 0) -> list[float]:
    """As :func:`interval` for a share in [0, 1]; [0, 1] where nothing is known.

    Where all runs of each drive agree, drives are the trials, and the interval is Wilson's: six drives out of six say
    no more than 61 to 100 %, however many runs there were of each.
    """
    sums, counts = _by_drive(successes, drives, trials)
    if len(sums) and np.isin(sums / counts, (0, 1)).all():
        agreed = stats.binomtest(int((sums > 0).sum()), len(sums)).proportion_ci(1 - ALPHA, method="wilson")
        return [float(bound) for bound in agreed]
    low, high = interval(successes, drives, trials, seed)
    return [0.0, 1.0] if math.isnan(low) else [low, high]


def drive_test(values: Any, drives: Any) -> float:
    """Two-sided p-value of the exact sign-flip test that the means of the drives lie about 0; NaN without any.

    If a and b are alike, the difference of a drive is as likely with either sign. All signs are tried for up to 16
    drives, 99,999 drawn at random for more; six drives cannot give less than 2 / 64.
    """
    sums, counts = _by_drive(values, drives, 1.0)
    means = sums / counts
    if not len(means):
        return math.nan
    if len(means) == 1:
        return 1.0
    test = stats.permutation_test((means,), lambda x, axis: x.mean(axis), permutation_type="samples", vectorized=True,
                                  n_resamples=99_999, rng=np.random.default_rng(0))  # fmt: skip
    return float(test.pvalue)


def _by_drive(values: Any, drives: Any, trials: Any) -> tuple[np.ndarray, np.ndarray]:
    """Sums of ``values`` and ``trials`` over the runs of each drive, drives without any trial left out."""
    values, drives = np.asarray(values, float), np.asarray(drives)
    if values.ndim != 1 or values.shape != drives.shape:
        raise ValueError(f"values and drives must have one shape (n,), got {values.shape} and {drives.shape}")
    _, number = np.unique(drives, return_inverse=True)
    sums, counts = (np.bincount(number, v) for v in (values, np.broadcast_to(np.asarray(trials, float), values.shape)))
    return sums[counts > 0], counts[counts > 0]


@dataclass(frozen=True)
class Evidence:
    """One number that a claim rests on.

    Attributes:
        what: what the number is, with its unit.
        estimate, low, high: the number and its interval by drive.
        wanted: which side of ``bound`` the claim says it is on.
        bound: 0 for differences, the paper's number for values of its own.
        p: of :func:`drive_test`, None without one.
        pairs, drives: how many runs it is of, and of how many drives.
    """

    what: str
    estimate: float
    low: float
    high: float
    wanted: Side = "less"
    bound: float = 0.0
    p: float | None = None
    pairs: int = 0
    drives: int = 0

    def status(self) -> Status:
        """Whether the whole interval is on one side of the bound and the test, if there is one, agrees."""
        if self.p is not None and not self.p < ALPHA:
            return "undecided"
        below, above = self.high < self.bound, self.low > self.bound
        if not below and not above:
            return "undecided"
        return "supports" if below == (self.wanted == "less") else "contradicts"

    def __str__(self) -> str:
        test = "" if self.p is None or math.isnan(self.p) else f", p over {self.drives} drives {self.p:.2g}"
        sign = "<" if self.wanted == "less" else ">"
        bounds = "" if math.isnan(self.low) else f" [{self.low:.3g}, {self.high:.3g}]"
        return f"{self.what}: {self.estimate:.3g}{bounds}, claimed {sign} {self.bound:g}{test}: {self.status()}"


def evidence(what: str, values: Any, drives: Any, wanted: Side = "less", bound: float = 0.0, seed: int = 0) -> Evidence:
    """Evidence that the mean of ``values`` (n,) is on the ``wanted`` side of ``bound``; booleans give shares.

    Values that are not finite are left out.
    """
    values, drives = np.asarray(values, float), np.asarray(drives)
    kept = np.isfinite(values)
    values, drives = values[kept], drives[kept]
    mean = float(values.mean()) if len(values) else math.nan
    low, high = interval(values, drives, seed=seed)
    p = drive_test(values - bound, drives)
    return Evidence(what, mean, low, high, wanted, bound, p, len(values), len(np.unique(drives)))


def paired_evidence(
    what: str, a: Any, b: Any, drives: Any, wanted: Side = "less", bound: float = 0.0, seed: int = 0
) -> Evidence:
    """Evidence about a - b of the same runs (n,); pairs in which one is not finite are left out."""
    a, b = np.asarray(a, float), np.asarray(b, float)
    if a.shape != b.shape:
        raise ValueError(f"paired values must have one shape (n,), got {a.shape} and {b.shape}")
    both = np.isfinite(a) & np.isfinite(b)
    difference = np.subtract(a, b, where=both, out=np.full(a.shape, np.nan))
    return evidence(what, difference, drives, wanted, bound, seed)


@dataclass(frozen=True)
class Decision:
    """What the evidence says about a claim; made by :func:`decide`."""

    claim: str
    outcome: Literal["holds", "holds in part", "does not hold here", "undecided"]
    evidence: tuple[Evidence, ...]

    def __str__(self) -> str:
        return f"{self.claim}: {self.outcome}" + "".join(f"\n  {piece}" for piece in self.evidence)


def decide(claim: str, evidence: Sequence[Evidence]) -> Decision:
    """What becomes of a claim that says all of its ``evidence`` at once.

    ``holds`` if all of it supports the claim, which needs no correction for how many there are, as all must;
    ``does not hold here`` if some contradicts and none supports; ``holds in part`` if there is some of both; else
    ``undecided``: nothing contradicts, and not everything could be shown.
    """
    if not evidence:
        raise ValueError("decide: no evidence; a claim needs at least one number")
    found = {piece.status() for piece in evidence}
    if "contradicts" in found:
        return Decision(claim, "holds in part" if "supports" in found else "does not hold here", tuple(evidence))
    return Decision(claim, "holds" if found == {"supports"} else "undecided", tuple(evidence))
