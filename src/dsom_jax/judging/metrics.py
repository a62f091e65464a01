"""How good an estimate is: errors, convergence, retention, and how sure these numbers are (paper, section V-A).

The paper counts a run as converged once E_pos < 2 m and E_theta < 10 deg held for 5 consecutive updates, which says
nothing about what happens next: retention, re-loss and strict success do. Updates whose reference is unknown (NaN)
are passed over everywhere: they neither help nor harm. Statistics are NumPy on the host, in float64.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from dsom_jax.geometry import wrap_angle
from dsom_jax.types import Array

POSITION = 2.0
"""Metres within which an estimate counts as in the right place."""
ANGLE = math.radians(10)
"""Radians within which it counts as facing the right way."""
HOLD = 5
"""Consecutive updates that make a run converged."""
STRICT_POSITION, STRICT_ANGLE = 0.5, math.radians(5)
CONFIDENT = 0.05
"""A filter whose lost probability is below this claims to know where it is."""
STEP_BINS = {"0-20": (0, 20), "20-40": (21, 40), "40-60": (41, 60), ">60": (61, math.inf)}
"""Converging steps of the paper's histogram, both ends included."""


class Runs(NamedTuple):
    """What one phase of R runs came to, one entry per run, (R,) each.

    Attributes:
        steps: updates before convergence, -1 never (see :func:`convergence_step`).
        after: number of updates after convergence was established; ``stayed``: those of them inside the threshold.
        relost: converged, then outside for HOLD consecutive updates or at the last one.
        e_pos: metres at the last update; ``e_theta``: radians at the last update.
        known: number of updates with a reference; ``confident``: those at which the filter claimed to know, and
            ``fooled``: those at which it did and was wrong. NaN for filters that claim nothing.
    """

    steps: np.ndarray
    after: np.ndarray
    stayed: np.ndarray
    relost: np.ndarray
    e_pos: np.ndarray
    e_theta: np.ndarray
    known: np.ndarray
    confident: np.ndarray
    fooled: np.ndarray


def pose_error(estimate: Array, truth: Array) -> tuple[Array, Array]:
    """E_pos (metres) and E_theta (radians in [0, pi]) of poses (..., 3), shapes broadcast.

    NaN where the truth is unknown; +inf where it is known and the estimate is not a number.
    """
    difference = jnp.asarray(estimate) - jnp.asarray(truth)
    known = jnp.isfinite(jnp.asarray(truth)).all(-1)
    valid = jnp.isfinite(difference).all(-1)
    e_pos = jnp.hypot(difference[..., 0], difference[..., 1])
    e_theta = jnp.abs(wrap_angle(difference[..., 2]))
    missing = jnp.where(known, jnp.inf, jnp.nan)
    return jnp.where(valid, e_pos, missing), jnp.where(valid, e_theta, missing)


def convergence_step(
    e_pos: Any, e_theta: Any, pos: float = POSITION, theta: float = ANGLE, hold: int = HOLD
) -> np.ndarray:
    """STEPS: index of the first update of the first ``hold`` consecutive ones inside the threshold, -1 never.

    Counts the updates before the estimate was right: a filter that is right at the very first update, and stays so,
    takes 0 steps. Errors are (..., T) in metres and radians, the answer is (...).
    """
    e_pos, e_theta = np.asarray(e_pos), np.asarray(e_theta)
    inside = (e_pos < pos) & (e_theta < theta)
    return first_streak(inside, ~np.isnan(e_pos + e_theta), hold)[0]


def first_streak(flags: np.ndarray, valid: np.ndarray, hold: int) -> tuple[np.ndarray, np.ndarray]:
    """First and last index of the first ``hold`` true ``flags`` in a row over the last axis, both -1 without one.

    Entries that are not ``valid`` are skipped: they neither continue nor break a streak.
    """
    count, start, first, last = (np.full(flags.shape[:-1], value) for value in (0, 0, -1, -1))
    for t in range(flags.shape[-1]):
        start = np.where(count == 0, t, start)
        count = np.where(valid[..., t], np.where(flags[..., t], count + 1, 0), count)
        found = (last < 0) & (count >= hold)
        first, last = np.where(found, start, first), np.where(found, t, last)
    return first, last


def measure(estimates: Any, truth: Any, lost: Any = None) -> Runs:
    """Judge R runs of one phase: estimates (R, T, 3), truth (T, 3), lost probabilities (R, T) or None."""
    e_pos, e_theta = (np.asarray(e, np.float64) for e in pose_error(estimates, truth))
    return measure_errors(e_pos, e_theta, lost)


def measure_errors(e_pos: np.ndarray, e_theta: np.ndarray, lost: Any = None) -> Runs:
    """As :func:`measure`, from errors (R, T); runs without any reference are dropped."""
    rows = ~np.isnan(e_pos).all(-1)
    e_pos, e_theta = e_pos[rows], e_theta[rows]
    claims = np.full(e_pos.shape, np.nan) if lost is None else np.asarray(lost, np.float64)[rows]
    known = ~np.isnan(e_pos)
    inside = (e_pos < POSITION) & (e_theta < ANGLE)
    start, end = first_streak(inside, known, HOLD)
    # The streak itself is inside by definition, so what is kept is counted from the update after it.
    after = known & (np.arange(e_pos.shape[-1]) > end[:, None]) & (end >= 0)[:, None]
    last = known.shape[-1] - 1 - np.argmax(known[:, ::-1], axis=-1)
    at_end = np.arange(len(last)), last
    relost = (first_streak(~inside, after, HOLD)[0] >= 0) | ((end >= 0) & ~inside[at_end])
    confident, fooled = _claims(claims, known, inside)
    return Runs(start, after.sum(-1), (after & inside).sum(-1), relost, e_pos[at_end], e_theta[at_end],
                known.sum(-1), confident, fooled)  # fmt: skip


def _claims(lost: np.ndarray, known: np.ndarray, inside: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(R,) updates at which the filter claims to know where it is, and those of them at which it errs."""
    confident = known & (lost < CONFIDENT)
    silent = np.isnan(lost).all(-1)
    return np.where(silent, np.nan, confident.sum(-1)), np.where(silent, np.nan, (confident & ~inside).sum(-1))


def pool(parts: Sequence[Runs]) -> Runs:
    """The runs of several episodes as one set of experiments; none gives an empty set."""
    parts = [*parts, Runs(*[np.zeros(0, kind) for kind in (int, int, int, bool, float, float, int, float, float)])]
    return Runs(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def retention(runs: Runs) -> float:
    """Share of the updates after convergence that stay inside the threshold, over all converged runs; NaN if none."""
    return ratio(runs.stayed.sum(), runs.after.sum())


def false_confident(runs: Runs) -> float:
    """Share of the updates at which the filter claims confidence while the error is > 2 m or > 10 deg."""
    judged = ~np.isnan(runs.confident)
    return ratio(runs.fooled[judged].sum(), runs.known[judged].sum())


def ratio(part: float, whole: float) -> float:
    """part / whole, NaN when there is nothing to divide."""
    return float(part) / float(whole) if whole else math.nan


def wilson(rate: float, n: float, z: float = 1.959963984540054) -> list[float]:
    """Wilson score interval of a rate seen in ``n`` independent trials (95 % by default), [0, 1] without any."""
    if not n or math.isnan(rate):
        return [0.0, 1.0]
    centre = rate + z * z / (2 * n)
    half = z * math.sqrt(max(rate * (1 - rate), 0.0) / n + z * z / (4 * n * n))
    scale = 1 + z * z / n
    return [max(0.0, (centre - half) / scale), min(1.0, (centre + half) / scale)]


def bootstrap(values: np.ndarray, seed: int = 0, resamples: int = 2000) -> list[float]:
    """95 % percentile bootstrap interval of the mean of ``values`` (n,); NaN when there are none."""
    if not len(values):
        return [math.nan, math.nan]
    rng = np.random.default_rng(seed)
    means = [values[rng.integers(len(values), size=len(values))].mean() for _ in range(resamples)]
    return [float(bound) for bound in np.percentile(means, [2.5, 97.5])]


def phases(kidnapped: Any) -> dict[str, list[slice]]:
    """The updates (T,) of an episode cut at its kidnappings: ``global`` up to the first, ``kidnap`` after each one.

    A kidnapping at update 0 is none: nothing was known before.
    """
    moved = np.flatnonzero(np.asarray(kidnapped))
    cuts = [0, *(int(t) for t in moved if t > 0), len(np.asarray(kidnapped))]
    parts = [slice(a, b) for a, b in pairwise(cuts)]
    return {"global": parts[:1], "kidnap": parts[1:]}


def metres_travelled(steps: np.ndarray, odometry: Any) -> np.ndarray:
    """Metres driven until STEPS (R,), by the odometry (T, 3) of the phase; NaN where never converged."""
    driven = np.cumsum(np.hypot(*np.asarray(odometry, np.float64).T[:2]))
    return np.where(steps < 0, np.nan, (driven - driven[0])[steps])


def summarize(runs: Runs, seed: int = 0) -> dict[str, Any]:
    """The numbers of a results table; rates are in [0, 1], NaN where there is nothing to average.

    Final errors are those of the last update with a reference. Intervals (``_ci95``) are Wilson's for rates, with runs
    as the trials (updates of one run are no independent trials), and a seeded bootstrap over runs for means.
    """
    converged = runs.steps >= 0
    return {
        "experiments": len(runs.steps),
        **_rate("converged", ratio(converged.sum(), len(converged)), len(converged)),
        "steps_median": _median(runs.steps[converged]),
        "steps_hist": steps_histogram(runs.steps),
        **_rate("within_20", ratio((converged & (runs.steps <= 20)).sum(), len(converged)), len(converged)),
        **_errors(runs, converged, seed),
        **_rate("retention", retention(runs), (runs.after > 0).sum()),
        **_rate("re_loss", ratio(runs.relost.sum(), converged.sum()), converged.sum()),
        **_rate("strict_success", ratio(strict_success(runs).sum(), len(converged)), len(converged)),
        **_rate("false_confident", false_confident(runs), (~np.isnan(runs.confident)).sum()),
        "confident": ratio(np.nansum(runs.confident), runs.known[~np.isnan(runs.confident)].sum()),
    }


def strict_success(runs: Runs) -> np.ndarray:
    """(R,) whether the last estimate is within 0.5 m and 5 deg."""
    return (runs.e_pos < STRICT_POSITION) & (runs.e_theta < STRICT_ANGLE)


def steps_histogram(steps: np.ndarray) -> dict[str, int]:
    """Counts of converging steps in the paper's four intervals, and of runs that never converged."""
    counts = {name: int(((steps >= low) & (steps <= high)).sum()) for name, (low, high) in STEP_BINS.items()}
    return counts | {"never": int((steps < 0).sum())}


def _errors(runs: Runs, converged: np.ndarray, seed: int) -> dict[str, Any]:
    """Final errors over converged runs, and over all of them."""
    e_pos, e_theta = runs.e_pos[converged], runs.e_theta[converged]
    return {
        "e_pos_m": _mean(e_pos),
        "e_pos_ci95": bootstrap(e_pos, seed),
        "e_pos_m_median": _median(e_pos),
        "e_theta_rad": _mean(e_theta),
        "e_theta_ci95": bootstrap(e_theta, seed),
        "e_theta_rad_median": _median(e_theta),
        "final_e_pos_m_all": _mean(runs.e_pos),
        "final_e_pos_all_ci95": bootstrap(runs.e_pos, seed),
        "final_e_theta_rad_all": _mean(runs.e_theta),
        "final_e_theta_all_ci95": bootstrap(runs.e_theta, seed),
    }


def _rate(name: str, rate: float, n: Any) -> dict[str, Any]:
    return {name: float(rate), f"{name}_ci95": wilson(float(rate), float(n))}


def _mean(values: np.ndarray) -> float:
    return float(values.mean()) if len(values) else math.nan


def _median(values: np.ndarray) -> float:
    return float(np.median(values)) if len(values) else math.nan
