"""Drives to be judged: pieces of a log, kidnappings in them, and the same drives with another reference."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from dsom_jax.data import RawLog
from dsom_jax.data.cut import segment_indices, splice, to_episode, without_repeats
from dsom_jax.data.log import STILL
from dsom_jax.errors import UserError
from dsom_jax.judging import metrics
from dsom_jax.judging.foreign import replies_of
from dsom_jax.judging.scores import Drive


def cut(
    log: RawLog,
    segments: int,
    steps_per_segment: int | None = None,
    update_min_d: float = 0.25,
    update_min_a: float = 0.2,
    kidnap: bool = False,
) -> list[Drive]:
    """Pieces of the log, see :func:`dsom_jax.data.cut.segment_indices`; fewer of a log too short for so many.

    With ``kidnap`` each is followed by the one half the log further.
    """
    rows = segment_indices(log, segments, steps_per_segment, update_min_d, update_min_a)
    _check_length(log, rows.shape[1])
    pieces = [Drive(to_episode(log, row), log.stamps[row]) for row in without_repeats(rows)]
    if not kidnap:
        return pieces
    if len(pieces) < 2:
        raise UserError(f"{log.path}: --kidnap joins two segments; give a longer log or a smaller --steps-per-segment")
    others = pieces[len(pieces) // 2 :] + pieces[: len(pieces) // 2]
    return [_joined(first, then) for first, then in zip(pieces, others, strict=True)]


def _check_length(log: RawLog, updates: int) -> None:
    """UserError for segments of so few updates that nothing can converge in them."""
    if updates > metrics.HOLD:
        return
    if still := next((line for line in log.report.lines() if STILL in line), None):
        raise UserError(f"{log.path}: no updates to judge: {still}, or give a log of a drive")
    raise UserError(
        f"{log.path}: segments of {updates} updates are too short to judge, need {metrics.HOLD + 1}; "
        "give a longer log, fewer --segments or smaller --update-min-d and --update-min-a"
    )


def _joined(first: Drive, then: Drive) -> Drive:
    """The robot drives ``first`` and is carried, without noticing, to the start of ``then``."""
    return Drive(splice(first.episode, then.episode), np.concatenate([first.stamps, then.stamps]))


def marked(drive: Drive, carried: Sequence[float]) -> Drive:
    """The drive with the first update from each of the stamps ``carried`` on marked as after a kidnapping."""
    first = np.searchsorted(drive.stamps, np.asarray(carried, float) - 1e-6)
    flags = np.asarray(drive.episode.kidnapped).copy()
    flags[first[(first > 0) & (first < len(flags))]] = True
    return drive._replace(episode=drive.episode._replace(kidnapped=jnp.asarray(flags))) if len(carried) else drive


def carried_over(drives: list[Drive], reference: Path | None) -> list[Drive] | None:
    """The drives with another reference, if there is one."""
    if reference is None:
        return None
    poses = [given.poses[0] for given in replies_of(reference, drives)]
    return [d._replace(episode=d.episode._replace(poses=jnp.asarray(p, jnp.float32)))
            for d, p in zip(drives, poses, strict=True)]  # fmt: skip
