"""MCL with random injection (Probabilistic Robotics, table 8.2 with a fixed injection rate)."""

from __future__ import annotations

from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
import numpy as np

from dsom_jax import checks
from dsom_jax.filters.common import Info, ParticleState
from dsom_jax.filters.updates import Draw, FilterConfig, conclude, even_particles, resample_and_move
from dsom_jax.filters.world import World
from dsom_jax.types import Array, Inputs, Key


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class MCL:
    """Sampling, weighting, resampling; a share ``injection`` of the particles is drawn anew from free space.

    Attributes:
        world: map and models.
        config: particles and resampling (static).
        injection: share of random particles at every update, 0.2 in the paper (static).
    """

    world: World
    config: FilterConfig = field(metadata={"static": True})
    injection: float = field(default=0.2, metadata={"static": True})

    def __post_init__(self) -> None:
        checks.share(self, "injection")

    def begin(self) -> tuple[()]:
        """No memory: each scan is taken on its own."""
        return ()

    def prepare(self, memory: tuple[()], inputs: Inputs) -> tuple[None, tuple[()]]:
        """Nothing is shared between particles."""
        return None, memory

    def init(self, key: Key) -> ParticleState:
        """Uniform particles."""
        return even_particles(key, self.world, self.config)

    def step(self, key: Key, state: ParticleState, inputs: Inputs, prepared: None) -> tuple[ParticleState, Info]:
        """One update."""
        _, k_update = jax.random.split(key)
        k_high, k_fresh, _ = jax.random.split(k_update, 3)
        everyone = jnp.ones(self.config.particles, bool)
        moved = resample_and_move(k_high, state, everyone, inputs, self.world, self.config)
        fresh, _ = self.world.space.sample(k_fresh, None, self.config.particles)
        poses = self._inject(moved, fresh)
        weights = self.world.weigh(poses, inputs.ranges)
        return conclude(state, Draw(poses, weights), jnp.float32(0.0), fresh, self.config)

    def _inject(self, poses: Array, fresh: Array) -> Array:
        """Random particles in place of evenly spaced ones (neighbours in the set share an ancestor)."""
        count = round(self.injection * self.config.particles)
        if count == 0:
            return poses
        slots = np.linspace(0, self.config.particles, count, endpoint=False).astype(np.int32)
        return poses.at[slots].set(fresh[:count])
