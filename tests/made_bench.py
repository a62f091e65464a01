"""A benchmark made up without any filter: the drives of the frozen suite, and answers that are off by known amounts."""

from __future__ import annotations

import numpy as np

from dsom_jax import bench, report
from dsom_jax.data.suite import load_suite
from dsom_jax.judging.by_drive import by_drive, judge_drives
from dsom_jax.judging.scores import Replies
from dsom_jax.protocol.digests import digests

RUNS = 7
METHODS = (*bench.STANDARD[:9], "<amcl> & 'others'")


def answers(truth: np.ndarray, moved: int, late: float, rng: np.random.Generator) -> np.ndarray:
    """(R, T, 3): somewhere for about ``late`` updates from the start and the kidnapping, then near the truth (T, 3)."""
    t = np.arange(len(truth))
    since = np.where(t < moved, t, t - moved)
    found = since >= rng.poisson(late, (RUNS, 1))
    anywhere = np.c_[rng.uniform(2, 40, (len(t), 2)), rng.uniform(-3, 3, len(t))]
    return np.where(found[..., None], truth + 0.05 * rng.normal(size=(RUNS, len(t), 3)), anywhere)


def made() -> tuple:
    """The suite, replies by method and drive, ``bench.json`` and the worst runs."""
    rng, suite = np.random.default_rng(0), load_suite("synthetic-v1")
    episodes = [episode for _, _, episode in suite.episodes]

    def of(late):
        moved = [int(np.flatnonzero(np.asarray(e.kidnapped))[-1]) for e in episodes]
        return [Replies(answers(np.asarray(e.poses), m, late, rng)) for e, m in zip(episodes, moved, strict=True)]

    # The last is never there in time: what no run did has no number.
    given = {name: of(late) for name, late in zip(METHODS, [0, 2, 5, 10, 20, 40, 50, 60, 80, 999], strict=True)}
    judged = {name: judge_drives(episodes, replies) for name, replies in given.items()}
    methods = {name: bench.foreign(j, 0) | {"by_drive": by_drive(j)} for name, j in judged.items()}
    data = {"suite": suite.name, "runs": RUNS, "particles": 200, "seed": 3, "sequences": len(episodes),
            "digests": digests(suite, {}), "methods": methods}  # fmt: skip
    return suite, given, report.plain(data), {name: j.worst for name, j in judged.items()}
