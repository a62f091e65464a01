"""What a method did on every drive by itself, and its worst run there, to be looked at."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from dsom_jax.episode import Episode
from dsom_jax.judging.metrics import ANGLE, POSITION, Runs, pool, pose_error, ratio
from dsom_jax.judging.scores import Replies, judge_drive


class Worst(NamedTuple):
    """The worst of the runs of one method over a drive of T updates.

    Attributes:
        run: its number, from 0.
        right: share of the updates with a reference at which it was within 2 m and 10 deg, NaN without any.
        e_pos_m: metres off at the last of them.
        poses: (T, 3) what it answered.
        wrong: (T,) bool, outside of 2 m and 10 deg; False without reference.
    """

    run: int
    right: float
    e_pos_m: float
    poses: np.ndarray
    wrong: np.ndarray


class Judged(NamedTuple):
    """One method over all drives: its ``runs`` of each phase, which know their drive, and the ``worst`` of each."""

    runs: dict[str, Runs]
    worst: list[Worst]


def worst_run(poses: Any, e_pos: Any, e_theta: Any) -> Worst:
    """The run that was right least, of several the one that ends farthest off; poses (R, T, 3), errors (R, T).

    Only this run is copied: the others need not stay in memory.
    """
    e_pos, e_theta = np.asarray(e_pos, float), np.asarray(e_theta, float)
    known = ~np.isnan(e_pos)
    wrong = known & ~((e_pos < POSITION) & (e_theta < ANGLE))
    off = np.array([row[there][-1] if there.any() else np.nan for row, there in zip(e_pos, known, strict=True)])
    # All runs have the same updates with a reference: the least right is the most often wrong.
    run = int(np.lexsort((-np.nan_to_num(off, nan=-1.0), -wrong.sum(1)))[0])
    right = ratio((known & ~wrong)[run].sum(), known[run].sum())
    return Worst(run, right, float(off[run]), np.array(poses[run]), wrong[run])


def judge_drives(episodes: Sequence[Episode], given: Sequence[Replies]) -> Judged:
    """Another localizer, by what it answered over each drive."""
    judged = [judge_drive(said, episode, n) for n, (episode, said) in enumerate(zip(episodes, given, strict=True))]
    runs = {phase: pool([part for j in judged for part in j[phase]]) for phase in ("global", "kidnap")}
    pairs = zip(episodes, given, strict=True)
    return Judged(
        runs, [worst_run(said.poses, *pose_error(jnp.asarray(said.poses), episode.poses)) for episode, said in pairs]
    )


def by_drive(judged: Judged) -> list[dict[str, Any]]:
    """``by_drive`` of ``bench.json``: for each drive and phase the share of runs that converged and their mean final
    error in metres, and the worst run."""
    return [
        {phase: _phase(runs, number) for phase, runs in judged.runs.items()}
        | {"worst": {"run": worst.run, "right": worst.right, "e_pos_m": worst.e_pos_m}}
        for number, worst in enumerate(judged.worst)
    ]


def _phase(runs: Runs, number: int) -> dict[str, Any]:
    here = runs.drive == number
    converged = here & runs.converged
    count = int(converged.sum())
    return {"experiments": int(here.sum()), "converged": ratio(count, here.sum()),
            "e_pos_m": ratio(runs.e_pos[converged].sum(), count)}  # fmt: skip
