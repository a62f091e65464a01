"""From what a filter keeps of its run 0 to answers that can be written down: pose, spread, places, verdict."""

from __future__ import annotations

import csv
import io
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from dsom_jax.atomic import write_atomic
from dsom_jax.filters.common import CLUSTER_ANGLE, CLUSTER_RADIUS
from dsom_jax.judging.metrics import CONFIDENT
from dsom_jax.view.story import VERDICTS, Hypotheses

PLACES, HELD, SMALLEST = 6, 0.99, 0.005
"""At most so many places, that hold so much of the mass; a place with less than this is none."""
_CANDIDATES = 32
HEAD = ("stamp", "x", "y", "theta", "sd_x", "sd_y", "sd_theta", "p_lost", "verdict", "hypotheses")


class Answers(NamedTuple):
    """What run 0 said over T updates.

    Attributes:
        stamps: (T,) seconds.
        poses: (T, 3) in the map frame.
        spread: (T, 3) standard deviations of x, y (m) and theta (rad) of the particles around the answer.
        p_lost: (T,) probability that the answer is wrong.
        verdicts: T names.
        hypotheses: places that hold the mass.
        particles, weights: (T, N, 3) and (T, N).
    """

    stamps: np.ndarray
    poses: np.ndarray
    spread: np.ndarray
    p_lost: np.ndarray
    verdicts: tuple[str, ...]
    hypotheses: Hypotheses
    particles: np.ndarray
    weights: np.ndarray


def answers(stamps: np.ndarray, poses: np.ndarray, info: Any, kept: Any) -> Answers:
    """Answers of run 0: poses (R, T, 3), ``info`` with leaves (R, T, ...), ``kept`` states with leaves (T, ...).

    Filters that give no ``p_lost`` say ``lost``; for those that give no places or verdict the particles are asked.
    """
    said = np.asarray(poses, float)[0]
    particles, weights = np.asarray(kept.poses, float), particle_weights(kept)
    p_lost = np.asarray(getattr(info, "p_lost", info.lost), float)[0]
    found = getattr(info, "hypotheses", None)
    places = from_particles(particles, weights) if found is None else Hypotheses(*(np.asarray(p)[0] for p in found))
    given = getattr(info, "verdict", None)
    verdicts = judged(p_lost, places) if given is None else tuple(VERDICTS[int(v)] for v in np.asarray(given)[0])
    return Answers(stamps, said, spread(said, particles, weights), p_lost, verdicts, places, particles, weights)


def particle_weights(kept: Any) -> np.ndarray:
    """(T, N) weights that sum to one, of states that hold them or their logarithms."""
    if hasattr(kept, "log_weights"):
        return np.exp(np.asarray(kept.log_weights, float))
    return np.asarray(kept.normalised, float)


def judged(p_lost: np.ndarray, places: Hypotheses) -> tuple[str, ...]:
    """Verdicts by thresholds: sure; or at least two places that hold most of the mass; or lost."""
    ranked = np.sort(places.weights, axis=1)[:, ::-1]
    several = (ranked[:, 1:2].sum(1) > CONFIDENT) & (ranked[:, :3].sum(1) >= 0.5)
    names = np.where(p_lost < CONFIDENT, "localized", np.where(several, "ambiguous", "lost"))
    return tuple(str(name) for name in names)


def spread(poses: np.ndarray, particles: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """(T, 3) standard deviations around ``poses`` (T, 3) of the particles in their cluster, of all if it has none."""
    gap = _gap(particles, poses[:, None])
    near = weights * _close(gap)
    used = np.where(near.sum(1, keepdims=True) > 0, near, weights)
    return np.sqrt((used[..., None] * gap**2).sum(1) / np.maximum(used.sum(1), 1e-30)[:, None])


def from_particles(particles: np.ndarray, weights: np.ndarray) -> Hypotheses:
    """Places of weighted particles (T, N, 3): the heaviest cluster, the heaviest of what is left, and so on."""
    count = len(particles)
    mass, means, covariances = np.zeros((count, PLACES)), np.zeros((count, PLACES, 3)), np.zeros((count, PLACES, 3, 3))
    for t, (poses, left) in enumerate(zip(particles, weights.copy(), strict=True)):
        for h in range(PLACES):
            if mass[t].sum() >= HELD or left.sum() < SMALLEST:
                break
            members = _heaviest(poses, left)
            if members.sum() < SMALLEST:
                break
            mass[t, h] = members.sum()
            means[t, h], covariances[t, h] = _moments(poses, members)
            left = left - members
    return Hypotheses(mass, means, covariances)


def _heaviest(poses: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """(N,) the weights of the heaviest cluster, zero outside of it."""
    places = (np.arange(_CANDIDATES) + 0.5) / _CANDIDATES * weights.sum()
    rows = np.unique(np.minimum(np.searchsorted(np.cumsum(weights), places), len(poses) - 1))
    near = _close(_gap(poses, poses[rows, None])) * weights
    members = near[np.argmax(near.sum(1))]
    for _ in range(2):
        centre, _ = _moments(poses, members)
        members = _close(_gap(poses, centre)) * weights
    return members


def _moments(poses: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean pose (3,) and covariance (3, 3)."""
    share = weights / max(weights.sum(), 1e-30)
    turn = np.arctan2(share @ np.sin(poses[:, 2]), share @ np.cos(poses[:, 2]))
    mean = np.r_[share @ poses[:, :2], turn]
    gap = _gap(poses, mean)
    return mean, (share[:, None] * gap).T @ gap


def _gap(poses: np.ndarray, centre: np.ndarray) -> np.ndarray:
    """Differences (..., 3), that of the heading wrapped."""
    gap = poses - centre
    gap[..., 2] = (gap[..., 2] + np.pi) % (2 * np.pi) - np.pi
    return gap


def _close(gap: np.ndarray) -> np.ndarray:
    """Which differences (..., 3) are those of one cluster."""
    return ((gap[..., :2] ** 2).sum(-1) <= CLUSTER_RADIUS**2) & (np.abs(gap[..., 2]) <= CLUSTER_ANGLE)


def write_answers(path: Path, drives: list[Answers]) -> None:
    """``answers.csv``: a row for each update, in log time; of overlapping drives the earlier one counts."""
    rows: dict[float, list[str]] = {}
    for said in drives:
        counts = (said.hypotheses.weights > 0).sum(1)
        for t, stamp in enumerate(said.stamps):
            numbers = [*said.poses[t], *said.spread[t], said.p_lost[t]]
            row = [f"{stamp:.6f}", *(f"{v:.6g}" for v in numbers), said.verdicts[t], str(int(counts[t]))]
            rows.setdefault(float(stamp), row)
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(HEAD)
    writer.writerows(rows[stamp] for stamp in sorted(rows))
    write_atomic(path, text.getvalue().encode())
