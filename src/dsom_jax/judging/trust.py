"""Does an answer know when it is wrong? How good the probabilities ``p_lost`` are, held against what was wrong.

``p_lost`` is P(the reported pose is more than 2 m or 10 deg off); *wrong* is what happened. An alarm is raised where
``p_lost`` is at least a threshold. Host code, float64 NumPy and SciPy. A number that does not exist (nothing was ever
wrong, or everything was) is NaN.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy import stats

BINS = 15
COVERAGES = (0.5, 0.8, 0.9, 0.95)


def auroc(p_lost: Any, wrong: Any) -> float:
    """Probability that a wrong answer has the larger ``p_lost`` of a wrong and a right one; ties count half."""
    p, wrong = _pairs(p_lost, wrong)
    failures, successes = int(wrong.sum()), int((~wrong).sum())
    if not failures or not successes:
        return math.nan
    # The Mann-Whitney statistic from mid-ranks.
    rank_sum = stats.rankdata(p)[wrong].sum()
    return float((rank_sum - failures * (failures + 1) / 2) / (failures * successes))


def fpr_at_tpr(p_lost: Any, wrong: Any, tpr: float = 0.95) -> float:
    """Share of the right answers at which the alarm is raised, at the highest threshold that catches ``tpr`` of the
    wrong ones."""
    p, wrong = _pairs(p_lost, wrong)
    if wrong.all() or not wrong.any():
        return math.nan
    caught = np.sort(p[wrong])[::-1]
    # Rounding must not ask for one failure more than the share says: 0.95 * 20 is 19 and not 19.000000000000004.
    threshold = caught[math.ceil(round(tpr * len(caught), 9)) - 1]
    return float((p[~wrong] >= threshold).mean())


def ece(p_lost: Any, wrong: Any, bins: int = BINS) -> float:
    """Expected calibration error: |mean ``p_lost`` - share wrong| of bins of equal width, weighted by their answers."""
    p, wrong = _pairs(p_lost, wrong)
    where = np.minimum((p * bins).astype(int), bins - 1)
    gaps = np.bincount(where, p - wrong, bins)
    return float(np.abs(gaps).sum() / len(p)) if len(p) else math.nan


def brier(p_lost: Any, wrong: Any) -> float:
    """Mean squared difference of ``p_lost`` and what happened (0 or 1)."""
    p, wrong = _pairs(p_lost, wrong)
    return float(((p - wrong) ** 2).mean()) if len(p) else math.nan


def risk_at_coverage(p_lost: Any, wrong: Any, coverage: float) -> float:
    """Share wrong among the ``coverage`` of all answers with the smallest ``p_lost``.

    Of answers with the same ``p_lost`` at the edge so many are taken as are needed, and the share is its expectation
    over which.
    """
    p, wrong = _pairs(p_lost, wrong)
    count = math.ceil(round(coverage * len(p), 9))
    if not count:
        return math.nan
    _, group, sizes = np.unique(p, return_inverse=True, return_counts=True)
    share = np.bincount(group, wrong) / sizes
    taken = np.clip(count - (np.cumsum(sizes) - sizes), 0, sizes)
    return float((taken * share).sum() / count)


def trust(p_lost: Any, wrong: Any, coverages: Sequence[float] = COVERAGES) -> dict[str, Any]:
    """All of it for answers (n,), as JSON holds it: ``risk_at_coverage`` by coverage in per cent."""
    return {
        "answers": len(np.ravel(p_lost)),
        "wrong": float(np.mean(wrong)) if np.size(wrong) else math.nan,
        "auroc": auroc(p_lost, wrong),
        "fpr_at_95_tpr": fpr_at_tpr(p_lost, wrong),
        "ece": ece(p_lost, wrong),
        "brier": brier(p_lost, wrong),
        "risk_at_coverage": {f"{100 * c:g}": risk_at_coverage(p_lost, wrong, c) for c in coverages},
    }


def _pairs(p_lost: Any, wrong: Any) -> tuple[np.ndarray, np.ndarray]:
    """Probabilities (n,) in [0, 1] and booleans (n,)."""
    p, wrong = np.asarray(p_lost, float), np.asarray(wrong, bool)
    if p.ndim != 1 or p.shape != wrong.shape:
        raise ValueError(f"p_lost and wrong must have one shape (n,), got {p.shape} and {wrong.shape}")
    if not ((p >= 0) & (p <= 1)).all():
        raise ValueError("p_lost must lie in [0, 1] and be known; leave out answers of filters that give none")
    return p, wrong
