"""Aliases and the three protocols that a user extends: motion, proposal, filter."""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp

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

    def begin(self) -> Any:
        """Memory before the first scan, a pytree; ``()`` if each scan is taken on its own."""
        ...

    def prepare(self, memory: Any, inputs: Inputs) -> tuple[Any, Any]:
        """Whatever one scan needs once, shared by all particles and all runs, and the memory after it."""
        ...

    def sample(self, key: Key, prepared: Any, n: int) -> tuple[Array, Array]:
        """Draw ``n`` poses (n, 3) and their log densities (n,) in 1 / (m^2 rad)."""
        ...


class Filter(Protocol):
    """A particle filter as pure functions; ``Info`` has ``mean``, ``cluster``, ``lost`` (see filters.common)."""

    def begin(self) -> Any:
        """Memory before the first update, one for all runs; ``()`` if the part that they share has no past."""
        ...

    def prepare(self, memory: Any, inputs: Inputs) -> tuple[Any, Any]:
        """The part of an update that no particle enters, and the memory after it."""
        ...

    def init(self, key: Key) -> Any:
        """State before the first scan: no prior on the pose."""
        ...

    def step(self, key: Key, state: Any, inputs: Inputs, prepared: Any) -> tuple[Any, Any]:
        """One update: new state and diagnostics."""
        ...


def prepare_alone(source: Proposal | Filter, inputs: Inputs) -> Any:
    """What is prepared for a scan whose past is unknown: it starts there, whatever the odometry says."""
    return source.prepare(source.begin(), inputs._replace(odometry=jnp.full(3, jnp.nan)))[0]
