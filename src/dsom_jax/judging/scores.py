"""What the runs over the drives of a log came to, held against a reference."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from dsom_jax.data import save_tum
from dsom_jax.episode import Episode
from dsom_jax.judging import metrics
from dsom_jax.montecarlo import Result
from dsom_jax.occupancy import OccupancyGrid, is_free


class Drive(NamedTuple):
    """One episode to localize, and the log's stamps (T,) of its updates."""

    episode: Episode
    stamps: np.ndarray


class Outcome(NamedTuple):
    """Result of one drive and the seconds that it took; those of the first of several include the compilation."""

    drive: Drive
    result: Result
    seconds: float


def scores(outcomes: list[Outcome], grid: OccupancyGrid, method: str, seed: int) -> dict[str, Any]:
    """Metrics of the start, of the kidnapping (``kidnap``) if there is one, and of every segment on its own."""
    if all(np.isnan(o.drive.episode.poses).all() for o in outcomes):
        return {"reference": None}
    judged = [judge(outcome, method) for outcome in outcomes]
    found = score(judged, "global", seed)
    if "kidnap" in judged[0]:
        found["kidnap"] = score(judged, "kidnap", seed)
    return found | {"by_segment": [describe(o, j, grid) for o, j in zip(outcomes, judged, strict=True)]}


def estimates(outcome: Outcome, method: str) -> np.ndarray:
    """(R, T, 3) answers of a filter: the heaviest cluster, or for the paper's filters the weighted mean."""
    info = outcome.result.info
    return np.asarray(info.cluster if method == "adam_robust" else info.mean)


def judge(outcome: Outcome, method: str) -> dict[str, tuple[metrics.Runs, np.ndarray]]:
    """Metrics and metres driven until convergence (R,) of each phase."""
    episode, poses = outcome.drive.episode, estimates(outcome, method)
    truth, lost = np.asarray(episode.poses), np.asarray(outcome.result.info.lost)
    judged = {}
    for phase, parts in metrics.phases(episode.kidnapped).items():
        for part in parts[:1]:
            runs = metrics.measure(poses[:, part], truth[part], lost[:, part])
            judged[phase] = runs, metrics.metres_travelled(runs.steps, np.asarray(episode.odometry)[part])
    return judged


def score(judged: list[dict[str, tuple[metrics.Runs, np.ndarray]]], phase: str, seed: int) -> dict[str, Any]:
    """All runs of one phase together."""
    metres = np.concatenate([j[phase][1] for j in judged])
    known = metres[~np.isnan(metres)]
    median = float(np.median(known)) if len(known) else math.nan
    return metrics.summarize(metrics.pool([j[phase][0] for j in judged]), seed) | {"metres_median": median}


def describe(outcome: Outcome, judged: dict[str, Any], grid: OccupancyGrid) -> dict[str, Any]:
    """One segment: where it starts in the log, how much of it lies on mapped free space, how often it succeeded."""
    runs = judged["global"][0]
    poses = outcome.drive.episode.poses
    known = ~np.isnan(np.asarray(poses)).any(-1)
    return {
        "start_stamp": float(outcome.drive.stamps[0]),
        "on_map": float(np.asarray(is_free(grid, poses))[known].mean()) if known.any() else None,
        "converged": metrics.ratio((runs.steps >= 0).sum(), len(runs.steps)),
        "strict_success": metrics.ratio(metrics.strict_success(runs).sum(), len(runs.steps)),
        "e_pos_m_median": float(np.median(runs.e_pos)) if len(runs.e_pos) else math.nan,
    }


def save_estimate(path: Path, outcomes: list[Outcome]) -> None:
    """Heaviest cluster of run 0 at every update, in log time; of overlapping segments the earlier one counts."""
    stamps = np.concatenate([o.drive.stamps for o in outcomes])
    poses = np.concatenate([np.asarray(o.result.info.cluster)[0] for o in outcomes])
    stamps, first = np.unique(stamps, return_index=True)
    save_tum(path, stamps, poses[first])
