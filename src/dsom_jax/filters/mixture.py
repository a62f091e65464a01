"""Mixture MCL (Thrun et al. 2001): an MCL update with probability p, else a dual MCL update of all particles."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp

from dsom_jax.filters.common import Info, ParticleState
from dsom_jax.filters.updates import FilterConfig, World, mixture_update, start
from dsom_jax.types import Inputs, Key, Proposal


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class MixtureMCL:
    """The coin is tossed once per update for the whole set; the first update is always MCL.

    Attributes:
        world: map and models.
        proposal: samplable observation model of the dual update.
        config: particles, predecessor rule, resampling (static).
        p: probability of an MCL update, 0.95 in the authors' code (static).
    """

    world: World
    proposal: Proposal
    config: FilterConfig = field(metadata={"static": True})
    p: float = field(default=0.95, metadata={"static": True})

    def prepare(self, inputs: Inputs) -> Any:
        """The proposal for this scan."""
        return self.proposal.prepare(inputs)

    def init(self, key: Key) -> ParticleState:
        """Uniform particles."""
        return start(key, self.world, self.config)

    def step(self, key: Key, state: ParticleState, inputs: Inputs, prepared: Any) -> tuple[ParticleState, Info]:
        """One update."""
        k_split, k_update = jax.random.split(key)
        mcl = (jax.random.uniform(k_split) < self.p) | (state.updates == 0)
        high = jnp.broadcast_to(mcl, (self.config.particles,))
        return mixture_update(k_update, state, high, inputs, self.world, self.proposal, prepared, self.config)
