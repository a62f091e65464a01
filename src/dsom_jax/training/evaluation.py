"""One-shot quality of a probability map: how much of it lies where the robot is."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from dsom_jax.compiling import training_options
from dsom_jax.geometry import wrap_angle
from dsom_jax.lidar import LidarConfig
from dsom_jax.nn import DSOM, encode_map
from dsom_jax.nn.dsom import masked_log_softmax, one_scan
from dsom_jax.training.batches import Batch
from dsom_jax.types import Array

MASS = 1.0, math.radians(15)
"""Metres and radians about the truth within which probability counts as being at the right place."""
TOP = 2.0, math.radians(10)
"""Within which the most probable cell counts as right."""


class Score(NamedTuple):
    """Of one scan.

    Attributes:
        mass: () probability within 1 m and 15 deg of the truth.
        top1: () bool, the most probable cell is within 2 m and 10 deg.
    """

    mass: Array
    top1: Array


def score_map(log_pm: Array, pose: Array, resolution: float) -> Score:
    """Score of log PM (H, W, K) for the true pose (3,) in the grid's frame (metres from its corner, radians)."""
    h, w, k = log_pm.shape
    x = (jnp.arange(w) + 0.5) * resolution - pose[0]
    y = (jnp.arange(h) + 0.5) * resolution - pose[1]
    turn = jnp.abs(wrap_angle(-jnp.pi + jnp.arange(k) * (2 * jnp.pi / k) - pose[2]))
    distance = jnp.hypot(x[None, :], y[:, None])
    near = (distance <= MASS[0])[..., None] & (turn <= MASS[1])
    i, j, best = jnp.unravel_index(jnp.argmax(log_pm), log_pm.shape)
    top1 = (distance[i, j] < TOP[0]) & (turn[best] < TOP[1])
    return Score(jnp.where(near, jnp.exp(log_pm), 0.0).sum(), top1)


def score_batch(model: DSOM, batch: Batch, lidar: LidarConfig) -> Score:
    """Scores (N, S) of an evaluation view on a batch; maps and scans one after the other, to bound the memory."""

    def scored(features, scan) -> Score:
        ranges, conditions, pose = scan
        logits = one_scan(model, features, model.observation(ranges, lidar, conditions))
        return score_map(masked_log_softmax(logits, features.free), pose, model.config.resolution)

    def one_map(part: Batch) -> Score:
        features = encode_map(model, part.occupied, part.free, part.views)
        return jax.lax.map(partial(scored, features), (part.ranges, part.conditions, part.poses))

    return jax.lax.map(one_map, batch)


def summarise(score: Score) -> dict[str, float]:
    """``mass_median``, ``mass_mean``, ``mass_gt_1pct``, ``mass_gt_10pct`` and ``top1`` over all scans."""
    mass = np.asarray(score.mass, np.float64)
    return {
        "scans": int(mass.size),
        "mass_median": float(np.median(mass)),
        "mass_mean": float(mass.mean()),
        "mass_gt_1pct": float((mass > 0.01).mean()),
        "mass_gt_10pct": float((mass > 0.1).mean()),
        "top1": float(np.asarray(score.top1).mean()),
    }


def make_evaluation(batch: Batch, lidar: LidarConfig) -> Callable[[DSOM], dict[str, float]]:
    """Compiled scoring of evaluation views on a fixed batch."""
    score = jax.jit(score_batch, static_argnums=2, compiler_options=training_options())
    return lambda model: summarise(score(model, batch, lidar))
