"""Likelihood and learning together: the likelihood grid's evidence times the probability map of DSOM."""

from __future__ import annotations

from dataclasses import dataclass, field

import jax
import jax.numpy as jnp

from dsom_jax import checks
from dsom_jax import pose_grid as pg
from dsom_jax.geometry import compose
from dsom_jax.proposals.dsom import DSOMProposal
from dsom_jax.proposals.likelihood_grid import LikelihoodGrid
from dsom_jax.types import Array, Inputs, Key


@dataclass(frozen=True)
class HybridConfig:
    """Weights of the logarithmic pool log PM = evidence * log L + network * log PM_DSOM (``experiments/dsom``).

    Attributes:
        evidence: exponent of the tempered likelihood.
        network: exponent of DSOM's probability.
        floor: share of DSOM's probability that is spread evenly, so that it cannot veto a place.
    """

    evidence: float = 0.3
    network: float = 1.5
    floor: float = 0.01

    def __post_init__(self) -> None:
        checks.not_negative(self, "evidence network")
        checks.share(self, "floor", excluding="()")


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Hybrid:
    """Proposal on the cells of a likelihood grid.

    Attributes:
        likelihood: training-free evidence.
        network: trained proposal on the same map.
        config: static.
    """

    likelihood: LikelihoodGrid
    network: DSOMProposal
    config: HybridConfig = field(default=HybridConfig(), metadata={"static": True})

    @property
    def free(self) -> Array:
        """(H, W) bool, cells of PM with free space."""
        return self.likelihood.free

    def begin(self) -> tuple[()]:
        """No memory: each scan is taken on its own."""
        return ()

    def prepare(self, memory: tuple[()], inputs: Inputs) -> tuple[pg.ProbabilityMap, tuple[()]]:
        """The pool of both for one scan (B,)."""
        evidence = self.config.evidence * self.likelihood.log_likelihood(inputs.ranges)
        learnt = self.config.network * self.log_network(inputs)
        return self.likelihood.probability_map(evidence + learnt), memory

    def log_network(self, inputs: Inputs) -> Array:
        """(C, K) of :func:`log_network` with this pool's floor."""
        return log_network(self.network, self.likelihood, inputs, self.config.floor)

    def sample(self, key: Key, prepared: pg.ProbabilityMap, n: int) -> tuple[Array, Array]:
        """``n`` base poses (n, 3) from PM and their log densities."""
        return self.likelihood.sample(key, prepared, n)


def log_network(network: DSOMProposal, likelihood: LikelihoodGrid, inputs: Inputs, floor: float) -> Array:
    """(C, K) log of DSOM's own probability (not sharpened), with its floor, at the cells of the likelihood grid."""
    theirs = network.pose_grid
    even = floor / jnp.maximum(network.free.sum() * theirs.headings, 1)
    log_pm = jnp.log((1 - floor) * pg.exp_or_zero(network.log_map(inputs)) + even)
    layers = jnp.moveaxis(log_pm, -1, 0).reshape(theirs.headings, -1)
    grid, x, y = likelihood.pose_grid, *likelihood.lidar.mount[:2]
    i, j = jnp.divmod(jnp.minimum(likelihood.cells, likelihood.free.size - 1), grid.width)

    def one_heading(k: Array) -> Array:
        sensor = pg.cell_pose(grid, i, j, jnp.broadcast_to(k, i.shape))
        return interpolate_headings(layers, theirs, compose(sensor, jnp.array([-x, -y, 0.0])))

    return jax.lax.map(one_heading, jnp.arange(grid.headings)).T


def interpolate_headings(layers: Array, grid: pg.PoseGrid, poses: Array) -> Array:
    """Values (C,) of ``layers`` (K, H * W) at poses (C, 3): nearest cell, linear between the two nearest headings."""
    i, j, k = pg.pose_cell(grid, poses)
    i, j = (jnp.clip(jnp.round(v), 0, n - 1).astype(jnp.int32) for v, n in ((i, grid.height), (j, grid.width)))
    low = jnp.floor(k).astype(jnp.int32)
    flat, share = i * grid.width + j, k - low
    return (1 - share) * layers[low % grid.headings, flat] + share * layers[(low + 1) % grid.headings, flat]
