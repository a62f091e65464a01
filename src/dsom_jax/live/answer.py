"""What one robot is told: a pose, how far it can be trusted, and where else it may be."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from dsom_jax.belief.verdict import CERTAIN, Verdict
from dsom_jax.data import se2
from dsom_jax.data.files import read_bytes
from dsom_jax.errors import UserError


class Hypothesis(NamedTuple):
    """A place where the robot may be: share of the probability, mean pose (3,) and covariance (3, 3), map frame."""

    weight: float
    pose: np.ndarray
    covariance: np.ndarray


class Answer(NamedTuple):
    """Where the robot is.

    Attributes:
        stamp: seconds, that of the scan asked about.
        pose: (3,) of the base in the map frame (m, m, rad); NaN before the first update.
        covariance: (3, 3) of the particles about ``pose``, other places included; infinite before the first update.
        verdict: ``localized`` if the pose may be trusted.
        p_lost: probability that it is more than 2 m or 10 deg off.
        hypotheses: the places that hold the mass, heaviest first.
        updated: whether this scan was used; if not, the last answer is carried on by the odometry.
        note: why a scan was not used, or what was odd about it; empty as a rule.
        seconds: that the call took.
    """

    stamp: float
    pose: np.ndarray
    covariance: np.ndarray
    verdict: str
    p_lost: float
    hypotheses: tuple[Hypothesis, ...]
    updated: bool = False
    note: str = ""
    seconds: float = 0.0

    @property
    def localized(self) -> bool:
        """Whether the pose may be trusted."""
        return self.verdict == "localized"


NOWHERE = Answer(math.nan, np.full(3, np.nan), np.diag([np.inf] * 3), "lost", 1.0, ())
"""Before the first update."""


def said(info: Any, pose: np.ndarray, covariance: np.ndarray) -> tuple[float, str, tuple[Hypothesis, ...]]:
    """P(lost), verdict and hypotheses; filters that give none are lost by ``lost``, and their cluster is the place."""
    p_lost = float(getattr(info, "p_lost", info.lost))
    given = getattr(info, "verdict", None)
    plain = Verdict.LOCALIZED if p_lost < CERTAIN else Verdict.LOST
    verdict = (plain if given is None else Verdict(int(given))).name.lower()
    places = getattr(info, "hypotheses", None)
    if places is None:
        return p_lost, verdict, (Hypothesis(1.0 - p_lost, pose, covariance),)
    rows = sorted(zip(*places, strict=True), key=lambda row: -float(row[0]))
    return (
        p_lost,
        verdict,
        tuple(Hypothesis(float(w), np.asarray(m, float), np.asarray(c, float)) for w, m, c in rows if w > 0),
    )


def moved(pose: np.ndarray, covariance: np.ndarray, driven: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pose (3,) and covariance (3, 3) after a body-frame motion (3,) that is known exactly."""
    if not np.isfinite(pose).all() or not driven.any():
        return pose, covariance
    after = se2.compose(pose, driven)
    lever = np.eye(3)
    lever[:2, 2] = pose[1] - after[1], after[0] - pose[0]
    return after, lever @ covariance @ lever.T


def read_saved(path: str | Path, of_map: list[Any]) -> tuple[np.ndarray, np.ndarray, bool]:
    """Pose, covariance and whether they were trusted, of a file that :meth:`Localizer.save` wrote."""
    try:
        saved = json.loads(read_bytes(path, "saved pose"))
        pose, covariance = np.array(saved["pose"], float), np.array(saved["covariance"], float)
        trusted, same = saved["verdict"] == "localized", saved["map"] == of_map
        sound = pose.shape == (3,) and covariance.shape == (3, 3)
    except (ValueError, KeyError, TypeError):
        sound = False
    if not sound or (trusted and not (np.isfinite(pose).all() and np.isfinite(covariance).all())):
        raise UserError(f"{path}: not a pose that Localizer.save wrote; delete it, a new one will be written")
    if not same:
        raise UserError(f"{path}: was saved on another map; delete it, a new one will be written")
    return pose, covariance, trusted
