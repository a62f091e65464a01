"""AdaM MCL, Algorithm 1 of the paper as printed."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import jax

from dsom_jax import checks
from dsom_jax.filters.common import Info, ParticleState
from dsom_jax.filters.updates import SharedProposal, mixture_update
from dsom_jax.types import Array, Inputs, Key


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class AdamMCL(SharedProposal):
    """Each particle keeps its history or is redrawn, as its own weight says.

    Attributes:
        t_cut: trust above which a particle is always kept (static).
    """

    t_cut: float = field(default=0.6, metadata={"static": True})

    def __post_init__(self) -> None:
        checks.share(self, "t_cut")

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
