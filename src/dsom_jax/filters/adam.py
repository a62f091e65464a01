"""AdaM MCL, Algorithm 1 of the paper as printed."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import jax

from dsom_jax.filters.common import Info, ParticleState
from dsom_jax.filters.updates import FilterConfig, World, mixture_update, start
from dsom_jax.types import Array, Inputs, Key, Proposal


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class AdamMCL:
    """Each particle keeps its history or is redrawn, as its own weight says.

    Attributes:
        world: map and models.
        proposal: samplable observation model, DSOM in the paper.
        config: particles, predecessor rule, resampling (static).
        t_cut: trust above which a particle is always kept (static).
    """

    world: World
    proposal: Proposal
    config: FilterConfig = field(metadata={"static": True})
    t_cut: float = field(default=0.6, metadata={"static": True})

    def prepare(self, inputs: Inputs) -> Any:
        """The proposal for this scan."""
        return self.proposal.prepare(inputs)

    def init(self, key: Key) -> ParticleState:
        """Uniform particles."""
        return start(key, self.world, self.config)

    def step(self, key: Key, state: ParticleState, inputs: Inputs, prepared: Any) -> tuple[ParticleState, Info]:
        """One update; all of the first is MCL."""
        k_split, k_update = jax.random.split(key)
        high = (state.updates == 0) | trusted(k_split, state.weights, self.t_cut)
        return mixture_update(k_update, state, high, inputs, self.world, self.proposal, prepared, self.config)


def trusted(key: Key, trust: Array, t_cut: float) -> Array:
    """Membership of H (N,): T_i > T_cut, else with probability T_i (Alg 1, lines 3 to 9).

    T_i = w_i / w* is the weight itself, as weights are kept in units of w*.
    """
    return (trust > t_cut) | (jax.random.uniform(key, trust.shape) < trust)
