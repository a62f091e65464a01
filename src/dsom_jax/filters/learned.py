"""What PF-Net and PFRNN share as filters: a trained network on one map, and where their particles start."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import nnx
from jax.custom_batching import sequential_vmap

from dsom_jax.filters.common import Info, describe
from dsom_jax.geometry import compose
from dsom_jax.lidar import LidarConfig
from dsom_jax.nn.local_view import CornerMap, corner_map, map_for
from dsom_jax.nn.view_net import ScanCode
from dsom_jax.occupancy import OccupancyGrid
from dsom_jax.proposals.uniform import FreeSpace, free_space
from dsom_jax.types import Array, Inputs, Key


class Prior(NamedTuple):
    """A robot that is roughly known: Gaussian about ``mean`` (3,), in its own frame, with deviations ``std`` (3,)."""

    mean: Array
    std: Array


@dataclass(frozen=True)
class Learned:
    """A network that weighs particles on one map; what is derived from it has ``advance``, a differentiable update.

    Attributes:
        weights: parameters of the network.
        place: the map that is cropped.
        space: uniform distribution over its free poses.
        prior: where the particles start; None: anywhere in free space.
        graph: structure of the network (static).
        lidar: beams that are used (static); every ``beam_step``-th of the scan (static).
        particles: N (static).
    """

    weights: Any
    place: CornerMap
    space: FreeSpace
    prior: Prior | None
    graph: Any = field(metadata={"static": True})
    lidar: LidarConfig = field(metadata={"static": True})
    beam_step: int = field(metadata={"static": True})
    particles: int = field(metadata={"static": True})

    def network(self) -> Any:
        """The network with its weights."""
        return nnx.merge(self.graph, self.weights)

    def begin(self) -> tuple[()]:
        """No memory: each scan is taken on its own."""
        return ()

    def prepare(self, memory: tuple[()], inputs: Inputs) -> tuple[ScanCode, tuple[()]]:
        """Reading of the scan, for all particles of all runs."""
        return self.network().observation.scan_code(inputs.ranges[:: self.beam_step], self.lidar), memory

    def first_poses(self, key: Key) -> Array:
        """(N, 3) from the prior, or uniform over free space."""
        if self.prior is None:
            return self.space.sample(key, None, self.particles)[0]
        return scatter(key, self.prior, self.particles)

    def step(self, key: Key, state: Any, inputs: Inputs, prepared: ScanCode) -> tuple[Any, Info]:
        """One update and its diagnostics; these filters neither redraw particles nor start again.

        Runs are computed one after the other, as the results of one fit the cache and those of all do not. Each then
        also gets the same bits whatever is computed beside it; the barriers keep a run whose loop vanishes, because
        it is the only one, from being fused with its surroundings and rounded in another way.
        """
        return _one_run(self, key, state, inputs, prepared)


@sequential_vmap  # type: ignore[untyped-decorator]  # as JAX has it
def _one_run(filter: Any, key: Key, state: Any, inputs: Inputs, prepared: ScanCode) -> tuple[Any, Info]:
    key, state, inputs, prepared = jax.lax.optimization_barrier((key, state, inputs, prepared))
    state = jax.lax.optimization_barrier(filter.advance(key, state, inputs, prepared))
    info = describe(state.poses, jnp.exp(state.log_weights), jnp.float32(0), jnp.bool_(False))
    return jax.lax.optimization_barrier((state, info))


def scatter(key: Key, prior: Prior, n: int) -> Array:
    """(n, 3) poses of a prior."""
    return compose(prior.mean, prior.std * jax.random.normal(key, (n, 3)))


def bind(kind: Any, model: Any, grid: OccupancyGrid, lidar: LidarConfig, particles: int, prior: Prior | None) -> Any:
    """Filter of class ``kind`` with a trained ``model`` on a map, resampled to the network's scale."""
    view = model.config.view
    graph, weights = nnx.split(model)
    step = view.beam_step(lidar)
    place = corner_map(map_for(grid, view))
    return kind(nnx.as_pure(weights), place, free_space(grid), prior, graph, lidar.every(step), step, particles)


def even_log_weights(n: int) -> Array:
    """(n,) log weights of particles that are all the same."""
    return jnp.full((n,), -jnp.log(n), jnp.float32)
