"""AdaM robust: the Bayes filter of a robot that is carried away with a small probability at every update.

x_t ~ (1 - eps) p(. | x_{t-1}, a) + eps U(free space) is sampled as an adaptive mixture: H particles by motion from the
resampled set, L particles from the proposal q. Importance weights then follow and nothing has to be inherited:

    H: (1 - eps) p(z | x) / N_H        L: eps u(x) p(z | x) / (q(x) N_L)

The posterior mass of L is the probability of having just been moved, so that a redrawn place takes over only when
the evidence outweighs eps. The start is the same mixture with all mass in L.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from dsom_jax.filters.common import Info as Info
from dsom_jax.filters.common import describe
from dsom_jax.lidar import LidarConfig
from dsom_jax.proposals.uniform import FreeSpace
from dsom_jax.raycast import MapTables, cast_rays
from dsom_jax.resampling import pick
from dsom_jax.sensor import BeamModel, beam_log_likelihood
from dsom_jax.types import Array, Inputs, Key, Motion, Proposal


@dataclass(frozen=True)
class RobustConfig:
    """Choices of AdaM robust (static).

    Attributes:
        particles: N.
        kidnap: eps, prior probability of being carried away per update.
        low_min, low_max: least and greatest share of particles redrawn, followed by the probability of being lost.
        beams: beams used for weighing.
        flatten: share of the resampling distribution proportional to sqrt(w) in place of w (with the weight to match):
            improbable places live on until several scans have spoken.
        model: sensor model.
    """

    particles: int = 500
    kidnap: float = 1e-5
    low_min: float = 0.1
    low_max: float = 0.5
    flatten: float = 0.0
    beam_step: int = 3
    model: BeamModel = field(default_factory=lambda: BeamModel(sigma_hit=0.2, temper=1 / 5))


class RobustState(NamedTuple):
    """Weighted set; ``log_weights`` (N,) are normalised, ``lost`` () is that of the last update."""

    poses: Array
    log_weights: Array
    lost: Array
    updates: Array


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class AdamRobust:
    """See the module's docstring."""

    tables: MapTables
    space: FreeSpace
    proposal: Proposal
    lidar: LidarConfig = field(metadata={"static": True})
    motion: Motion = field(metadata={"static": True})
    config: RobustConfig = field(metadata={"static": True})

    def prepare(self, inputs: Inputs) -> Any:
        return self.proposal.prepare(inputs)

    def init(self, key: Key) -> RobustState:
        n = self.config.particles
        poses, _ = self.space.sample(key, None, n)
        return RobustState(poses, jnp.full((n,), -jnp.log(n)), jnp.float32(1.0), jnp.int32(0))

    def step(self, key: Key, state: RobustState, inputs: Inputs, prepared: Any) -> tuple[RobustState, Info]:
        c = self.config
        k_res, k_move, k_low = jax.random.split(key, 3)
        n = c.particles
        first = state.updates == 0
        share = jnp.clip(state.lost, c.low_min, c.low_max)
        n_low = jnp.where(first, n, jnp.round(share * n)).astype(jnp.int32)
        slot = jnp.arange(n)
        low = slot < n_low
        n_high = n - n_low
        # resample
        w = jnp.exp(state.log_weights)
        r = (1 - c.flatten) * w
        if c.flatten:
            root = jnp.exp(0.5 * (state.log_weights - state.log_weights.max()))
            r = r + c.flatten * root / root.sum()
        pos = (jnp.maximum(slot - n_low, 0) + jax.random.uniform(k_res)) / jnp.maximum(n_high, 1)
        anc = pick(jnp.cumsum(r), jnp.minimum(pos, 1.0))
        corr = state.log_weights[anc] - jnp.log(r[anc])
        high = self.motion.sample(k_move, state.poses[anc], inputs.odometry)
        fresh, log_q = self.proposal.sample(k_low, prepared, n)
        poses = jnp.where(low[:, None], fresh, high)
        seen = inputs.ranges[:: c.beam_step]
        ll = beam_log_likelihood(seen, cast_rays(self.tables, poses, self.lidar), c.model)
        eps = jnp.where(first, 1.0, c.kidnap)
        lw_low = jnp.log(eps) + self.space.log_density_value - log_q - jnp.log(jnp.maximum(n_low, 1))
        lw_high = jnp.log1p(-c.kidnap) + corr - jnp.log(jnp.maximum(n_high, 1))
        lw = jnp.where(low, lw_low, jnp.where(first, -jnp.inf, lw_high)) + ll
        lw = lw - jax.scipy.special.logsumexp(lw)
        w = jnp.exp(lw)
        info = describe(poses, w, low.mean(), jnp.bool_(False))
        return RobustState(poses, lw, info.lost, state.updates + 1), info
