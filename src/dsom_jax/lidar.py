"""The 2D lidar: geometry of its beams, range conventions, noise, and the scan as an image."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from numbers import Real

import jax
import jax.numpy as jnp
import numpy as np

from dsom_jax import checks
from dsom_jax.errors import shown
from dsom_jax.types import Array, Key


@dataclass(frozen=True)
class LidarConfig:
    """Geometry of a scan.

    Attributes:
        beams: number of ranges in a scan.
        angle_min: bearing of the first beam in the sensor frame, radians.
        angle_increment: bearing between beams, radians.
        range_min: metres; shorter is too close (-inf).
        range_max: metres; longer is no return (+inf). ``laser_max_range`` of nav2.
        mount: pose (x, y, yaw) of the sensor in the base frame.
        upside_down: the sensor hangs head down, so bearings run clockwise.
    """

    beams: int = 360
    angle_min: float = -math.pi
    angle_increment: float = 2 * math.pi / 360
    range_min: float = 0.0
    range_max: float = 10.0
    mount: tuple[float, float, float] = (0.0, 0.0, 0.0)
    upside_down: bool = False

    def __post_init__(self) -> None:
        checks.count(self, "beams")
        checks.finite(self, "angle_min angle_increment")
        near = _finite(self.mount) and len(self.mount) == 3 and max(map(abs, self.mount[:2])) <= 100
        if not (near and abs(self.mount[2]) <= 2 * math.pi + 1e-3):
            fix = "give x and y in metres, at most 100, and yaw in radians, within a turn (90 deg is 1.5708)"
            raise ValueError(checks.message(self, "mount", fix))
        if not (_finite((self.range_min, self.range_max)) and 0 <= self.range_min < self.range_max <= 1e5):
            ranges = f"{shown(self.range_min)}, {shown(self.range_max)} m"
            raise ValueError(f"need 0 <= range_min < range_max <= 100 km, got {ranges}")
        if self.beams > 1 and self.angle_increment == 0:
            raise ValueError(checks.message(self, "angle_increment", "give the angle between beams in radians"))
        spanned = (self.beams - 1) * abs(self.angle_increment)
        if abs(self.angle_min) > 2 * math.pi + 1e-3 or spanned > 2 * math.pi * 1.01:
            first, step = self.angle_min, self.angle_increment
            span = f"angle_min = {first:g}, {self.beams} beams with angle_increment = {step:g}"
            raise ValueError(f"{span}: beams span more than a turn. Did you pass degrees instead of radians?")

    @property
    def fov(self) -> float:
        """Angle covered by the scan, radians."""
        return self.beams * abs(self.angle_increment)

    def angles(self) -> np.ndarray:
        """(B,) bearings of the beams in the base frame, radians, mount yaw and ``upside_down`` applied."""
        bearings = self.angle_min + self.angle_increment * np.arange(self.beams)
        return np.asarray(self.mount[2] + (-bearings if self.upside_down else bearings), np.float32)

    def every(self, step: int) -> LidarConfig:
        """The scan that keeps beams 0, step, 2 step, ..."""
        return replace(self, beams=-(-self.beams // step), angle_increment=self.angle_increment * step)


@dataclass(frozen=True)
class LidarNoise:
    """Imperfections of the ranges.

    Attributes:
        sigma: standard deviation, metres.
        sigma_relative: standard deviation per metre of range.
        dropout: probability that a beam does not return.
        short: probability that something unknown returns the beam early, uniformly along it.
    """

    sigma: float = 0.0
    sigma_relative: float = 0.0
    dropout: float = 0.0
    short: float = 0.0

    def __post_init__(self) -> None:
        checks.not_negative(self, "sigma sigma_relative")
        checks.share(self, "dropout short")


def _finite(values: tuple[float, ...]) -> bool:
    return all(isinstance(v, Real) and abs(v) < math.inf for v in values)


def apply_limits(ranges: Array, lidar: LidarConfig) -> Array:
    """Ranges with the conventions of REP-117: beyond ``range_max`` +inf, below ``range_min`` -inf, NaN kept."""
    ranges = jnp.where(ranges >= lidar.range_max, jnp.inf, ranges)
    return jnp.where(ranges < lidar.range_min, -jnp.inf, ranges)


def observe(key: Key, ranges: Array, lidar: LidarConfig, noise: LidarNoise) -> Array:
    """Noisy scan (..., B) of a clean one: early returns, then Gaussian noise, then dropout, then limits.

    What is invalid (NaN) or too close (-inf) already stays so.
    """
    k_short, k_where, k_noise, k_drop = jax.random.split(key, 4)
    reach = jnp.minimum(ranges, lidar.range_max)
    early = reach * jax.random.uniform(k_where, ranges.shape)
    noisy = jnp.where(jax.random.uniform(k_short, ranges.shape) < noise.short, early, ranges)
    spread = noise.sigma + noise.sigma_relative * reach
    noisy = noisy + spread * jax.random.normal(k_noise, ranges.shape)
    noisy = jnp.where(jax.random.uniform(k_drop, ranges.shape) < noise.dropout, jnp.inf, noisy)
    return apply_limits(jnp.where(ranges > -jnp.inf, noisy, ranges), lidar)


def scan_points(ranges: Array, lidar: LidarConfig) -> tuple[Array, Array]:
    """End points (..., B, 2) of the beams in the base frame, metres, and which of them are real returns (..., B)."""
    angles = jnp.asarray(lidar.angles())
    valid = jnp.isfinite(ranges)
    reach = jnp.where(valid, ranges, 0.0)
    x = lidar.mount[0] + reach * jnp.cos(angles)
    y = lidar.mount[1] + reach * jnp.sin(angles)
    return jnp.stack([x, y], axis=-1), valid


def scan_image(ranges: Array, lidar: LidarConfig, resolution: float, size: int) -> Array:
    """Scan (B,) drawn as M_scan (size, size): 1 where a beam ends, base in the centre, x along +j, y along +i."""
    points, valid = scan_points(ranges, lidar)
    cells = jnp.floor(points / resolution + size / 2).astype(jnp.int32)
    j, i = jnp.where(valid[:, None], cells, -1).T
    i, j = (jnp.where((v >= 0) & (v < size), v, size) for v in (i, j))
    return jnp.zeros((size, size)).at[i, j].max(1.0, mode="drop")
