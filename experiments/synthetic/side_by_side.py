"""Runs of one filter under several conditions at once, so that what the scan alone decides (PM) is computed once."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp

from dsom_jax.episode import Episode
from dsom_jax.filters.adam import AdamMCL
from dsom_jax.geometry import relative, wrap_angle
from dsom_jax.montecarlo import Result, run
from dsom_jax.types import Array, Filter, Inputs, Key

Change = Callable[[Any, Inputs, Array], tuple[Any, Inputs]]
"""Filter and inputs under the condition with a given value (traced)."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class SideBySide:
    """V copies of a filter, one for each condition, each with the key of the run: what it does alone, bit for bit.

    Attributes:
        filter: the filter; conditions must not enter what it prepares.
        values: (V,) of the conditions.
        change: what a value means (static).
    """

    filter: Any
    values: Array
    change: Change = field(metadata={"static": True})

    def begin(self) -> Any:
        """The filter's own."""
        return self.filter.begin()

    def prepare(self, memory: Any, inputs: Inputs) -> tuple[Any, Any]:
        """The filter's own."""
        return self.filter.prepare(memory, inputs)

    def init(self, key: Key) -> Any:
        """The same start for all: leaves (V, ...)."""
        count = self.values.shape[0]
        return jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (count, *leaf.shape)), self.filter.init(key))

    def step(self, key: Key, states: Any, inputs: Inputs, prepared: Any) -> tuple[Any, Any]:
        """One update of all copies."""

        def one(state: Any, value: Array) -> tuple[Any, Any]:
            filter, changed = self.change(self.filter, inputs, value)
            return filter.step(key, state, changed, prepared)

        return jax.vmap(one)(states, self.values)


def run_all(filter: Filter, change: Change, values: tuple[float, ...], episode: Episode, keys: Key) -> list[Result]:
    """Results of R runs under each condition."""
    result = run(SideBySide(filter, jnp.asarray(values, jnp.float32), change), episode, keys)
    infos = [jax.tree.map(lambda leaf, n=n: leaf[:, :, n], result.info) for n in range(len(values))]
    states = [jax.tree.map(lambda leaf, n=n: leaf[:, n], result.state) for n in range(len(values))]
    return [Result(info, state, None) for info, state in zip(infos, states, strict=True)]


class _AnyCut(AdamMCL):
    """Alg 1 with a T_cut that is traced and can therefore not be checked."""

    def __post_init__(self) -> None:
        """Nothing to check."""


def other_t_cut(filter: AdamMCL, inputs: Inputs, value: Array) -> tuple[AdamMCL, Inputs]:
    """T_cut = ``value``."""
    return _AnyCut(filter.world, filter.proposal, filter.config, value), inputs  # type: ignore[arg-type]  # traced


def noisier(filter: Filter, inputs: Inputs, value: Array) -> tuple[Filter, Inputs]:
    """Odometry wrong ``value`` times as far; :func:`with_error` put the error into the inputs."""
    told, error = inputs.odometry[:3], inputs.odometry[3:]
    changed = told + (value - 1) * error
    return filter, inputs._replace(odometry=changed.at[2].set(wrap_angle(changed[2])))


def with_error(episode: Episode) -> Episode:
    """The episode whose odometry (T, 6) also says how wrong it is; for :func:`noisier` only.

    The error is the increment told less the true one, zero where the robot was carried (the increment then starts
    where it was put down, which the episode does not say) and at the start.
    """
    true = relative(episode.poses[:-1], episode.poses[1:])
    error = episode.odometry[1:] - true
    error = error.at[:, 2].set(wrap_angle(error[:, 2]))
    error = jnp.concatenate([jnp.zeros((1, 3)), jnp.where(episode.kidnapped[1:, None], 0.0, error)])
    return episode._replace(odometry=jnp.concatenate([episode.odometry, error], axis=-1))
