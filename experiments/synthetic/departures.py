"""How often a filter leaves a place that it had found, and what was the case at that update."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from dsom_jax.episode import Episode
from dsom_jax.judging import metrics
from dsom_jax.judging.scores import judged_by
from dsom_jax.montecarlo import Result

POOR = 0.1
"""PM points elsewhere if less than this share of it lies within 1 m and 15 deg of the truth."""


@dataclass(frozen=True)
class Scene:
    """What one sequence offers a filter at every update, (T,) each.

    Attributes:
        mass: probability that the filter's PM puts within 1 m and 15 deg of the truth.
        trust: T of Alg 1 that a particle at the true pose would get.
    """

    mass: np.ndarray
    trust: np.ndarray


@dataclass(frozen=True)
class Part:
    """The runs of a filter on one sequence."""

    method: str
    number: int
    episode: Episode
    result: Result
    scene: Scene


def departures(parts: list[Part], t_cut: float | None) -> dict[str, Any]:
    """How often a filter leaves a place that it had found, and what was the case at that update.

    A departure is an update outside the threshold (2 m, 10 deg) after one inside it, once converged. ``dragged``: the
    heaviest cluster was still inside, only the mean was not. ``pm_poor``: PM had less than a tenth of its probability
    at the truth. ``doubted``: even a particle at the true pose would not have been above T_cut at the update before, by
    which the set is divided. ``length``: updates until it is back, if it comes back in this phase.
    """
    events = [_departures(part, cut) for part in parts for cut in _phases(part.episode)]
    joined = {key: np.concatenate([event[key] for event in events]) for key in events[0]}
    count, kept = len(joined["length"]), float(joined["updates"].sum())
    returned = joined["length"][joined["length"] > 0]

    def share(flags: np.ndarray) -> float:
        return metrics.ratio(flags.sum(), len(flags))

    doubted = joined["trust"] < t_cut if t_cut is not None else np.zeros(0, bool)
    return {
        "updates_after_convergence": kept,
        "count": count,
        "per_100_updates": 100 * metrics.ratio(count, kept),
        "dragged": share(joined["dragged"]),
        "pm_poor": share(joined["mass"] < POOR),
        "pm_poor_otherwise": share(joined["all_mass"] < POOR),
        "doubted": share(doubted),
        "doubted_otherwise": share(joined["all_trust"] < t_cut) if t_cut is not None else float("nan"),
        "redrawn": float(joined["redrawn"].mean()) if count else float("nan"),
        "redrawn_otherwise": float(joined["all_redrawn"].mean()) if len(joined["all_redrawn"]) else float("nan"),
        "returned": share(joined["length"] > 0),
        "length_median": float(np.median(returned)) if len(returned) else float("nan"),
    }


def _phases(episode: Episode) -> list[slice]:
    return [cut for cuts in metrics.phases(episode.kidnapped).values() for cut in cuts]


def _departures(part: Part, cut: slice) -> dict[str, np.ndarray]:
    """The departures in one phase of one sequence, all runs, and the values of all updates inside after convergence."""
    info, truth = part.result.info, part.episode.poses[cut]
    inside, cluster = (_inside(estimate[:, cut], truth) for estimate in (getattr(info, judged_by(part.method)),
                                                                         info.cluster))  # fmt: skip
    end = metrics.first_streak(inside, np.ones_like(inside), metrics.HOLD)[1]
    after = (np.arange(inside.shape[1]) > end[:, None]) & (end >= 0)[:, None]
    before = np.concatenate([np.zeros((len(inside), 1), bool), inside[:, :-1]], axis=1)
    runs, times = np.nonzero(after & before & ~inside)
    mass, trust = part.scene.mass[cut], part.scene.trust[cut]
    trust = np.concatenate([trust[:1], trust[:-1]])
    kept, redrawn = after & inside, np.asarray(info.redrawn)[:, cut]
    return {
        "length": np.array([_length(inside[r], int(t)) for r, t in zip(runs, times, strict=True)], int),
        "dragged": cluster[runs, times],
        "mass": mass[times],
        "trust": trust[times],
        "redrawn": redrawn[runs, times],
        "updates": after.sum(1),
        "all_mass": np.broadcast_to(mass, kept.shape)[kept],
        "all_trust": np.broadcast_to(trust, kept.shape)[kept],
        "all_redrawn": redrawn[kept],
    }


def _inside(estimates: Any, truth: Any) -> np.ndarray:
    """(R, T) whether estimates are within the threshold of convergence."""
    e_pos, e_theta = metrics.pose_error(estimates, truth)
    return np.asarray((e_pos < metrics.POSITION) & (e_theta < metrics.ANGLE))


def _length(inside: np.ndarray, start: int) -> int:
    """Updates from ``start`` until the estimate is inside again, 0 if never."""
    back = np.flatnonzero(inside[start:])
    return int(back[0]) if len(back) else 0
