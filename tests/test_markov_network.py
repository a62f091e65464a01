"""A memory of what the network says: its maps multiplied along the drive, and the filters that draw from it."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import tiny_world
from dsom_jax import pose_grid as pg
from dsom_jax.filters.adam import AdamMCL
from dsom_jax.filters.adam_memory import AdamMemory
from dsom_jax.filters.methods import STANDARD, build_filter, make_filter, network_of
from dsom_jax.filters.settings import Settings
from dsom_jax.geometry import wrap_angle
from dsom_jax.montecarlo import run, run_keys
from dsom_jax.proposals.hybrid import Hybrid, HybridConfig
from dsom_jax.proposals.likelihood_grid import likelihood_grid
from dsom_jax.proposals.markov_grid import MarkovGrid, MarkovGridConfig
from dsom_jax.proposals.markov_network import MarkovNetwork, MarkovNetworkConfig
from dsom_jax.types import Array, Inputs
from filters_kit import GRID, LIDAR, decided_network

MOUNTED = replace(LIDAR, mount=(-0.6, 0.4, 0.5))


@pytest.fixture(scope="module")
def parts():
    return likelihood_grid(tiny_world.grid(), LIDAR, GRID), decided_network()


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Oracle:
    """A network that is told where the base is: in coarser cells and headings than those of the likelihood grid."""

    pose_grid: pg.PoseGrid
    free: Array
    poses: Array

    def log_map(self, inputs: Inputs) -> Array:
        i, j, k = (jnp.round(v).astype(jnp.int32) for v in pg.pose_cell(self.pose_grid, self.poses[inputs.index]))
        even = jnp.full(self.pose_grid.shape, math.log(0.1 / math.prod(self.pose_grid.shape)))
        return even.at[i, j, k % self.pose_grid.headings].set(math.log(0.9))


@pytest.mark.parametrize("lidar", [LIDAR, MOUNTED], ids=["centred", "mounted"])
def test_a_filter_goes_where_only_the_network_says(lidar):
    """All beams are invalid: what is found, the memory of the network has found, wherever the lidar is mounted."""
    grid, episode = tiny_world.grid(), tiny_world.drive()
    cells = pg.PoseGrid(grid.origin, 10, 12, 8, 0.5)
    oracle = Oracle(cells, jnp.ones((10, 12), bool), episode.poses)
    memory = MarkovNetwork(likelihood_grid(grid, lidar, GRID), network=oracle, worth=MarkovNetworkConfig(power=1.0))
    filter = make_filter("adam_robust", memory, grid, lidar, Settings(particles=200))
    assert isinstance(filter, AdamMemory)
    blind = episode._replace(ranges=jnp.full_like(episode.ranges, jnp.nan))
    found = np.asarray(run(filter, blind, run_keys(0, 0, 4)).info.cluster)[:, -1]
    off = found - np.asarray(episode.poses)[-1]
    # Half a cell of the oracle and half a cell of the likelihood grid: half diagonals, and half bins.
    assert (np.hypot(off[:, 0], off[:, 1]) < (0.5 + 0.25) / math.sqrt(2)).all()
    assert (np.abs(wrap_angle(off[:, 2])) < (math.tau / 8 + math.tau / 16) / 2).all()
    assert math.hypot(*MOUNTED.mount[:2]) > (0.5 + 0.25) / math.sqrt(2), "a lidar taken for the base would be seen"


@pytest.mark.parametrize("algorithm", ["adam", "adam_robust"])
def test_with_a_network_that_counts_for_nothing_it_is_grid_localization(parts, algorithm):
    """1e-12 of log PM vanishes in the rounding of the log-likelihood: run by run what MarkovGrid gives."""
    likelihood, network = parts
    worth = MarkovNetworkConfig(power=1e-12, temper=0.1)
    memories = MarkovNetwork(likelihood, network=network, worth=worth), MarkovGrid(likelihood.tempered(0.1))
    settings = Settings(particles=60, memory_share=(0.5, 0.5))
    found = []
    for memory in (*memories, replace(memories[0], worth=replace(worth, power=3.0))):
        filter = make_filter(algorithm, memory, tiny_world.grid(), LIDAR, settings)
        found.append(np.asarray(run(filter, tiny_world.drive(6), run_keys(0, 0, 3)).info.mean))
    np.testing.assert_allclose(found[0], found[1], atol=1e-3)
    assert np.abs(found[2] - found[1]).max() > 0.01


@pytest.mark.parametrize("temper", [0.0, 0.1])
def test_a_memory_of_the_network_multiplies_its_maps_along_the_drive(parts, temper):
    """A robot that stands still and sees two scans: PM of both, each to the power, times each other."""
    still = MarkovGridConfig(kidnap=1e-12, slip=0.0)
    worth = MarkovNetworkConfig(power=0.4, temper=temper, floor=0.02)
    memory = MarkovNetwork(parts[0], still, network=parts[1], worth=worth)
    scans = [Inputs(tiny_world.drive().ranges[t], jnp.full(3, jnp.nan), jnp.int32(n)) for n, t in enumerate((3, 9))]
    belief, expected = memory.begin(), 1.0
    for scan in scans:
        prepared, belief = memory.prepare(belief, scan)
        log_pm = Hybrid(*parts, HybridConfig(floor=0.02)).log_network(scan)
        # The parts' own temper is 0.5.
        log_likelihood = temper / 0.5 * np.asarray(parts[0].log_likelihood(scan.ranges), np.float64)
        expected = expected * np.exp(0.4 * np.asarray(log_pm, np.float64) + log_likelihood)
    expected = np.where(np.asarray(memory.begin()) > 0, expected, 0.0)
    np.testing.assert_allclose(belief, expected / expected.sum(), rtol=1e-3, atol=1e-9)
    poses, log_density = memory.sample(jax.random.key(0), prepared, 50)
    np.testing.assert_allclose(memory.likelihood.log_density(prepared.posterior, poses), log_density, rtol=1e-4)


def test_filters_that_remember_what_the_network_said_are_offered(parts):
    made = {"likelihood_grid": parts[0], "dsom": parts[1]}
    for source, worth in (("dsom", Settings().markov_dsom), ("hybrid", Settings().markov_hybrid)):
        for algorithm, kind in (("adam", AdamMCL), ("robust", AdamMemory)):
            name = f"{algorithm}_markov_{source}"
            assert network_of(name) == "dsom" and name not in STANDARD
            built = build_filter(name, tiny_world.grid(), LIDAR, particles=20, t_cut=0.6, sources=made)
            assert isinstance(built, kind) and isinstance(built.proposal, MarkovNetwork)
            assert built.proposal.worth == worth
    assert built.share == Settings().network_share
