"""How well a filter in training tracks: drives that it does not see, from roughly known starts."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from dsom_jax.compiling import training_options
from dsom_jax.geometry import mean_pose, wrap_angle
from dsom_jax.nn.local_view import CornerMap
from dsom_jax.occupancy import OccupancyGrid
from dsom_jax.training.filter_loop import FilterTrainConfig, follow, graph_of, stack_maps
from dsom_jax.training.sequences import Window, make_windows, plan_paths
from dsom_jax.types import Array, Key

_START = 0.3, math.radians(10)
"""Scatter of the particles at the start, metres and radians."""
_CLOSE = 0.5
"""Metres within which a sequence counts as tracked to its end."""


def tracking_config(config: FilterTrainConfig, sequences: int) -> FilterTrainConfig:
    """Longer sequences from a known start, on other paths, with as much unknown as in the suite."""
    length = min(40, config.data.length)
    data = replace(config.data, drives=sequences, window=length, obstacles=8, removed=2, noise=0.03, dropout=0.0)
    changes: dict[str, Any] = {"start_xy": (_START[0],) * 2, "start_theta": (_START[1],) * 2, "strays": 0.0}
    return replace(config, data=replace(data, short=0.0), particles=100, **changes)


def errors(params: Any, graph: Any, config: FilterTrainConfig, places: CornerMap, key: Key, window: Window) -> Array:
    """Errors (L, 2) of the weighted mean of one sequence, metres and radians."""
    states = follow(params, graph, config, places, key, window)
    mean = mean_pose(states.poses, jnp.exp(states.log_weights))
    distance = jnp.hypot(*(mean - window.poses)[:, :2].T)
    return jnp.stack([distance, jnp.abs(wrap_angle(mean - window.poses)[:, 2])], axis=-1)


def make_tracking(
    config: FilterTrainConfig, grids: list[OccupancyGrid], sequences: int = 32
) -> Callable[[Any], dict[str, float]]:
    """Compiled tracking of fixed sequences by a network."""
    config = tracking_config(config, sequences)
    pool = plan_paths(config.seed + 10_000, grids, config.data)
    places, keys = stack_maps(pool, grids[0].resolution), jax.random.split(jax.random.key(config.seed + 3), sequences)
    make = partial(make_windows, pool=pool, config=config.data, resolution=grids[0].resolution)
    windows = jax.jit(partial(make, count=sequences, strays=config.particles))(keys[0])
    one = partial(errors, graph=graph_of(config), config=config, places=places)

    @partial(jax.jit, compiler_options=training_options())
    def track(params: Any) -> Array:
        return jax.lax.map(lambda part: one(params, key=part[0], window=part[1]), (keys, windows))

    return lambda model: tracked(track(nnx.as_pure(nnx.split(model)[1])))


def tracked(error: Array) -> dict[str, float]:
    """Numbers over sequences: errors (S, L, 2) in metres and radians."""
    distance, turn = np.moveaxis(np.asarray(error, np.float64), -1, 0)
    return {
        "sequences": len(distance),
        "updates": distance.shape[1],
        "tracked": float((distance[:, -1] < _CLOSE).mean()),
        "e_pos_m": float(np.median(distance[:, -1])),
        "e_theta_rad": float(np.median(turn[:, -1])),
    }
