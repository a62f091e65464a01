"""What the tests of filters share: a small world, a proposal that points at one cell, compiled steps."""

from __future__ import annotations

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import tiny_world
from dsom_jax import pose_grid as pg
from dsom_jax.filters.adam import AdamMCL
from dsom_jax.filters.adam_robust import AdamRobust, RobustConfig
from dsom_jax.filters.common import ParticleState
from dsom_jax.filters.mcl import MCL
from dsom_jax.filters.mixture import MixtureMCL
from dsom_jax.filters.updates import FilterConfig
from dsom_jax.filters.world import World
from dsom_jax.motion import OdometryMotion
from dsom_jax.nn import DSOMConfig, create, evaluation_view
from dsom_jax.proposals.dsom import DSOMProposal, dsom
from dsom_jax.proposals.likelihood_grid import LikelihoodGridConfig
from dsom_jax.proposals.uniform import free_space
from dsom_jax.raycast import RaycastConfig, make_tables
from dsom_jax.sensor import BeamModel, RayTables, ScoreModel
from dsom_jax.types import prepare_alone

LIDAR = tiny_world.LIDAR
STILL = OdometryMotion(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
SCORE = ScoreModel(sigma=0.4, range_max=LIDAR.range_max)
BEAM = BeamModel(sigma_hit=0.2, temper=0.5, range_max=LIDAR.range_max)
GRID = LikelihoodGridConfig(resolution=0.25, headings=16, angles_per_heading=2, beams=32, model=BEAM)
MCL_ONLY = FilterConfig(64)
NETWORK = DSOMConfig(width=2, headings=8, channels=2, resolution=0.25, range_max=8.0, reach_min=1.0, fov_min=0.1)


def decided_network() -> DSOMProposal:
    """An untrained DSOM on the small world, sharpened: as it is created it says nearly the same of all places."""
    model = create(NETWORK, seed=3)
    model.decoder.head.kernel[...] = model.decoder.head.kernel[...] * 300
    return dsom(evaluation_view(model), tiny_world.grid(), LIDAR)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Spot:
    """A proposal that always points at the same cell, whatever the scan."""

    pm: pg.ProbabilityMap

    def begin(self):
        return ()

    def prepare(self, memory, inputs):
        return self.pm, memory

    def sample(self, key, prepared, n):
        return pg.sample(key, prepared, n)


@pytest.fixture(scope="module")
def grid():
    return tiny_world.grid()


@pytest.fixture(scope="module")
def world(grid):
    tables = make_tables(grid, RaycastConfig("table", angles=72), LIDAR.range_max)
    return World(grid, free_space(grid), RayTables(tables, LIDAR), 1, OdometryMotion(), SCORE)


@pytest.fixture(scope="module")
def spot(grid):
    mass = np.zeros((20, 24, 8), np.float32)
    mass[16, 2, 3] = 1.0  # a corner where the robot is not
    return Spot(pg.probability_map(pg.over(grid, 8), jnp.asarray(mass)))


@pytest.fixture(scope="module")
def episode():
    return tiny_world.drive()


compiled_init = jax.jit(lambda f, key: f.init(key))
compiled_step = jax.jit(lambda f, key, state, inputs: f.step(key, state, inputs, prepare_alone(f, inputs)))


def init(f, key):
    """The filter's own start; all Score-weighted filters share one, and one compilation."""
    return compiled_init(MCL(f.world, f.config, injection=0.0) if isinstance(f.config, FilterConfig) else f, key)


def step(f, key, state, inputs):
    """One update; numpy arrays have no weak types, which would cost another compilation."""
    return compiled_step(f, key, *jax.tree.map(np.asarray, (state, inputs)))


def at(episode, t):
    return jax.tree.map(lambda leaf: leaf[t], episode.inputs)


def follow(f, episode, steps, seed=0):
    """States and diagnostics after each of the first updates."""
    keys = jax.random.split(jax.random.key(seed), steps + 1)
    state, passed = init(f, keys[0]), []
    for t in range(steps):
        state, info = step(f, keys[t + 1], state, at(episode, t))
        passed.append((state, info))
    return passed


def in_spot(spot, poses):
    return np.isfinite(np.asarray(pg.log_density(spot.pm, poses)))


def robust(world, proposal, particles=200, **fields):
    return AdamRobust(replace(world, sensor=BEAM), proposal, RobustConfig(particles=particles, **fields))


def everyone(world, proposal, n):
    config = FilterConfig(n)
    return {
        "mcl": MCL(world, config),
        "mixture": MixtureMCL(world, proposal, config, p=0.5),
        "adam": AdamMCL(world, proposal, config),
        "adam_robust": robust(world, proposal, n),
    }


FILTERS = ["mcl", "mixture", "adam", "adam_robust"]


def tiny_trust(grid, n, seed=0):
    """Particles that are all redrawn, each with a weight of its own."""
    poses, _ = free_space(grid).sample(jax.random.key(seed), None, n)
    weights = 1e-12 * (1.0 + jnp.arange(n))
    return ParticleState(poses, weights, weights / weights.sum(), jnp.int32(3))
