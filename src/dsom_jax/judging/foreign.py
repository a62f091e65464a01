"""Trajectories of other localizers (AMCL, beluga, anything that can write TUM), as replies to be judged like ours."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from dsom_jax.data.suite import Suite
from dsom_jax.data.trajectory import associate, load_tum
from dsom_jax.episode import Episode
from dsom_jax.errors import UserError
from dsom_jax.judging.scores import Drive, Replies

TOLERANCE = 0.05
"""Seconds between an update and the nearest pose that is taken for its answer."""
GAP = 0.5
"""Seconds between poses that are interpolated where none is near enough."""

START = 1000.0
"""Stamp of the first scan of every drive of an exported suite, seconds: ROS takes 0 for no time at all."""


def stamps_of(episode: Episode) -> np.ndarray:
    """(T,) float64 stamps of the scans of an exported drive; microseconds are kept."""
    return START + np.round(np.asarray(episode.stamps, np.float64), 6)


def drives_of(suite: Suite) -> list[Drive]:
    """The drives of a suite with the stamps that their bags have (``python -m dsom_jax.export``)."""
    return [Drive(episode, stamps_of(episode)) for _, _, episode in suite.episodes]


def named(words: Sequence[str], what: str) -> dict[str, Path]:
    """``NAME=PATH`` arguments of ``--external``; UserError for others, for repeated names and missing files."""
    found: dict[str, Path] = {}
    for word in words:
        name, sign, path = word.partition("=")
        if not (name and sign and path) or name in found:
            raise UserError(f"--external {word}: give NAME={what}, every name once")
        found[name] = Path(path)
        if not found[name].exists():
            raise UserError(f"--external {word}: {path} does not exist; give NAME={what}")
    return found


def replies_of(path: Path, drives: Sequence[Drive]) -> list[Replies]:
    """The poses of a TUM file at the updates of drives; NaN where it has none, which is judged as wrong."""
    trajectory = load_tum(path)
    poses = [associate(trajectory, drive.stamps, TOLERANCE, GAP) for drive in drives]
    if all(np.isnan(part).any(-1).all() for part in poses):
        first, last = min(d.stamps.min() for d in drives), max(d.stamps.max() for d in drives)
        raise UserError(
            f"{path}: no pose within {TOLERANCE} s of any update: it covers {trajectory.stamps[0]:.3f} to "
            f"{trajectory.stamps[-1]:.3f} s, the drives {first:.3f} to {last:.3f} s; both must use the same clock"
        )
    return [Replies(part[None]) for part in poses]


def replies_of_suite(folder: Path, drives: Sequence[Drive]) -> list[Replies]:
    """Of each drive n from 1 on, ``sequence-n.tum``, or all TUM files of the folder ``sequence-n`` as its runs."""
    found = []
    for number, drive in enumerate(drives, start=1):
        one, several = folder / f"sequence-{number}.tum", folder / f"sequence-{number}"
        paths = [one] if one.is_file() else sorted(several.glob("*.tum"))
        if not paths:
            raise UserError(
                f"{folder}: has neither {one.name} nor TUM files in {several.name}/; give one of each drive"
            )
        found.append(Replies(np.concatenate([replies_of(path, [drive])[0].poses for path in paths])))
    return found
