"""AdaM robust: the Bayes filter of a robot that is carried away with a small probability at every update.

x_t ~ (1 - eps) p(. | x_{t-1}, a) + eps U(free space) is sampled as an adaptive mixture: H particles by motion from the
resampled set, L particles from the proposal q. Importance weights then follow, and nothing has to be inherited:

    H: (1 - eps) p(z | x) w / (r N_H)        L: eps u(x) p(z | x) / (q(x) N_L)

with r the resampling distribution. The posterior mass of L is the probability of having just been moved, so that a
redrawn place takes over only when the evidence outweighs eps. The start is the same mixture with all mass in L.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.scipy.special import logsumexp

from dsom_jax import checks
from dsom_jax.filters.common import Info, describe
from dsom_jax.filters.world import World
from dsom_jax.geometry import wrap_angle
from dsom_jax.occupancy import is_free
from dsom_jax.resampling import pick
from dsom_jax.types import Array, Inputs, Key, Proposal


@dataclass(frozen=True)
class RobustConfig:
    """Choices of AdaM robust (static).

    Attributes:
        particles: N.
        kidnap: eps, prior probability of being carried away between two updates.
        low_min, low_max: least and greatest share of redrawn particles; in between it follows the probability of
            being lost (the trust of the paper, for the set as a whole).
        flatten: share of the resampling distribution that is proportional to sqrt(w) in place of w: improbable
            places live on, at their true weight, until several scans have spoken.
        caution: share of the log-likelihood that is left out while the filter is wholly lost: one scan alone, of a
            place that looks like others, is not to decide.
    """

    particles: int = 500
    kidnap: float = 1e-5
    low_min: float = 0.1
    low_max: float = 0.5
    flatten: float = 0.3
    caution: float = 0.5

    def __post_init__(self) -> None:
        checks.count(self, "particles")
        checks.share(self, "kidnap low_min low_max", excluding="()")
        checks.share(self, "flatten caution", excluding=")")
        if self.low_min > self.low_max:
            raise ValueError(checks.message(self, "low_min", f"must not exceed low_max = {self.low_max!r}"))


class RobustState(NamedTuple):
    """Weighted particle set.

    Attributes:
        poses: (N, 3) map frame.
        log_weights: (N,) logarithms of weights that sum to one.
        lost: () probability that the reported place is wrong, after the last update.
        updates: () number of updates made.
    """

    poses: Array
    log_weights: Array
    lost: Array
    updates: Array


class Component(NamedTuple):
    """Poses (N, 3) of one component and log(prior density / (proposal density * number of draws)) (N,)."""

    poses: Array
    log_ratio: Array


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class AdamRobust:
    """Adaptive mixture particle filter with a kidnapping prior.

    Attributes:
        world: map and models; ``world.space`` is u.
        proposal: samplable observation model, q; wherever it has mass zero, the filter cannot find the robot anew.
        config: static.
    """

    world: World
    proposal: Proposal
    config: RobustConfig = field(metadata={"static": True})

    def begin(self) -> Any:
        """The proposal's memory."""
        return self.proposal.begin()

    def prepare(self, memory: Any, inputs: Inputs) -> tuple[Any, Any]:
        """The proposal for this scan, and its memory."""
        return self.proposal.prepare(memory, inputs)

    def init(self, key: Key) -> RobustState:
        """Uniform particles; the first update replaces them all."""
        n = self.config.particles
        poses, _ = self.world.space.sample(key, None, n)
        return RobustState(poses, jnp.full((n,), -math.log(n), jnp.float32), jnp.float32(1.0), jnp.int32(0))

    def around(self, key: Key, pose: Array, covariance: Array) -> tuple[Any, RobustState, Array]:
        """Memory and state after a start from a pose (3,) with a covariance (3, 3), and the share of it that is free.

        The next update moves and weighs these particles; it does not draw them anew.
        """
        n = self.config.particles
        root = jnp.linalg.cholesky(covariance + 1e-6 * jnp.eye(3))
        poses = pose + jax.random.normal(key, (n, 3)) @ root.T
        poses = poses.at[:, 2].set(wrap_angle(poses[:, 2]))
        free = is_free(self.world.grid, poses)
        log_weights = jnp.where(free, 0.0, -jnp.inf) - jnp.log(jnp.maximum(free.sum(), 1))
        state = RobustState(poses, log_weights, jnp.float32(0.0), jnp.int32(1))
        return self._memory_around(pose, covariance), state, free.mean()

    def _memory_around(self, pose: Array, covariance: Array) -> Any:
        """The proposal's memory, if it has one, after a start from a pose."""
        return self.proposal.begin()

    def step(self, key: Key, state: RobustState, inputs: Inputs, prepared: Any) -> tuple[RobustState, Info]:
        """One update."""
        k_high, k_low = jax.random.split(key)
        low = jnp.arange(self.config.particles) < self._redraws(state)
        kept = self._keep(k_high, state, low, inputs)
        redrawn = self._redraw(k_low, state, low, prepared)
        # Weigh
        poses = jnp.where(low[:, None], redrawn.poses, kept.poses)
        evidence = self._worth(state, prepared) * self._evidence(poses, inputs)
        log_weights = jnp.where(low, redrawn.log_ratio, kept.log_ratio) + evidence
        total = logsumexp(log_weights)
        dead = ~jnp.isfinite(total)
        log_weights = jnp.where(dead, -jnp.log(self.config.particles), log_weights - total)
        # Estimate
        info = self._doubted(describe(poses, jnp.exp(log_weights), low.mean(), dead), prepared)
        return RobustState(poses, log_weights, info.lost, state.updates + 1), info

    def _redraws(self, state: RobustState) -> Array:
        """N_L: everything at first, then as much as the filter doubts itself."""
        share = jnp.clip(state.lost, self.config.low_min, self.config.low_max)
        count = jnp.maximum(jnp.round(share * self.config.particles), 1)
        return jnp.where(state.updates == 0, self.config.particles, count).astype(jnp.int32)

    def _keep(self, key: Key, state: RobustState, low: Array, inputs: Inputs) -> Component:
        """H: resample systematically by r, move."""
        k_resample, k_move = jax.random.split(key)
        log_r = resampling_log_weights(state.log_weights, self.config.flatten)
        count = jnp.maximum((~low).sum(), 1)
        rank = jnp.maximum(jnp.cumsum(~low) - 1, 0)
        ancestors = pick(jnp.cumsum(jnp.exp(log_r)), (rank + jax.random.uniform(k_resample)) / count)
        poses = self.world.motion.sample(k_move, state.poses[ancestors], inputs.odometry)
        return Component(poses, self._log_kept(state) + (state.log_weights - log_r)[ancestors] - jnp.log(count))

    def _redraw(self, key: Key, state: RobustState, low: Array, prepared: Any) -> Component:
        """L: draw from q."""
        poses, log_q = self.proposal.sample(key, prepared, self.config.particles)
        return Component(poses, self._log_redrawn(state, poses, prepared) - log_q - jnp.log(low.sum()))

    def _log_kept(self, state: RobustState) -> Array:
        """Share of the prior that H stands for: log(1 - eps)."""
        return jnp.log1p(-self.config.kidnap)

    def _log_redrawn(self, state: RobustState, poses: Array, prepared: Any) -> Array:
        """Prior that L stands for, log(eps u(x)) (N,); at the first update it is all of it."""
        prior = jnp.where(state.updates == 0, 0.0, jnp.log(self.config.kidnap))
        # u is zero where no robot can stand, whatever q thinks: cells of PM may be larger than those of the map.
        return prior + jnp.where(is_free(self.world.grid, poses), self.world.space.log_density_value, -jnp.inf)

    def _worth(self, state: RobustState, prepared: Any) -> Array:
        """Share of the evidence that counts (): less while the filter is lost."""
        return 1.0 - self.config.caution * state.lost

    def _evidence(self, poses: Array, inputs: Inputs) -> Array:
        """log p(z | x) (N,)."""
        return self.world.log_likelihood(poses, inputs.ranges)

    def _doubted(self, info: Info, prepared: Any) -> Info:
        """What else is known of the answer."""
        return info


def resampling_log_weights(log_weights: Array, flatten: float) -> Array:
    """log r (N,): (1 - flatten) w + flatten sqrt(w) / sum(sqrt(w))."""
    if flatten == 0:
        return log_weights
    root = 0.5 * log_weights
    return jnp.logaddexp(jnp.log1p(-flatten) + log_weights, jnp.log(flatten) + root - logsumexp(root))
