"""Mixture MCL (Thrun et al. 2001): an MCL update with probability p, else a dual MCL update of all particles."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp

from dsom_jax import checks
from dsom_jax.filters.common import Info, ParticleState
from dsom_jax.filters.updates import SharedProposal, mixture_update
from dsom_jax.types import Inputs, Key


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class MixtureMCL(SharedProposal):
    """The coin is tossed once per update for the whole set; the first update is always MCL.

    Attributes:
        p: probability of an MCL update, 0.95 in the authors' code (static).
    """

    p: float = field(default=0.95, metadata={"static": True})

    def __post_init__(self) -> None:
        checks.share(self, "p")

    def step(self, key: Key, state: ParticleState, inputs: Inputs, prepared: Any) -> tuple[ParticleState, Info]:
        """One update."""
        k_split, k_update = jax.random.split(key)
        mcl = (jax.random.uniform(k_split) < self.p) | (state.updates == 0)
        high = jnp.broadcast_to(mcl, (self.config.particles,))
        return mixture_update(k_update, state, high, inputs, self.world, self.proposal, prepared, self.config)
