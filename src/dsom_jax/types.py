"""Aliases and the three protocols that a user extends: motion, proposal, filter."""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax

Array = jax.Array
Key = jax.Array
"""A typed key of ``jax.random.key``."""


class Inputs(NamedTuple):
    """What a filter is given at one update.

    Attributes:
        ranges: (B,) metres, REP-117: +inf no return, -inf too close, NaN invalid.
        odometry: (3,) motion since the previous update in the previous base frame (m, m, rad).
        index: () number of the update within its episode.
    """

    ranges: Array
    odometry: Array
    index: Array  # type: ignore[assignment]  # hides tuple.index, which nobody needs here


class Motion(Protocol):
    """Motion model p(x' | a, x) of Probabilistic Robotics, chapter 5."""

    def sample(self, key: Key, poses: Array, odometry: Array) -> Array:
        """Draw one successor of each pose: (..., 3), (3,) -> (..., 3)."""
        ...

    def log_prob(self, new_poses: Array, poses: Array, odometry: Array) -> Array:
        """Log density of ``new_poses`` given ``poses``, shapes broadcast: (...) in 1 / (m^2 rad)."""
        ...


class Proposal(Protocol):
    """Samplable observation model q(x | z, map): what DSOM is in the paper."""

    def prepare(self, inputs: Inputs) -> Any:
        """Whatever one scan needs once, shared by all particles and all runs."""
        ...

    def sample(self, key: Key, prepared: Any, n: int) -> tuple[Array, Array]:
        """Draw ``n`` poses (n, 3) and their log densities (n,) in 1 / (m^2 rad)."""
        ...


class Filter(Protocol):
    """A particle filter as pure functions; ``Info`` has ``mean``, ``cluster``, ``lost`` (see filters.common)."""

    def prepare(self, inputs: Inputs) -> Any:
        """The part of an update that no particle enters."""
        ...

    def init(self, key: Key) -> Any:
        """State before the first scan: no prior on the pose."""
        ...

    def step(self, key: Key, state: Any, inputs: Inputs, prepared: Any) -> tuple[Any, Any]:
        """One update: new state and diagnostics."""
        ...


@runtime_checkable
class Remembering(Protocol):
    """What a filter has beside :class:`Filter` if the part of an update that no particle enters has a past."""

    def begin(self) -> Any:
        """Memory before the first update, one for all runs."""
        ...

    def recall(self, memory: Any, inputs: Inputs) -> tuple[Any, Any]:
        """In place of ``prepare``: what the update needs, and the memory after it."""
        ...
