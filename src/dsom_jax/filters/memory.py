"""What filters have in common whose proposal remembers: a belief that is moved and multiplied, once for all runs."""

from __future__ import annotations

from typing import Any, NoReturn

from dsom_jax.proposals.markov_grid import MarkovGrid, Recollection
from dsom_jax.types import Inputs


class Recalling:
    """A filter with a :class:`MarkovGrid` as its proposal, stepped through its whole past (``types.Remembering``)."""

    proposal: MarkovGrid

    def prepare(self, inputs: Inputs) -> NoReturn:
        """TypeError: one scan alone is not what this filter's updates need; it would forget all the others."""
        raise TypeError(f"{type(self).__name__}: the proposal has a past; call begin() and recall(), not prepare()")

    def begin(self) -> Any:
        """Memory before the first update."""
        return self.proposal.begin()

    def recall(self, memory: Any, inputs: Inputs) -> tuple[Recollection, Any]:
        """The proposal for this update, and the memory after it."""
        return self.proposal.recall(memory, inputs)
