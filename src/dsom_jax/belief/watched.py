"""Any filter with a verdict: hypotheses from the belief over the grid, and what a monitor makes of every answer."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from dsom_jax.belief.grid_belief import GridBelief
from dsom_jax.belief.grid_memory import Places
from dsom_jax.belief.hypotheses import Hypotheses, gather, share_at
from dsom_jax.belief.monitor import Monitor, Signs, Track
from dsom_jax.belief.verdict import Head, Verdict, judge, p_lost
from dsom_jax.occupancy import is_free
from dsom_jax.types import Array, Filter, Inputs, Key


class WatchedInfo(NamedTuple):
    """Diagnostics of one update: those of the filter, and how far they can be trusted.

    Attributes:
        mean, cluster, lost, redrawn, restarted: of the filter, see :class:`dsom_jax.filters.common.Info`.
        p_lost: () probability that the answer is more than 2 m or 10 deg off.
        verdict: () int8 of :class:`dsom_jax.belief.verdict.Verdict`.
        off_map: () mass of the belief off the map.
        hypotheses: the places that hold the belief.
        signs: what ``p_lost`` is made of.
    """

    mean: Array
    cluster: Array
    lost: Array
    redrawn: Array
    restarted: Array
    p_lost: Array
    verdict: Array
    off_map: Array
    hypotheses: Hypotheses
    signs: Signs


class Shared(NamedTuple):
    """What all runs share at an update: what the filter prepared, the belief, and its places."""

    prepared: Any
    places: Places
    hypotheses: Hypotheses


class WatchedState(NamedTuple):
    """State of one run: the filter's own, what the monitor remembers, and the last verdict ()."""

    state: Any
    track: Track
    verdict: Array


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Watched:
    """A filter that says how far it can be trusted; its answers are those of the filter alone, bit for bit.

    Attributes:
        filter: the filter.
        belief: where the robot may be, by all scans.
        monitor: what looks at the answers.
        drawn: the filter's proposal is this very belief, which is then computed once (static).
        head: tolerances of ``p_lost`` (static).
        estimate: which of the filter's two answers is watched, ``cluster`` or ``mean`` (static).
    """

    filter: Filter
    belief: GridBelief
    monitor: Monitor
    drawn: bool = field(metadata={"static": True})
    head: Head = field(metadata={"static": True})
    estimate: str = field(default="cluster", metadata={"static": True})

    def begin(self) -> tuple[Any, Any]:
        """Memories of filter and belief; one if they are the same."""
        return self.filter.begin(), () if self.drawn else self.belief.begin()

    def prepare(self, memory: tuple[Any, Any], inputs: Inputs) -> tuple[Shared, tuple[Any, Any]]:
        """The filter's part, and the places of the belief."""
        prepared, own = self.filter.prepare(memory[0], inputs)
        places, seen = (prepared, ()) if self.drawn else self.belief.prepare(memory[1], inputs)
        return Shared(prepared, places, gather(places.poses, 1.0 - places.off)), (own, seen)

    def init(self, key: Key) -> WatchedState:
        """Nothing known."""
        return WatchedState(self.filter.init(key), self.monitor.start(jnp.zeros(3)), jnp.int8(Verdict.LOST))

    def around(self, key: Key, pose: Array, covariance: Array) -> tuple[Any, WatchedState, Array]:
        """Memory and state after a start from a pose (3,) with a covariance (3, 3), and the share of it that is free.

        TypeError where the filter cannot.
        """
        if not hasattr(self.filter, "around"):
            raise TypeError(f"{type(self.filter).__name__} cannot start from a pose; use AdaM robust")
        own, state, free = self.filter.around(key, pose, covariance)
        memory = own, () if self.drawn else self.belief.around(pose, covariance)
        return memory, WatchedState(state, self.monitor.start(pose), jnp.int8(Verdict.LOCALIZED)), free

    def step(self, key: Key, state: WatchedState, inputs: Inputs, prepared: Shared) -> tuple[WatchedState, WatchedInfo]:
        """One update of the filter, and what to make of it."""
        own, info = self.filter.step(key, state.state, inputs, prepared.prepared)
        places, answer = prepared.places, getattr(info, self.estimate)
        elsewhere = 1.0 - share_at(places.poses, answer)
        track, signs = self.monitor.watch(
            state.track, answer, inputs.ranges, inputs.odometry, inputs.index == 0, elsewhere, info.lost
        )
        wrong = p_lost(signs, self.head)
        on_map = is_free(self.monitor.tables.grid, answer)
        verdict = judge(state.verdict, wrong, places.off, on_map, signs.unknown, prepared.hypotheses)
        own_words = info._asdict()
        told = WatchedInfo(**own_words, p_lost=wrong, verdict=verdict, off_map=places.off,
                           hypotheses=prepared.hypotheses, signs=signs)  # fmt: skip
        return WatchedState(own, track, verdict), told
