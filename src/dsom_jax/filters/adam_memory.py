"""AdaM robust with a proposal that remembers: the whole history speaks for a redrawn place, not this scan alone.

Both components now estimate the same posterior: H from the particles of the last update, L from the belief b- on the
grid, which holds the kidnapping prior. They are averaged with the weights 1 - a and a, where a
follows the probability of being lost, as the number of redrawn particles does:

    H: (1 - a) p(z | x) w / (r N_H)        L: a b-(x) p(z | x) / (q(x) N_L)

Particles refine what the grid is too coarse for; the grid carries the places that particles have lost.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp

from dsom_jax import checks
from dsom_jax.belief.grid_belief import GridBelief
from dsom_jax.belief.grid_memory import Places
from dsom_jax.belief.hypotheses import share_at
from dsom_jax.filters.adam_robust import AdamRobust, Component, RobustState
from dsom_jax.filters.common import Info
from dsom_jax.occupancy import is_free
from dsom_jax.proposals.markov_grid import MarkovGrid, Recollection
from dsom_jax.types import Array, Key

_LEAST = 0.2
"""Share of the evidence of a scan that brings nothing new."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class AdamMemory(AdamRobust):
    """Adaptive mixture of particles and grid localization.

    Attributes:
        proposal: the likelihood grid with its belief.
        share: least and greatest a, weight of what the grid says (static).
    """

    proposal: MarkovGrid
    share: tuple[float, float] = field(default=(0.01, 0.5), metadata={"static": True})

    def __post_init__(self) -> None:
        checks.span(self, "share")

    def _share(self, state: RobustState) -> Array:
        """a ()."""
        return jnp.clip(state.lost, *self.share)

    def _memory_around(self, pose: Array, covariance: Array) -> Any:
        """The belief of the grid."""
        return self.proposal.around(pose, covariance)

    def _log_kept(self, state: RobustState) -> Array:
        """log(1 - a)."""
        return jnp.log1p(-self._share(state))

    def _log_redrawn(self, state: RobustState, poses: Array, prepared: Recollection) -> Array:
        """log(a b-(x)); at the first update all is redrawn."""
        share = jnp.where(state.updates == 0, 0.0, jnp.log(self._share(state)))
        # The grid knows where the sensor may be; beside it the base may stand in a wall.
        stands = is_free(self.world.grid, poses)
        return share + jnp.where(stands, self.proposal.log_prior(prepared, poses), -jnp.inf)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class AdamPlaces(AdamMemory):
    """AdaM robust on the belief that knows which place: particles say where exactly within it.

    Attributes:
        proposal: the belief over the grid.
    """

    proposal: GridBelief  # type: ignore[assignment]  # in place of the memory that judges the whole grid every time

    def _redraw(self, key: Key, state: RobustState, low: Array, prepared: Places) -> Component:
        """L: from the pool of the belief, which knows what it believed of each before the scan."""
        poses, log_prior, log_q = self.proposal.draw(key, prepared, self.config.particles)
        share = jnp.where(state.updates == 0, 0.0, jnp.log(self._share(state)))
        stands = is_free(self.world.grid, poses)
        return Component(poses, share + jnp.where(stands, log_prior - log_q, -jnp.inf) - jnp.log(low.sum()))

    def _worth(self, state: RobustState, prepared: Places) -> Array:
        """Less while lost, and less of a scan that is not new; a little, so that particles stay where it holds them."""
        return super()._worth(state, prepared) * jnp.maximum(prepared.novelty, _LEAST)

    def _doubted(self, info: Info, prepared: Places) -> Info:
        """The place is lost if the belief is elsewhere, whichever of two equal clusters has survived."""
        return info._replace(lost=jnp.maximum(info.lost, 1.0 - share_at(prepared.poses, info.cluster)))
