"""Grid localization whose scans are judged by DSOM: its probability maps, multiplied along the drive.

Where map and world differ everywhere by a little, as on a floor plan, learning judges a scan better than a likelihood
that is sure of its mistake; one scan still says little, and a drive says more (``experiments/robust/NOTES.md``).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import jax

from dsom_jax import checks
from dsom_jax.proposals.dsom import DSOMProposal
from dsom_jax.proposals.hybrid import log_network
from dsom_jax.proposals.markov_grid import MarkovGrid
from dsom_jax.types import Array, Inputs


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class MarkovNetwork(MarkovGrid):
    """A belief on the cells of the likelihood grid, which itself has no say in it.

    Attributes:
        network: trained proposal on the same map.
        power: exponent of its PM: scans taken one after another err alike (static).
        floor: share of PM that is spread evenly, so that one scan cannot veto a place (static).
    """

    network: DSOMProposal = field(kw_only=True)
    power: float = field(default=0.3, kw_only=True, metadata={"static": True})
    floor: float = field(default=0.01, kw_only=True, metadata={"static": True})

    def __post_init__(self) -> None:
        checks.positive(self, "power")
        checks.share(self, "floor", excluding="()")

    def evidence(self, inputs: Inputs) -> Array:
        """(C, K) log of DSOM's probability to the power."""
        return self.power * log_network(self.network, self.likelihood, inputs, self.floor)
