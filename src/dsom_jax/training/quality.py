"""One-shot quality of a proposal: what its probability map says of one scan whose pose is known."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from dsom_jax import pose_grid as pg
from dsom_jax.compiling import run_options
from dsom_jax.geometry import wrap_angle
from dsom_jax.occupancy import OccupancyGrid
from dsom_jax.training import evaluation
from dsom_jax.training.evaluation import MASS, TOP
from dsom_jax.training.target import dense, make_target
from dsom_jax.types import Array, Inputs, Proposal

PEAK = 2.0, math.radians(30)
"""Two peaks are further apart than this."""
MAX_PEAKS = 8
PEAK_SHARE = 0.1
FLOOR = 1e-30


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
    best = _pose(pm.pose_grid, jnp.argmax(share))
    gap = jnp.hypot(*(best - pose)[:2]), jnp.abs(wrap_angle(best[2] - pose[2]))
    i, j, k = (jnp.round(v).astype(jnp.int32) for v in pg.pose_cell(pm.pose_grid, pose))
    at_truth = share[i, j, k % pm.pose_grid.headings]
    return Quality(
        pg.mass_near(pm, pose, *MASS),
        (gap[0] < TOP[0]) & (gap[1] < TOP[1]),
        divergence(share, free, pm.pose_grid, pose),
        peaks(pm),
        jnp.where(share > at_truth, share, jnp.where(share == at_truth, 0.5 * share, 0.0)).sum(),
    )


def divergence(share: Array, free: Array, grid: pg.PoseGrid, pose: Array) -> Array:
    """Eq 5 for probabilities ``share`` (H, W, K)."""
    local = grid.frame().to_grid(pose)
    truth = dense(make_target(local, (grid.height, grid.width), grid.headings, grid.resolution), free)
    return (jax.scipy.special.xlogy(truth, truth) - truth * jnp.log(jnp.maximum(share, FLOOR))).sum()


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


def even(grid: OccupancyGrid, headings: int = 32) -> pg.ProbabilityMap:
    """PM of knowing nothing: uniform over free space."""
    return pg.from_log(pg.over(grid, headings), jnp.zeros((*grid.shape, headings)), grid.free)


def prepare(proposal: Proposal, ranges: Array) -> Any:
    """PM of one scan (B,) at rest, compiled as for a filter."""
    return _compiled(_prepare)(proposal, ranges)


def judge(proposal: Proposal, grid: OccupancyGrid, ranges: Array, poses: Array) -> Quality:
    """Quality (S,) for scans (S, B) at map-frame poses (S, 3), one after the other; no PM counts as uniform."""
    return _compiled(_judge)(proposal, grid, ranges, poses)


@cache
def _compiled(function: Callable[..., Any]) -> Any:
    """Compiler options are asked for once there is a backend, not on import."""
    return jax.jit(function, compiler_options=run_options())


def _prepare(proposal: Proposal, ranges: Array) -> Any:
    return proposal.prepare(Inputs(ranges, jnp.zeros(3), jnp.int32(0)))


def _judge(proposal: Proposal, grid: OccupancyGrid, ranges: Array, poses: Array) -> Quality:

    def one(scan: tuple[Array, Array]) -> Quality:
        pm = _prepare(proposal, scan[0])
        if pm is None:
            return quality(even(grid), grid.free, scan[1])
        return quality(pm, getattr(proposal, "free", grid.free), scan[1])

    return jax.lax.map(one, (ranges, poses))


def summarise(parts: Quality) -> dict[str, float | int]:
    """Numbers over all scans, as ``evaluate.json`` holds them."""
    shares = evaluation.summarise(evaluation.Score(parts.mass, parts.top1))
    return {**shares, "kld": float(np.mean(parts.kld)), "peaks_mean": float(np.mean(parts.peaks))}


def calibration(level: np.ndarray, steps: int = 20) -> tuple[np.ndarray, np.ndarray]:
    """Credible levels p (steps + 1,) and the share of truths inside PM's smallest region of probability p."""
    p = np.linspace(0.0, 1.0, steps + 1)
    return p, (np.asarray(level)[:, None] <= p).mean(0)
