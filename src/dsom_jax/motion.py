"""Motion models p(x' | a, x); the increment ``a`` is in the previous base frame (m, m, rad)."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jax.scipy.stats import norm

from dsom_jax import checks
from dsom_jax.geometry import compose, relative, wrap_angle
from dsom_jax.types import Array, Key


@dataclass(frozen=True)
class OdometryMotion:
    """Odometry model of a differential drive (Probabilistic Robotics, tables 5.5 and 5.6; nav2 parameters).

    Attributes:
        alpha1: rotation noise from rotation.
        alpha2: rotation noise from translation, rad^2 / m^2.
        alpha3: translation noise from translation.
        alpha4: translation noise from rotation, m^2 / rad^2.
        min_xy, min_theta: standard deviations (m, rad) added however little the robot moved; a filter needs them
            positive, so that particles never coincide and densities stay finite; 0 simulates an exact drive.
        slip: probability that the reported translation is wrong altogether, and its true share uniform in [-1.2, 1.2]:
            wheels that slip or are blocked, encoders that do not tell backward from forward.
        tail: probability that the noise has ``tail_scale`` times its standard deviation: tyres on another floor.
        tail_scale: that factor.
    """

    alpha1: float = 0.2
    alpha2: float = 0.2
    alpha3: float = 0.2
    alpha4: float = 0.2
    min_xy: float = 0.02
    min_theta: float = 0.01
    slip: float = 0.0
    tail: float = 0.0
    tail_scale: float = 3.0

    def __post_init__(self) -> None:
        checks.not_negative(self, "alpha1 alpha2 alpha3 alpha4 min_xy min_theta")
        checks.share(self, "slip tail", excluding=")")
        checks.positive(self, "tail_scale")

    def spread(self, odometry: Array) -> tuple[Array, Array]:
        """Rotation-translation-rotation (3,) of an increment and the standard deviations (3,) of its parts."""
        travel = jnp.hypot(odometry[0], odometry[1])
        first = jnp.arctan2(odometry[1], odometry[0])
        # The direction of less than a centimetre is no turn that could make noise (nav2).
        turned = jnp.where(travel < 0.01, 0.0, first)
        turns = turned, wrap_angle(odometry[2] - turned)
        turn1, turn2 = (jnp.minimum(jnp.abs(r), jnp.abs(wrap_angle(r - jnp.pi))) for r in turns)
        by_travel = self.alpha2 * travel**2 + self.min_theta**2
        variances = (
            self.alpha1 * turn1**2 + by_travel,
            self.alpha3 * travel**2 + self.alpha4 * (turn1**2 + turn2**2) + self.min_xy**2,
            self.alpha1 * turn2**2 + by_travel,
        )
        return jnp.stack([first, travel, wrap_angle(odometry[2] - first)]), jnp.sqrt(jnp.stack(variances))

    def sample(self, key: Key, poses: Array, odometry: Array) -> Array:
        """One successor of each pose (..., 3)."""
        shape = poses.shape[:-1]
        k_noise, k_slip, k_tail = jax.random.split(key, 3)
        noise = self._scale(k_tail, (*shape, 1)) * jax.random.normal(k_noise, (*shape, 5))
        return self.moved(poses, odometry, noise, self._share_driven(k_slip, shape))

    def moved(self, poses: Array, odometry: Array, noise: Array, share: Array | float = 1.0) -> Array:
        """Successors of poses (..., 3) for standard normal ``noise`` (..., 5) and the ``share`` (...) driven."""
        parts, sigma = self.spread(odometry)
        first, travel, second = jnp.moveaxis(parts + sigma * noise[..., :3], -1, 0)
        travel = travel * share
        step = jnp.stack([travel * jnp.cos(first), travel * jnp.sin(first), first + second], axis=-1)
        return compose(poses, step.at[..., :2].add(self.min_xy * noise[..., 3:]))

    def _scale(self, key: Key, shape: tuple[int, ...]) -> Array:
        """Factor on the standard deviations: one, but for the tail."""
        if self.tail == 0:
            return jnp.ones(shape)
        return jnp.where(jax.random.uniform(key, shape) < self.tail, self.tail_scale, 1.0)

    def _share_driven(self, key: Key, shape: tuple[int, ...]) -> Array:
        """Share of the reported translation that was driven: one, but for slips."""
        if self.slip == 0:
            return jnp.ones(shape)
        k_which, k_share = jax.random.split(key)
        slipped = jax.random.uniform(k_which, shape) < self.slip
        return jnp.where(slipped, jax.random.uniform(k_share, shape, minval=-1.2, maxval=1.2), 1.0)

    def log_prob(self, new_poses: Array, poses: Array, odometry: Array) -> Array:
        """Log density (...) in 1 / (m^2 rad), Gaussian about the mean increment (first order in the noise).

        Slips and the tail are left out: this serves to match particles, not to weigh them.
        """
        parts, sigma = self.spread(odometry)
        error = relative(compose(poses, odometry), new_poses)
        ahead = wrap_angle(parts[0] - odometry[2])
        along = error[..., 0] * jnp.cos(ahead) + error[..., 1] * jnp.sin(ahead)
        across = error[..., 1] * jnp.cos(ahead) - error[..., 0] * jnp.sin(ahead)
        sigma_along = jnp.hypot(sigma[1], self.min_xy)
        sigma_across = jnp.hypot(parts[1] * sigma[0], self.min_xy)
        sigma_turn = jnp.hypot(sigma[0], sigma[2])
        bend = parts[1] * sigma[0] ** 2 / sigma_across**2
        left = jnp.sqrt(jnp.maximum(sigma_turn**2 - bend**2 * sigma_across**2, 1e-12))
        turn = wrap_angle(error[..., 2] - bend * across)
        return norm.logpdf(along, 0, sigma_along) + norm.logpdf(across, 0, sigma_across) + norm.logpdf(turn, 0, left)


@dataclass(frozen=True)
class OmniMotion:
    """Omnidirectional drive: independent noise on both translations and the rotation (nav2, alpha5 = strafing).

    Attributes:
        alpha1, alpha2, alpha3, alpha4: as in :class:`OdometryMotion`.
        alpha5: sideways noise from translation.
        min_xy, min_theta: floors of the standard deviations (m, rad).
    """

    alpha1: float = 0.2
    alpha2: float = 0.2
    alpha3: float = 0.2
    alpha4: float = 0.2
    alpha5: float = 0.2
    min_xy: float = 0.02
    min_theta: float = 0.01

    def __post_init__(self) -> None:
        checks.not_negative(self, "alpha1 alpha2 alpha3 alpha4 alpha5 min_xy min_theta")

    def spread(self, odometry: Array) -> Array:
        """Standard deviations (3,) along the direction of travel, across it, and of the heading."""
        travel2, turn2 = odometry[0] ** 2 + odometry[1] ** 2, odometry[2] ** 2
        floor = jnp.array([self.min_xy, self.min_xy, self.min_theta]) ** 2
        gains = jnp.array([[self.alpha3, self.alpha4], [self.alpha5, self.alpha4], [self.alpha2, self.alpha1]])
        return jnp.sqrt(gains @ jnp.stack([travel2, turn2]) + floor)

    def _frame(self, poses: Array, odometry: Array) -> Array:
        """Mean successor, turned into the direction of travel."""
        way = jnp.arctan2(odometry[1], odometry[0])
        mean = compose(poses, odometry)
        return mean.at[..., 2].set(poses[..., 2] + way)

    def sample(self, key: Key, poses: Array, odometry: Array) -> Array:
        """One successor of each pose (..., 3)."""
        noise = self.spread(odometry) * jax.random.normal(key, poses.shape)
        moved = compose(self._frame(poses, odometry), noise)
        return moved.at[..., 2].set(wrap_angle(poses[..., 2] + odometry[2] + noise[..., 2]))

    def log_prob(self, new_poses: Array, poses: Array, odometry: Array) -> Array:
        """Log density (...) in 1 / (m^2 rad)."""
        error = relative(self._frame(poses, odometry), new_poses)
        turn = wrap_angle(new_poses[..., 2] - poses[..., 2] - odometry[2])
        error = jnp.concatenate([error[..., :2], turn[..., None]], axis=-1)
        return norm.logpdf(error, 0.0, self.spread(odometry)).sum(-1)


def omni_like(drive: OdometryMotion) -> OmniMotion:
    """An omnidirectional drive with the noise of a differential one, as wide sideways as along."""
    shared = {name: getattr(drive, name) for name in ("alpha1", "alpha2", "alpha3", "alpha4", "min_xy", "min_theta")}
    return OmniMotion(**shared, alpha5=drive.alpha3)
