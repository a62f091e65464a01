"""Grid localization whose scans are judged by DSOM: its probability maps, multiplied along the drive.

For maps that differ from the world everywhere by a little, as floor plans do: there one scan says little, to a network
as to a likelihood, and a drive says more (``experiments/robust/NOTES.md``).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import jax

from dsom_jax import checks
from dsom_jax.proposals.dsom import DSOMProposal
from dsom_jax.proposals.hybrid import log_network
from dsom_jax.proposals.markov_grid import MarkovGrid
from dsom_jax.types import Array, Inputs


@dataclass(frozen=True)
class MarkovNetworkConfig:
    """What one scan is worth; little of it, as scans taken one after another err alike.

    Attributes:
        power: exponent of PM.
        temper: factor on the log-likelihood, which joins in; 0 leaves it to the network alone.
        floor: share of PM that is spread evenly, so that one scan cannot veto a place.
    """

    power: float = 0.3
    temper: float = 0.0
    floor: float = 0.01

    def __post_init__(self) -> None:
        checks.positive(self, "power")
        checks.not_negative(self, "temper")
        checks.share(self, "floor", excluding="()")


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class MarkovNetwork(MarkovGrid):
    """A belief on the cells of the likelihood grid, by what the network says of every scan.

    Attributes:
        network: trained proposal on the same map.
        worth: of its PM and of the likelihood (static).
    """

    network: DSOMProposal = field(kw_only=True)
    worth: MarkovNetworkConfig = field(default=MarkovNetworkConfig(), kw_only=True, metadata={"static": True})

    def evidence(self, inputs: Inputs) -> Array:
        """(C, K) power * log PM + temper * log p(z | x)."""
        learnt = self.worth.power * log_network(self.network, self.likelihood, inputs, self.worth.floor)
        if self.worth.temper == 0:
            return learnt
        return learnt + self.likelihood.tempered(self.worth.temper).log_likelihood(inputs.ranges)
