"""One-shot quality of a proposal or a network: what its probability map says of one scan whose pose is known."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from dsom_jax import pose_grid as pg
from dsom_jax.compiling import run_options, training_options
from dsom_jax.geometry import wrap_angle
from dsom_jax.lidar import LidarConfig
from dsom_jax.nn import DSOM, encode_map
from dsom_jax.nn.dsom import masked_log_softmax, one_scan
from dsom_jax.occupancy import OccupancyGrid
from dsom_jax.training.batches import Batch
from dsom_jax.training.target import dense, make_target
from dsom_jax.types import Array, Inputs, Proposal, prepare_alone

MASS = 1.0, math.radians(15)
"""Metres and radians about the truth within which probability counts as being at the right place."""
TOP = 2.0, math.radians(10)
"""Within which the most probable cell counts as right."""
PEAK = 2.0, math.radians(30)
"""Two peaks are further apart than this."""
MAX_PEAKS = 8
PEAK_SHARE = 0.1
_FLOOR = 1e-30


class Quality(NamedTuple):
    """Of one scan; leaves get leading axes for more of them.

    Attributes:
        mass: probability within 1 m and 15 deg of the truth.
        top1: bool, the most probable pose is within 2 m and 10 deg.
        kld: Eq 5, KLD(GT || PM) in nats on PM's own cells; cells without probability count as 1e-30.
        peaks: number of places with at least a tenth of the probability of the best place, at most 8.
        level: probability of all that PM holds for more probable than the truth, and half of what it holds for as
            probable; uniform over scans if PM is calibrated.
    """

    mass: Array
    top1: Array
    kld: Array
    peaks: Array
    level: Array


def quality(pm: pg.ProbabilityMap, free: Array, pose: Array) -> Quality:
    """Quality of ``pm`` for the true map-frame pose (3,); ``free`` (H, W) is where PM may have probability."""
    share = pm.mass / pm.mass.sum()
    i, j, k = (jnp.round(v).astype(jnp.int32) for v in pg.pose_cell(pm.pose_grid, pose))
    at_truth = share[i, j, k % pm.pose_grid.headings]
    return Quality(
        pg.mass_near(pm, pose, *MASS),
        top_is_right(share, pm.pose_grid, pose),
        divergence(share, free, pm.pose_grid, pose),
        peaks(pm),
        jnp.where(share > at_truth, share, jnp.where(share == at_truth, 0.5 * share, 0.0)).sum(),
    )


def top_is_right(share: Array, grid: pg.PoseGrid, pose: Array) -> Array:
    """Whether the most probable cell of ``share`` (H, W, K) is within 2 m and 10 deg of ``pose`` (3,)."""
    best = _pose(grid, jnp.argmax(share))
    return (jnp.hypot(*(best - pose)[:2]) < TOP[0]) & (jnp.abs(wrap_angle(best[2] - pose[2])) < TOP[1])


def divergence(share: Array, free: Array, grid: pg.PoseGrid, pose: Array) -> Array:
    """Eq 5 for probabilities ``share`` (H, W, K)."""
    local = grid.frame().to_grid(pose)
    truth = dense(make_target(local, (grid.height, grid.width), grid.headings, grid.resolution), free)
    return (jax.scipy.special.xlogy(truth, truth) - truth * jnp.log(jnp.maximum(share, _FLOOR))).sum()


def peaks(pm: pg.ProbabilityMap) -> Array:
    """Number of places: the most probable cell, what is near it taken away, the next one, and so on."""

    def strongest(mass: Array, _: None) -> tuple[Array, Array]:
        pose = _pose(pm.pose_grid, jnp.argmax(mass))
        weight = pg.mass_near(pm._replace(mass=mass), pose, *MASS)
        return jnp.where(pg.near(pm.pose_grid, pose, *PEAK), 0.0, mass), weight

    _, weights = jax.lax.scan(strongest, pm.mass, length=MAX_PEAKS)
    return (weights >= PEAK_SHARE * weights.max()).sum()


def _pose(grid: pg.PoseGrid, flat: Array) -> Array:
    """Centre (3,) of the cell with flat index ``flat``."""
    return pg.cell_pose(grid, *jnp.unravel_index(flat, grid.shape))


def _even(grid: OccupancyGrid, headings: int = 32) -> pg.ProbabilityMap:
    """PM of knowing nothing: uniform over free space."""
    return pg.from_log(pg.over(grid, headings), jnp.zeros((*grid.shape, headings)), grid.free)


def prepare(proposal: Proposal, ranges: Array) -> Any:
    """PM of one scan (B,) at rest, compiled as for a filter."""
    return _compiled(_prepare)(proposal, ranges)


def of_scans(proposal: Proposal, grid: OccupancyGrid, ranges: Array, poses: Array) -> Quality:
    """Quality (S,) for scans (S, B) at map-frame poses (S, 3), one after the other; no PM counts as uniform."""
    return _compiled(_of_scans)(proposal, grid, ranges, poses)


@cache
def _compiled(function: Callable[..., Any]) -> Any:
    """Compiler options are asked for once there is a backend, not on import."""
    return jax.jit(function, compiler_options=run_options())


def _prepare(proposal: Proposal, ranges: Array) -> Any:
    return prepare_alone(proposal, Inputs(ranges, jnp.zeros(3), jnp.int32(0)))


def _of_scans(proposal: Proposal, grid: OccupancyGrid, ranges: Array, poses: Array) -> Quality:

    def one(scan: tuple[Array, Array]) -> Quality:
        pm = _prepare(proposal, scan[0])
        if pm is None:
            return quality(_even(grid), grid.free, scan[1])
        return quality(pm, getattr(proposal, "free", grid.free), scan[1])

    return jax.lax.map(one, (ranges, poses))


def totals(parts: Quality) -> dict[str, float | int]:
    """Numbers over all scans, as ``evaluate.json`` holds them."""
    return {**mass_totals(parts.mass, parts.top1), "kld": float(np.mean(parts.kld)),
            "peaks_mean": float(np.mean(parts.peaks))}  # fmt: skip


def mass_totals(mass: Any, top1: Any) -> dict[str, float | int]:
    """``mass_median``, ``mass_mean``, ``mass_gt_1pct``, ``mass_gt_10pct`` and ``top1`` over all scans."""
    mass = np.asarray(mass, np.float64)
    return {
        "scans": int(mass.size),
        "mass_median": float(np.median(mass)),
        "mass_mean": float(mass.mean()),
        "mass_gt_1pct": float((mass > 0.01).mean()),
        "mass_gt_10pct": float((mass > 0.1).mean()),
        "top1": float(np.asarray(top1).mean()),
    }


def calibration(level: np.ndarray, steps: int = 20) -> tuple[np.ndarray, np.ndarray]:
    """Credible levels p (steps + 1,) and the share of truths inside PM's smallest region of probability p."""
    p = np.linspace(0.0, 1.0, steps + 1)
    return p, (np.asarray(level)[:, None] <= p).mean(0)


def of_logits(log_pm: Array, resolution: float, pose: Array) -> tuple[Array, Array]:
    """``mass`` and ``top1`` of log PM (H, W, K) for the true pose (3,) in its grid's frame (metres from the corner)."""
    height, width, headings = log_pm.shape
    grid = pg.PoseGrid(jnp.zeros(3), height, width, headings, resolution)
    mass = jnp.where(pg.near(grid, pose, *MASS), jnp.exp(log_pm), 0.0).sum()
    return mass, top_is_right(log_pm, grid, pose)


def of_batch(model: DSOM, batch: Batch, lidar: LidarConfig) -> tuple[Array, Array]:
    """``mass`` and ``top1`` (N, S) of an evaluation view; maps and scans one after the other, to bound the memory."""

    def scored(features: Any, scan: Any) -> tuple[Array, Array]:
        ranges, conditions, pose = scan
        logits = one_scan(model, features, model.observation(ranges, lidar, conditions))
        return of_logits(masked_log_softmax(logits, features.free), model.config.resolution, pose)

    def one_map(part: Batch) -> tuple[Array, Array]:
        features = encode_map(model, part.occupied, part.free, part.views)
        return jax.lax.map(partial(scored, features), (part.ranges, part.conditions, part.poses))

    return jax.lax.map(one_map, batch)


def make_evaluation(batch: Batch, lidar: LidarConfig) -> Callable[[DSOM], dict[str, float | int]]:
    """Compiled judging of evaluation views on a fixed batch, as it is done during training."""
    score = jax.jit(of_batch, static_argnums=2, compiler_options=training_options())
    return lambda model: mass_totals(*score(model, batch, lidar))
