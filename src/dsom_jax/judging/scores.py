"""What a system answered over drives, held against a reference: our filters and foreign localizers alike."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from dsom_jax.belief.verdict import CERTAIN, Verdict
from dsom_jax.data import save_tum
from dsom_jax.episode import Episode
from dsom_jax.judging import metrics
from dsom_jax.judging.rooms import Rooms, in_right_room
from dsom_jax.judging.statistics import rate_interval
from dsom_jax.judging.trust import trust
from dsom_jax.montecarlo import Result
from dsom_jax.occupancy import OccupancyGrid, is_free


class Drive(NamedTuple):
    """One episode to localize, and the log's stamps (T,) of its updates."""

    episode: Episode
    stamps: np.ndarray


class Outcome(NamedTuple):
    """Result of one drive and the seconds that it took, NaN where they would include a compilation."""

    drive: Drive
    result: Result
    seconds: float


class Replies(NamedTuple):
    """What was answered over one drive, R times.

    Attributes:
        poses: (R, T, 3) in the map frame; NaN where there was no answer, which is as wrong as can be.
        p_lost: (R, T) probability that the pose is more than 2 m or 10 deg off, None from a system that says nothing.
        certain: (R, T) bool, whether it claims to know where it is; None likewise.
    """

    poses: np.ndarray
    p_lost: np.ndarray | None = None
    certain: np.ndarray | None = None


def replies(info: Any, estimate: str) -> Replies:
    """Those of a filter by its diagnostics (leaves (R, T, ...)); ``estimate`` is ``mean`` or ``cluster``."""
    p_lost = np.asarray(getattr(info, "p_lost", info.lost), np.float64)
    poses = np.asarray(getattr(info, estimate))
    if hasattr(info, "verdict"):
        return Replies(poses, p_lost, np.asarray(info.verdict) == Verdict.LOCALIZED)
    return Replies(poses) if np.isnan(p_lost).all() else Replies(poses, p_lost, p_lost < CERTAIN)


def answered(outcomes: Sequence[Outcome], method: str) -> list[Replies]:
    """Those of a filter over all drives, by the estimate that ``method`` is judged by."""
    return [replies(outcome.result.info, judged_by(method)) for outcome in outcomes]


def verdicts(infos: Sequence[Any]) -> dict[str, Any]:
    """``verdicts``: share of each over all runs and updates, and ``certain``, that of ``localized``."""
    words = np.concatenate([np.asarray(info.verdict).ravel() for info in infos])
    shares = {verdict.name.lower(): float((words == verdict).mean()) for verdict in Verdict}
    return {"verdicts": shares, "certain": shares["localized"]}


def judged_by(method: str) -> str:
    """The paper's filters answer with the weighted mean; ours (``robust_*``, ``adam_robust``) with the heaviest
    cluster."""
    return "cluster" if "robust" in method else "mean"


def judge_drive(given: Replies, episode: Episode, drive: int = 0) -> dict[str, list[metrics.Runs]]:
    """Metrics of each phase of one drive: ``global`` up to the first kidnapping, ``kidnap`` after every one."""
    truth, odometry = np.asarray(episode.poses), np.asarray(episode.odometry)
    certain = given.certain
    return {
        phase: [
            metrics.measure(given.poses[:, part], truth[part], None if certain is None else certain[:, part],
                            odometry[part], drive) for part in parts
        ]
        for phase, parts in metrics.phases(episode.kidnapped).items()
    }  # fmt: skip


def scores(
    drives: Sequence[Drive], given: Sequence[Replies], grid: OccupancyGrid, seed: int = 0, rooms: Rooms | None = None
) -> dict[str, Any]:
    """Metrics of the start, of all kidnappings (``kidnap``) if there are any, and of every drive on its own.

    ``right_room`` is the share of the updates in the right one of ``rooms``; ``p_lost`` says how good the probabilities
    of being lost are (:func:`.trust.trust`), where the system gives any.
    """
    if all(np.isnan(drive.episode.poses).all() for drive in drives):
        return {"reference": None}
    judged = [judge_drive(a, d.episode, number) for number, (d, a) in enumerate(zip(drives, given, strict=True))]
    pooled = {phase: metrics.pool([runs for j in judged for runs in j[phase]]) for phase in ("global", "kidnap")}
    found = metrics.summarize(pooled["global"], seed)
    if any(j["kidnap"] for j in judged):
        found["kidnap"] = metrics.summarize(pooled["kidnap"], seed)
    if rooms is not None:
        found |= room_share(drives, given, rooms, seed)
    if trusted := [judge_trust(d, a) for d, a in zip(drives, given, strict=True) if a.p_lost is not None]:
        p_lost, wrong = (np.concatenate(column) for column in zip(*trusted, strict=True))
        found["p_lost"] = trust(p_lost, wrong)
    return found | {"by_segment": [_describe(d, j["global"][0], grid) for d, j in zip(drives, judged, strict=True)]}


def judge_trust(drive: Drive, given: Replies) -> tuple[np.ndarray, np.ndarray]:
    """``p_lost`` and what was wrong (more than 2 m or 10 deg off) at all updates with a reference, flat."""
    e_pos, e_theta = (np.asarray(e) for e in metrics.pose_error(jnp.asarray(given.poses), drive.episode.poses))
    known = ~np.isnan(e_pos)
    wrong = ~((e_pos < metrics.POSITION) & (e_theta < metrics.ANGLE))
    return np.clip(np.asarray(given.p_lost)[known], 0.0, 1.0), wrong[known]


def room_share(drives: Sequence[Drive], given: Sequence[Replies], rooms: Rooms, seed: int) -> dict[str, Any]:
    """``right_room`` and its interval by drive; updates whose reference is in no room are passed over."""
    counted = [in_right_room(rooms, a.poses, d.episode.poses) for d, a in zip(drives, given, strict=True)]
    right, judged = (np.array([count[n] for count in counted], float) for n in (0, 1))
    number = np.arange(len(drives))
    return {"right_room": metrics.ratio(right.sum(), judged.sum()),
            "right_room_ci95": rate_interval(right, number, judged, seed)}  # fmt: skip


def _describe(drive: Drive, runs: metrics.Runs, grid: OccupancyGrid) -> dict[str, Any]:
    """One segment: where it starts in the log, how much of it lies on mapped free space, how often it succeeded."""
    poses = drive.episode.poses
    known = ~np.isnan(np.asarray(poses)).any(-1)
    return {
        "start_stamp": float(drive.stamps[0]),
        "on_map": float(np.asarray(is_free(grid, poses))[known].mean()) if known.any() else None,
        "converged": metrics.ratio(runs.converged.sum(), len(runs.steps)),
        "strict_success": metrics.ratio(runs.strict.sum(), len(runs.steps)),
        "e_pos_m_median": float(np.median(runs.e_pos)) if len(runs.e_pos) else math.nan,
    }


def reference_shift(drives: Sequence[Drive], given: Sequence[Replies]) -> dict[str, float] | None:
    """The one motion of the map frame that carries the reference onto the answers, if one does and is needed.

    x, y (m), theta (rad) and ``share``, of the sure answers those within 0.5 m and 10 deg of the reference so moved.
    None where answers and reference agree as they are (a tenth of them within 2 m), or no motion fits half of them.
    """
    truth, answer = _sure(drives, given)
    if len(truth) < 10 or np.mean(np.hypot(*(answer - truth)[:, :2].T) < 2.0) > 0.1:
        return None
    turns = np.exp(1j * (answer[:, 2] - truth[:, 2]))
    theta = float(np.angle(np.median(turns.real) + 1j * np.median(turns.imag)))
    theta = theta if abs(theta) > math.radians(2) else 0.0
    turned = (truth[:, 0] + 1j * truth[:, 1]) * np.exp(1j * theta)
    offset = answer[:, 0] + 1j * answer[:, 1] - turned
    x, y = float(np.median(offset.real)), float(np.median(offset.imag))
    fits = (np.abs(offset - (x + 1j * y)) < 0.5) & (np.abs(np.angle(turns * np.exp(-1j * theta))) < math.radians(10))
    return {"x": x, "y": y, "theta": theta, "share": float(fits.mean())} if fits.mean() > 0.5 else None


def _sure(drives: Sequence[Drive], given: Sequence[Replies]) -> tuple[np.ndarray, np.ndarray]:
    """Reference and answers (N, 3) at all updates of all runs with both, and where the system claims to know."""
    pairs = []
    for drive, said in zip(drives, given, strict=True):
        truth = np.broadcast_to(np.asarray(drive.episode.poses), said.poses.shape)
        sure = np.isfinite(truth).all(-1) & np.isfinite(said.poses).all(-1)
        sure &= True if said.certain is None else said.certain
        pairs.append((truth[sure], said.poses[sure]))
    return np.concatenate([p[0] for p in pairs]), np.concatenate([p[1] for p in pairs])


def save_estimate(path: Path, drives: Sequence[Drive], given: Sequence[Replies]) -> None:
    """What run 0 answered at every update, in log time; of overlapping segments the earlier one counts."""
    stamps, first = np.unique(np.concatenate([drive.stamps for drive in drives]), return_index=True)
    save_tum(path, stamps, np.concatenate([said.poses[0] for said in given])[first])
