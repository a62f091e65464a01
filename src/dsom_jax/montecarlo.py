"""Monte-Carlo runs of a filter over an episode: time scanned outside, runs mapped inside, one call on the device.

``filter`` is a pytree (a registered frozen dataclass): settings are static, maps and parameters are traced, so another
map of the same shape or another episode of the same length costs no compilation. Whatever a scan needs once
(:meth:`Filter.prepare`, a DSOM pass) is computed once per update and shared by all runs. Runs are spread over every
visible JAX device.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.sharding import AxisType, Mesh, NamedSharding
from jax.sharding import PartitionSpec as P

from dsom_jax.compiling import run_options
from dsom_jax.episode import Episode
from dsom_jax.types import Array, Filter, Inputs, Key


class Result(NamedTuple):
    """What R runs over T updates gave.

    Attributes:
        info: the filter's diagnostics, leaves (R, T, ...): at least ``mean``, ``cluster`` (R, T, 3), ``lost`` (R, T).
        state: the filter's state after the last update, leaves (R, ...).
        kept: states of run 0 after each of the K updates asked for, leaves (K, ...); None without any.
    """

    info: Any
    state: Any
    kept: Any


def run_keys(seed: int, episode: int, runs: int) -> Key:
    """(R,) keys that depend on (seed, episode, run) alone: methods are compared on the same luck."""
    root = jax.random.fold_in(jax.random.key(seed), episode)
    return jax.vmap(lambda r: jax.random.fold_in(root, r))(jnp.arange(runs))


def run(filter: Filter, episode: Episode, keys: Key, keep: Sequence[int] = ()) -> Result:
    """Run ``filter`` over ``episode`` once per key (R,); run r depends on ``keys[r]`` only, bit for bit.

    ``keep`` names updates after which the state of run 0 is kept, for a look at its particles. Not for use inside
    ``jit``: it places arrays on devices and chooses compiler options.
    """
    runs, mesh = keys.shape[0], _mesh()
    if runs < 1:
        raise ValueError("run: keys is empty, give at least one")
    # Devices take equal shares, so the last run is repeated to fill up and cut off again.
    filled = -(-runs // mesh.size) * mesh.size
    keys = jax.device_put(keys[jnp.minimum(jnp.arange(filled), runs - 1)], NamedSharding(mesh, P("runs")))
    chosen = jnp.asarray(keep, jnp.int32) if len(keep) else None
    shared = jax.device_put((filter, episode.inputs, chosen), NamedSharding(mesh, P()))
    info, state, kept = _runner(mesh)(*shared, keys)
    if filled > runs:
        info, state = jax.tree.map(lambda leaf: leaf[:runs], (info, state))
    return Result(info, state, jax.tree.map(lambda leaf: leaf[0], kept))


def signature(filter: Filter, episode: Episode) -> Any:
    """Hashable: two calls of :func:`run` with equal signatures and numbers of runs share one compilation."""
    leaves, structure = jax.tree.flatten((filter, episode))
    return structure, tuple((jnp.shape(leaf), jnp.result_type(leaf)) for leaf in leaves)


def start(filter: Filter, keys: Key) -> tuple[Any, Any]:
    """Memory, one for all runs, and states (R, ...) before the first update; keys (R,)."""
    return filter.begin(), jax.vmap(filter.init)(_fold(keys, 0))


def update(filter: Filter, keys: Key, memory: Any, states: Any, inputs: Inputs) -> tuple[Any, Any, Any]:
    """One update of R runs: memory, states (R, ...) and info (R, ...) after it; pure, what :func:`run` scans over.

    keys (R,) are those of the runs, the same at every update. To particles, an increment of the odometry that is not
    finite is none: one such would leave them without a pose for good.
    """
    prepared, memory = filter.prepare(memory, inputs)
    told = inputs._replace(odometry=jnp.where(jnp.isfinite(inputs.odometry).all(), inputs.odometry, 0.0))
    step_keys = _fold(keys, inputs.index + 1)
    states, info = jax.vmap(lambda key, state: filter.step(key, state, told, prepared))(step_keys, states)
    return memory, states, info


def simulate(filter: Filter, inputs: Inputs, keep: Array | None, keys: Key) -> tuple[Any, Any, Any]:
    """The pure computation of one device: info (R, T, ...), state (R, ...), kept (1, K, ...).

    inputs (T, ...), keys (R,); ``keep`` (K,) are updates, or None.
    """

    def one(carry: tuple[Any, Any], now: Inputs) -> tuple[Any, Any]:
        memory, states, info = update(filter, keys, *carry, now)
        return (memory, states), (info, None if keep is None else jax.tree.map(lambda leaf: leaf[0], states))

    (_, states), (info, shown) = jax.lax.scan(one, start(filter, keys), inputs)
    by_run = jax.tree.map(lambda leaf: jnp.moveaxis(leaf, 0, 1), info)
    return by_run, states, jax.tree.map(lambda leaf: leaf[keep][None], shown)


def _fold(keys: Key, number: Array | int) -> Key:
    """The keys of one update: 0 is the start, t + 1 is update t."""
    return jax.vmap(lambda key: jax.random.fold_in(key, number))(keys)


def _mesh() -> Mesh:
    return jax.make_mesh((jax.device_count(),), ("runs",), axis_types=(AxisType.Auto,))


@cache
def _runner(mesh: Mesh) -> Any:
    """The compiled :func:`simulate`, each device with its own share of the runs and no talk between them."""
    spread = jax.shard_map(
        simulate, mesh=mesh, in_specs=(P(), P(), P(), P("runs")), out_specs=P("runs"), check_vma=False
    )
    return jax.jit(spread, compiler_options=run_options())
