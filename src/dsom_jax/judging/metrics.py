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
from dsom_jax.judging.statistics import interval, rate_interval
from dsom_jax.types import Array

POSITION = 2.0
"""Metres within which an estimate counts as in the right place."""
ANGLE = math.radians(10)
"""Radians within which it counts as facing the right way."""
HOLD = 5
"""Consecutive updates that make a run converged."""
STRICT_POSITION, STRICT_ANGLE = 0.5, math.radians(5)
STEP_BINS = {"0-20": (0, 20), "20-40": (21, 40), "40-60": (41, 60), ">60": (61, math.inf)}
"""Converging steps of the paper's histogram, both ends included."""


class Runs(NamedTuple):
    """What one phase of R runs came to, one entry per run, (R,) each.

    Attributes:
        steps: updates before the first of the HOLD that make a run converged, -1 never: 0 for a run that is right at
            the very first update, and stays so.
        after: number of updates after convergence was established; ``stayed``: those of them inside the threshold.
        relost: converged, then outside for HOLD consecutive updates or at the last one.
        e_pos: metres at the last update; ``e_theta``: radians at the last update.
        known: number of updates with a reference; ``confident``: those at which the filter claimed to know, and
            ``fooled``: those at which it did and was wrong. NaN for filters that claim nothing.
        metres: driven until convergence, by odometry; NaN where it never came, or the odometry is not known.
        drive: number of the drive; its runs are not independent, and intervals are over drives.
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
    metres: np.ndarray
    drive: np.ndarray

    @property
    def converged(self) -> np.ndarray:
        """(R,) bool."""
        return self.steps >= 0

    @property
    def early(self) -> np.ndarray:
        """(R,) bool, converged within 20 updates."""
        return self.converged & (self.steps <= 20)

    @property
    def strict(self) -> np.ndarray:
        """(R,) whether the last estimate is within 0.5 m and 5 deg."""
        return (self.e_pos < STRICT_POSITION) & (self.e_theta < STRICT_ANGLE)


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


def measure(estimates: Any, truth: Any, certain: Any = None, odometry: Any = None, drive: int = 0) -> Runs:
    """Judge R runs of one phase of a drive: estimates (R, T, 3), truth (T, 3), odometry (T, 3).

    ``certain`` (R, T) says at which updates the filter claims to know where it is; None for one that claims nothing.
    """
    e_pos, e_theta = (np.asarray(e, np.float64) for e in pose_error(estimates, truth))
    return measure_errors(e_pos, e_theta, certain, odometry, drive)


def measure_errors(
    e_pos: np.ndarray, e_theta: np.ndarray, certain: Any = None, odometry: Any = None, drive: int = 0
) -> Runs:
    """As :func:`measure`, from errors (R, T); runs without any reference are dropped."""
    rows = ~np.isnan(e_pos).all(-1)
    e_pos, e_theta = e_pos[rows], e_theta[rows]
    known = ~np.isnan(e_pos)
    inside = (e_pos < POSITION) & (e_theta < ANGLE)
    start, end = first_streak(inside, known, HOLD)
    # The streak itself is inside by definition, so what is kept is counted from the update after it.
    after = known & (np.arange(e_pos.shape[-1]) > end[:, None]) & (end >= 0)[:, None]
    last = known.shape[-1] - 1 - np.argmax(known[:, ::-1], axis=-1)
    at_end = np.arange(len(last)), last
    relost = (first_streak(~inside, after, HOLD)[0] >= 0) | ((end >= 0) & ~inside[at_end])
    nothing = np.full(len(last), np.nan)
    claims = known & np.asarray(certain, bool)[rows] if certain is not None else None
    confident, fooled = (nothing, nothing) if claims is None else (claims.sum(-1), (claims & ~inside).sum(-1))
    metres = nothing if odometry is None else metres_travelled(start, odometry)
    return Runs(start, after.sum(-1), (after & inside).sum(-1), relost, e_pos[at_end], e_theta[at_end],
                known.sum(-1), confident, fooled, metres, np.full(len(last), drive))  # fmt: skip


def pool(parts: Sequence[Runs]) -> Runs:
    """The runs of several drives, or parts of drives, as one set of experiments; none gives an empty set."""
    kinds = (int, int, int, bool, float, float, int, float, float, float, int)
    parts = [*parts, Runs(*[np.zeros(0, kind) for kind in kinds])]
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

    Final errors are those of the last update with a reference. Intervals (``_ci95``) are by drive:
    :func:`.statistics.rate_interval` for rates, :func:`.statistics.interval` for means.
    """
    everyone, converged = np.ones(len(runs.steps)), runs.converged
    claiming = ~np.isnan(runs.confident)
    fooled, judged = np.where(claiming, runs.fooled, 0), np.where(claiming, runs.known, 0)
    rates = {
        "converged": (converged, everyone),
        "within_20": (runs.early, everyone),
        "retention": (runs.stayed, runs.after),
        "re_loss": (runs.relost & converged, converged),
        "strict_success": (runs.strict, everyone),
        "false_confident": (fooled, judged),
    }
    means = {
        "e_pos_m": ("e_pos_ci95", runs.e_pos, converged),
        "e_theta_rad": ("e_theta_ci95", runs.e_theta, converged),
        "final_e_pos_m_all": ("final_e_pos_all_ci95", runs.e_pos, everyone > 0),
        "final_e_theta_rad_all": ("final_e_theta_all_ci95", runs.e_theta, everyone > 0),
    }
    found: dict[str, Any] = {"experiments": len(runs.steps), "drives": len(np.unique(runs.drive))}
    for name, (part, whole) in rates.items():
        found |= {name: ratio(part.sum(), whole.sum()), f"{name}_ci95": rate_interval(part, runs.drive, whole, seed)}
    for name, (bounds, errors, rows) in means.items():
        found |= {name: _mean(errors[rows]), bounds: interval(errors[rows], runs.drive[rows], seed=seed)}
    return found | {
        "steps_median": _median(runs.steps[converged]),
        "steps_hist": steps_histogram(runs.steps),
        "metres_median": _median(runs.metres[~np.isnan(runs.metres)]),
        "e_pos_m_median": _median(runs.e_pos[converged]),
        "e_theta_rad_median": _median(runs.e_theta[converged]),
        "confident": ratio(np.where(claiming, runs.confident, 0).sum(), judged.sum()),
    }


def steps_histogram(steps: np.ndarray) -> dict[str, int]:
    """Counts of converging steps in the paper's four intervals, and of runs that never converged."""
    counts = {name: int(((steps >= low) & (steps <= high)).sum()) for name, (low, high) in STEP_BINS.items()}
    return counts | {"never": int((steps < 0).sum())}


def _mean(values: np.ndarray) -> float:
    return float(values.mean()) if len(values) else math.nan


def _median(values: np.ndarray) -> float:
    return float(np.median(values)) if len(values) else math.nan
