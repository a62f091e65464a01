"""From what a filter keeps of its run 0 to answers that can be written down: pose, spread, places, verdict."""

from __future__ import annotations

import csv
import io
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from dsom_jax.atomic import write_atomic
from dsom_jax.filters.common import CLUSTER_ANGLE, CLUSTER_RADIUS
from dsom_jax.view.story import VERDICTS, DriveHypotheses

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
    hypotheses: DriveHypotheses
    particles: np.ndarray
    weights: np.ndarray


def answers(stamps: np.ndarray, poses: np.ndarray, info: Any, kept: Any) -> Answers:
    """Answers of run 0: poses (R, T, 3), ``info`` of a watched filter with leaves (R, T, ...), ``kept`` states with
    leaves (T, ...)."""
    said = np.asarray(poses, float)[0]
    particles, weights = np.asarray(kept.poses, float), particle_weights(kept)
    p_lost = np.asarray(info.p_lost, float)[0]
    verdicts = tuple(VERDICTS[int(number)] for number in np.asarray(info.verdict)[0])
    places = DriveHypotheses(*(np.asarray(part)[0] for part in info.hypotheses))
    return Answers(stamps, said, spreads(said, particles, weights), p_lost, verdicts, places, particles, weights)


def particle_weights(kept: Any) -> np.ndarray:
    """(T, N) weights that sum to one, of states that hold them or their logarithms."""
    if hasattr(kept, "log_weights"):
        return np.exp(np.asarray(kept.log_weights, float))
    return np.asarray(kept.normalised, float)


def spreads(poses: np.ndarray, particles: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """(T, 3) standard deviations around ``poses`` (T, 3) of the particles in their cluster, of all if it has none."""
    return np.sqrt(np.diagonal(covariances(poses, particles, weights), axis1=1, axis2=2))


def covariances(poses: np.ndarray, particles: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """(T, 3, 3) of (x, y, theta) around ``poses``, of the same particles: m^2, m rad, rad^2."""
    gap = _gap(particles, poses[:, None])
    near = weights * _close(gap)
    used = np.where(near.sum(1, keepdims=True) > 0, near, weights)
    used = used / np.maximum(used.sum(1, keepdims=True), 1e-30)
    return np.asarray(np.einsum("tp,tpi,tpj->tij", used, gap, gap))


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
