"""The update of ``montecarlo.run`` for one robot, as functions to be compiled once."""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from dsom_jax import montecarlo
from dsom_jax.geometry import pose_covariance
from dsom_jax.types import Array, Filter, Inputs, Key


def one_update(
    filter: Filter, keys: Key, memory: Any, states: Any, inputs: Inputs, once: Array
) -> tuple[Any, Any, Any]:
    """One update of one run: memory, states (1, ...), and (info, covariance (3, 3)) without the axis of runs.

    ``once`` () is 1, which XLA must not know: a loop that is not unrolled is compiled as that of ``montecarlo.run``,
    and rounds as it does.
    """
    told = jax.eval_shape(montecarlo.update, filter, keys, memory, states, inputs)[2]
    rows = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), inputs)
    infos = jax.tree.map(lambda leaf: jnp.zeros((2, *leaf.shape), leaf.dtype), told)

    def update(carry: tuple[Array, Any, Any, Any]) -> tuple[Array, Any, Any, Any]:
        n, memory, states, infos = carry
        now = jax.tree.map(lambda leaf: jax.lax.dynamic_index_in_dim(leaf, n, keepdims=False), rows)
        memory, states, info = montecarlo.update(filter, keys, memory, states, now)
        put = partial(jax.lax.dynamic_update_index_in_dim, index=n, axis=0)
        return n + 1, memory, states, jax.tree.map(put, infos, info)

    start = (jnp.int32(0), memory, states, infos)
    _, memory, states, infos = jax.lax.while_loop(lambda carry: carry[0] < once, update, start)
    info = jax.tree.map(lambda leaf: leaf[0, 0], infos)
    poses, weights = particles_of(states)
    return memory, states, (info, pose_covariance(poses[0], weights[0], info.cluster))


def around(filter: Any, keys: Key, pose: Array, covariance: Array) -> tuple[Any, Any, Array]:
    """Memory and states (1, ...) about a pose, and the share of it that lies on free space."""
    place = partial(filter.around, pose=pose, covariance=covariance)
    first = jax.vmap(lambda key: jax.random.fold_in(key, 0))(keys)  # later updates fold in their own numbers
    memory, states, free = jax.vmap(place, out_axes=(None, 0, 0))(first)
    return memory, states, free[0]


def inner(watched: Any, part: str) -> Any:
    """What a :class:`dsom_jax.belief.watched.Watched` watches, or its state; other filters are their own."""
    return getattr(watched, part, watched)


def keys_of(root: Key, number: Array) -> Key:
    """(1,) keys of a start."""
    return jax.vmap(lambda key: jax.random.fold_in(key, number))(root)


def particles_of(states: Any) -> tuple[Array, Array]:
    """Poses (1, N, 3) and weights (1, N) of any filter's states."""
    states = inner(states, "state")
    if hasattr(states, "log_weights"):
        return states.poses, jax.nn.softmax(states.log_weights, axis=-1)
    return states.poses, states.normalised
