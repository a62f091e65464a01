"""Filters against what is known exactly: the Bayes filter of a robot that is carried away, and a start at the truth."""

# ruff: noqa: F811

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dsom_jax import pose_grid as pg
from dsom_jax.filters.adam_robust import AdamRobust, RobustConfig
from dsom_jax.filters.common import ParticleState
from dsom_jax.filters.mcl import MCL
from dsom_jax.filters.updates import FilterConfig
from dsom_jax.raycast import cast_rays
from dsom_jax.sensor import beam_log_likelihood
from filters_kit import (  # noqa: F401, fixtures
    BEAM,
    LIDAR,
    STILL,
    Spot,
    at,
    episode,
    grid,
    init,
    step,
    world,
)
from reference import se2

SCANS = (0, 0, 9, 9)
EPS = 0.2
BROAD = replace(BEAM, temper=0.03)


def octants(grid, poses):
    """Which eighth of the room and of the circle: (n,) in 0..7."""
    x, y, theta = np.asarray(grid.to_grid(poses)).T
    return (x > 3.0) * 4 + (y > 2.5) * 2 + (theta > 0)


def exact_masses(world, grid, episode):
    """Posterior of the octants after each scan, by the definition of the filter on 40,000 points that do not move."""
    points, _ = world.space.sample(jax.random.key(7), None, 40_000)
    expected = jax.jit(cast_rays, static_argnums=2)(world.tables.map, points, LIDAR)
    uniform = np.full(len(points), 1 / len(points))
    belief, masses, where = None, [], octants(grid, points)
    for t in SCANS:
        prior = uniform if belief is None else (1 - EPS) * belief + EPS * uniform
        belief = prior * np.exp(np.asarray(beam_log_likelihood(episode.ranges[t], expected, BROAD), np.float64))
        belief /= belief.sum()
        masses.append(np.bincount(where, belief, minlength=8))
    return masses


def uneven(grid):
    """A proposal that prefers some free cells to others by up to ten times, for no reason."""
    mass = 10.0 ** np.random.default_rng(3).uniform(-1, 0, (*grid.shape, 8)) * np.asarray(grid.free)[..., None]
    return Spot(pg.probability_map(pg.over(grid, 8), jnp.asarray(mass, jnp.float32)))


@pytest.mark.parametrize("flatten", [0.0, 0.5])
def test_weights_of_robust_are_those_of_the_bayes_filter(world, grid, episode, flatten):
    config = RobustConfig(particles=20_000, kidnap=EPS, low_min=0.2, low_max=0.4, flatten=flatten, caution=0.0)
    robust = AdamRobust(replace(world, motion=STILL, sensor=BROAD), uneven(grid), config)
    state, variance = init(robust, jax.random.key(0)), 0.25 / 40_000
    for number, (t, exact) in enumerate(zip(SCANS, exact_masses(world, grid, episode), strict=True)):
        at_rest = at(episode, t)._replace(odometry=jnp.zeros(3))
        state, _ = step(robust, jax.random.key(number + 1), state, at_rest)
        weights = np.exp(np.asarray(state.log_weights, np.float64))
        variance += 0.25 * (weights**2).sum()  # of a share: each resampling adds its own
        masses = np.bincount(octants(grid, state.poses), weights, minlength=8)
        assert np.abs(masses - exact).max() < 4 * np.sqrt(variance) < 0.05
    assert np.ptp(exact) > 0.1  # the scans did say something


@pytest.mark.parametrize("injection", [0.0, 0.05])
def test_mcl_keeps_a_robot_whose_start_is_known(world, episode, injection):
    n = 400
    truth = np.asarray(episode.poses)
    poses = jnp.asarray(truth[0]) + 0.1 * jax.random.normal(jax.random.key(1), (n, 3))
    state = ParticleState(poses, jnp.ones(n), jnp.full((n,), 1 / n), jnp.int32(0))
    mcl = MCL(world, FilterConfig(n), injection=injection)
    for t in range(len(truth)):
        state, info = step(mcl, jax.random.key(t), state, at(episode, t))
        error = np.asarray(info.cluster) - truth[t]
        assert np.hypot(*error[:2]) < 0.35 and se2.angle_gap(*np.asarray([info.cluster, truth[t]])[:, 2]) < 0.2
