"""Observation models p(z | x): the paper's Score (Eq 15), the beam model, and the likelihood field.

A filter takes any :class:`SensorModel`. Ranges follow REP-117 throughout: +inf is a beam without return and is
evidence, NaN and -inf are invalid and are not.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from dsom_jax import checks
from dsom_jax.geometry import transform_points
from dsom_jax.lidar import LidarConfig, scan_points
from dsom_jax.occupancy import OccupancyGrid, euclidean_distance
from dsom_jax.raycast import MapTables, cast_rays
from dsom_jax.types import Array


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class RayTables:
    """A map, and the beams of a lidar that a filter uses.

    Attributes:
        map: what ray casting precomputed of the map; ``map.grid`` is the map itself.
        lidar: geometry of the beams that are used (static).
    """

    map: MapTables
    lidar: LidarConfig = field(metadata={"static": True})

    def expected(self, poses: Array) -> Array:
        """Ranges (..., B) in metres that base poses (..., 3) lead one to expect; +inf for no return."""
        return cast_rays(self.map, poses, self.lidar)


class SensorModel(ABC):
    """What a scan says of a pose. A subclass is a frozen dataclass with :meth:`log_likelihood`; the rest is given."""

    def tables(self, rays: RayTables) -> Any:
        """What :meth:`log_likelihood` needs of map and lidar, a pytree made once per map; here the map for rays."""
        return rays

    @abstractmethod
    def log_likelihood(self, tables: Any, poses: Array, ranges: Array) -> Array:
        """log p(z | x) (...) of one scan (B,) at base poses (..., 3), up to a constant of the scan."""

    def weigh(self, tables: Any, poses: Array, ranges: Array) -> Array:
        """Weights (N,) for Alg 1 and MCL, in units of the best possible one; here, of the best among ``poses``."""
        evidence = self.log_likelihood(tables, poses, ranges)
        best = evidence.max()
        return jnp.where(jnp.isfinite(best), jnp.exp(evidence - jnp.where(jnp.isfinite(best), best, 0.0)), 0.0)


@dataclass(frozen=True)
class ScoreModel(SensorModel):
    """Eq 15 of the paper.

    Attributes:
        sigma: standard deviation of a range, metres (the authors: 5 cells of 1/3 m).
        alpha, beta: weights of the Gaussian and of the constant 1 / range_max.
        range_max: L_max, metres.
        power: exponent of each beam's term; 3 in the paper, 1 in the authors' code.
        temper: factor on log Score where it stands for a log-likelihood, in AdaM robust.
    """

    sigma: float = 5 / 3
    alpha: float = 0.9
    beta: float = 0.1
    range_max: float = 10.0
    power: int = 3
    temper: float = 1.0

    def __post_init__(self) -> None:
        checks.positive(self, "sigma range_max temper")
        checks.not_negative(self, "alpha beta")
        checks.count(self, "power")

    def log_likelihood(self, tables: RayTables, poses: Array, ranges: Array) -> Array:
        """Tempered log(w / w*)."""
        return self.temper * jnp.log(self.weigh(tables, poses, ranges))

    def weigh(self, tables: RayTables, poses: Array, ranges: Array) -> Array:
        """w / w* by Eq 15, the trust T of Alg 1; one if no beam of the scan is valid."""
        best = perfect_score(ranges, self)
        score = beam_score(ranges, tables.expected(poses), self)
        return jnp.where(best > 0, score / jnp.where(best > 0, best, 1.0), 1.0)


def valid_beams(ranges: Array) -> Array:
    """Which beams are evidence: finite or +inf."""
    return ranges > -jnp.inf


def range_difference(ranges: Array, expected: Array) -> Array:
    """Observed minus expected; 0 where neither returns, +-inf where exactly one does."""
    neither = jnp.isposinf(ranges) & jnp.isposinf(expected)
    return jnp.where(neither, 0.0, ranges - jnp.where(neither, 0.0, expected))


def beam_score(ranges: Array, expected: Array, model: ScoreModel) -> Array:
    """Score(L_o, L_p) of Eq 15 for scans (..., B) in metres: (...)."""
    difference = range_difference(ranges, expected)
    gaussian = jnp.exp(-0.5 * (difference / model.sigma) ** 2) / (model.sigma * math.sqrt(2 * math.pi))
    terms = (model.alpha * gaussian + model.beta / model.range_max) ** model.power
    return jnp.where(valid_beams(ranges), terms, 0.0).sum(-1)


def perfect_score(ranges: Array, model: ScoreModel) -> Array:
    """w* = Score(L, L), the score of a scan (..., B) without any difference (appendix A of the paper)."""
    best = model.alpha / (model.sigma * math.sqrt(2 * math.pi)) + model.beta / model.range_max
    return valid_beams(ranges).sum(-1) * best**model.power


@dataclass(frozen=True)
class BeamModel(SensorModel):
    """Tempered beam model (Probabilistic Robotics, table 6.1), per metre of range.

    Attributes:
        z_hit, z_short, z_max, z_rand: weights of the four causes of a reading; they sum to one.
        sigma_hit: standard deviation of a hit, metres.
        temper: factor on the log-likelihood, as neighbouring beams are not independent.
        range_max: metres.
    """

    z_hit: float = 0.7
    z_short: float = 0.15
    z_max: float = 0.05
    z_rand: float = 0.1
    sigma_hit: float = 0.2
    temper: float = 0.25
    range_max: float = 10.0

    def __post_init__(self) -> None:
        checks.share(self, "z_hit z_short z_max z_rand")
        checks.sum_to_one(self, "z_hit z_short z_max z_rand")
        checks.positive(self, "sigma_hit temper range_max")

    def log_likelihood(self, tables: RayTables, poses: Array, ranges: Array) -> Array:
        """Tempered log p(z | x) against the walls that the rays meet."""
        return beam_log_likelihood(ranges, tables.expected(poses), self)


def beam_log_terms(ranges: Array, expected: Array, model: BeamModel) -> Array:
    """Log-likelihood of each beam, shapes broadcast, untempered; 0 for invalid beams."""
    no_return, no_wall = jnp.isposinf(ranges), jnp.isposinf(expected)
    difference = jnp.where(no_return | no_wall, jnp.inf, ranges - jnp.where(no_wall, 0.0, expected))
    hit = jnp.exp(-0.5 * (difference / model.sigma_hit) ** 2) / (model.sigma_hit * math.sqrt(2 * math.pi))
    reach = jnp.minimum(expected, model.range_max)
    short = jnp.where(ranges < reach, 1.0 / jnp.maximum(reach, model.sigma_hit), 0.0)
    returned = model.z_hit * hit + model.z_short * short + model.z_rand / model.range_max
    missing = jnp.where(no_wall, model.z_hit + model.z_max, model.z_max) + model.z_rand / model.range_max
    return jnp.where(valid_beams(ranges), jnp.log(jnp.where(no_return, missing, returned)), 0.0)


def beam_log_likelihood(ranges: Array, expected: Array, model: BeamModel) -> Array:
    """Tempered log p(z | x) of scans (..., B) in metres: (...)."""
    return model.temper * beam_log_terms(ranges, expected, model).sum(-1)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class FieldTables:
    """A map for end points.

    Attributes:
        distance: (H, W) metres from cell centres to the nearest occupied one, cut at ``max_distance``.
        grid: the map.
        lidar: geometry of the beams that are used (static).
    """

    distance: Array
    grid: OccupancyGrid
    lidar: LidarConfig = field(metadata={"static": True})


@dataclass(frozen=True)
class LikelihoodField(SensorModel):
    """Tempered end-point model (Probabilistic Robotics, table 6.3; nav2 ``likelihood_field``).

    Attributes:
        z_hit, z_rand: weights; they sum to one.
        sigma_hit: standard deviation of the distance to the nearest obstacle, metres.
        max_distance: distances are cut here, metres (``laser_likelihood_max_dist``).
        temper: factor on the log-likelihood.
        range_max: metres.
    """

    z_hit: float = 0.9
    z_rand: float = 0.1
    sigma_hit: float = 0.2
    max_distance: float = 2.0
    temper: float = 0.25
    range_max: float = 10.0

    def __post_init__(self) -> None:
        checks.share(self, "z_hit z_rand")
        checks.sum_to_one(self, "z_hit z_rand")
        checks.positive(self, "sigma_hit max_distance temper range_max")

    def tables(self, rays: RayTables) -> FieldTables:
        """The distance field in place of rays."""
        grid = rays.map.grid
        return FieldTables(distance_field(grid, self), grid, rays.lidar)

    def log_likelihood(self, tables: FieldTables, poses: Array, ranges: Array) -> Array:
        """Tempered log p(z | x) of the scan's end points."""
        return field_log_likelihood(tables.distance, tables.grid, poses, ranges, tables.lidar, self)


@partial(jax.jit, static_argnames="model")
def distance_field(grid: OccupancyGrid, model: LikelihoodField) -> Array:
    """(H, W) metres from cell centres to the nearest occupied one, at most ``max_distance``."""
    cap = max(1, math.ceil(model.max_distance / grid.resolution))
    return jnp.minimum(euclidean_distance(grid.occupied, cap) * grid.resolution, model.max_distance)


def interpolate_cells(values: Array, i: Array, j: Array) -> Array:
    """Bilinear value of ``values`` (H, W) at real-valued cell coordinates, edges extended."""
    i, j = jnp.clip(i, 0, values.shape[0] - 1), jnp.clip(j, 0, values.shape[1] - 1)
    i0, j0 = (jnp.floor(v).astype(jnp.int32) for v in (i, j))
    i1, j1 = jnp.minimum(i0 + 1, values.shape[0] - 1), jnp.minimum(j0 + 1, values.shape[1] - 1)
    di, dj = i - i0, j - j0
    low = values[i0, j0] * (1 - dj) + values[i0, j1] * dj
    high = values[i1, j0] * (1 - dj) + values[i1, j1] * dj
    return low * (1 - di) + high * di


def field_log_likelihood(
    distance: Array, grid: OccupancyGrid, poses: Array, ranges: Array, lidar: LidarConfig, model: LikelihoodField
) -> Array:
    """Tempered log p(z | x) (...) of one scan (B,) at poses (..., 3); beams without return say nothing here."""
    points, valid = scan_points(ranges, lidar)
    ends = transform_points(grid.to_grid(poses), points) / grid.resolution - 0.5
    gap = interpolate_cells(distance, ends[..., 1], ends[..., 0])
    density = jnp.exp(-0.5 * (gap / model.sigma_hit) ** 2) / (model.sigma_hit * math.sqrt(2 * math.pi))
    terms = jnp.log(model.z_hit * density + model.z_rand / model.range_max)
    return model.temper * jnp.where(valid, terms, 0.0).sum(-1)
