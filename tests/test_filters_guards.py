"""What filters do when there is nothing to go by: no trust, no weights, no evidence, hardly any particles."""

# ruff: noqa: F811

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dsom_jax import pose_grid as pg
from dsom_jax.filters.adam import AdamMCL
from dsom_jax.filters.adam_robust import RobustConfig
from dsom_jax.filters.updates import FilterConfig, masked_ancestors
from dsom_jax.occupancy import is_free
from dsom_jax.sensor import ScoreModel
from dsom_jax.types import Inputs
from filters_kit import (  # noqa: F401, fixtures
    FILTERS,
    LIDAR,
    MCL_ONLY,
    Spot,
    at,
    episode,
    everyone,
    follow,
    grid,
    in_spot,
    init,
    robust,
    spot,
    step,
    tiny_trust,
    world,
)


def test_nobody_to_be_trusted(world, spot, episode, grid):
    f = AdamMCL(world, spot, MCL_ONLY, t_cut=0.6)
    before = tiny_trust(grid, 64)
    after, info = step(f, jax.random.key(0), before, at(episode, 1))
    assert float(info.redrawn) == 1 and not bool(info.restarted) and in_spot(spot, after.poses).mean() > 0.95
    assert np.isin(np.asarray(after.weights), np.asarray(before.weights)).all()
    assert float(after.normalised.sum()) == pytest.approx(1.0, rel=1e-5)


def impossible(world):
    """A world whose weights vanish for every scan but the exact one."""
    return replace(world, sensor=ScoreModel(sigma=0.005, beta=0.0, range_max=LIDAR.range_max))


def nonsense(episode):
    return Inputs(jnp.full(LIDAR.beams, 1e4), episode.odometry[1], jnp.int32(1))


def test_vanished_weights_restart_from_the_proposal_and_say_so(world, spot, episode):
    f = AdamMCL(impossible(world), spot, MCL_ONLY)
    state, info = step(f, jax.random.key(0), init(f, jax.random.key(1)), nonsense(episode))
    assert bool(info.restarted) and in_spot(spot, state.poses).mean() > 0.95
    np.testing.assert_allclose(state.normalised, 1 / 64, rtol=1e-6)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((state, info)))


def test_a_restart_is_over_when_scans_make_sense_again(world, spot, episode):
    f = AdamMCL(impossible(world), spot, MCL_ONLY)
    state, info = step(f, jax.random.key(0), init(f, jax.random.key(1)), nonsense(episode))
    assert bool(info.restarted)
    f = replace(f, world=world)
    for t in (1, 2):
        state, info = step(f, jax.random.key(t), state, at(episode, t))
    assert not bool(info.restarted) and float(state.weights.sum()) > 0


def assert_sound(state, info, n):
    assert state.poses.shape == (n, 3)
    for leaf in jax.tree.leaves((state.poses, info)):
        assert np.isfinite(np.asarray(leaf, float)).all()
    assert 0 <= float(info.lost) <= 1 and 0 <= float(info.redrawn) <= 1
    weights = state.normalised if hasattr(state, "normalised") else jnp.exp(state.log_weights)
    assert float(weights.sum()) == pytest.approx(1.0, rel=1e-4)


@pytest.mark.parametrize("name", FILTERS)
def test_scans_without_evidence_break_nothing(name, world, spot, episode):
    f = everyone(world, spot, 64)[name]
    state = init(f, jax.random.key(0))
    for t, reading in enumerate([np.nan, -np.inf, np.inf, 0.0, 1e6, np.nan]):
        blind = Inputs(jnp.full(LIDAR.beams, reading), episode.odometry[1], jnp.int32(t))
        state, info = step(f, jax.random.key(t), state, blind)
        assert_sound(state, info, 64)
    state, info = step(f, jax.random.key(9), state, at(episode, 1))
    assert_sound(state, info, 64)


@pytest.mark.parametrize(("name", "n"), [("mcl", 2), ("mixture", 1), ("adam", 2), ("adam_robust", 1)])
def test_hardly_any_particles_and_no_key_is_used_twice(name, n, world, episode):
    f = everyone(world, world.space, n)[name]
    with jax.debug_key_reuse(True):
        for state, info in follow(f, episode, 4):
            assert_sound(state, info, n)


@pytest.mark.parametrize("name", FILTERS)
def test_an_update_keeps_the_types_of_the_state(name, world, spot, episode):
    f = everyone(world, spot, 8)[name]
    before = jax.eval_shape(f.init, jax.random.key(0))
    now = at(episode, 0)
    after, _ = jax.eval_shape(lambda key, state: f.step(key, state, now, spot.pm), jax.random.key(0), before)
    kinds = [[(v.shape, v.dtype, v.weak_type) for v in jax.tree.leaves(state)] for state in (before, after)]
    assert kinds[0] == kinds[1]


def test_a_pose_drawn_where_nobody_can_stand_weighs_nothing(world, spot, episode, grid):
    wall = np.asarray(spot.pm.mass).copy()
    wall[0, :, 3] = 1.0
    assert not np.asarray(grid.free)[0].any()
    f = robust(world, Spot(pg.probability_map(spot.pm.pose_grid, jnp.asarray(wall))), 200)
    blind = Inputs(jnp.full(LIDAR.beams, jnp.nan), jnp.zeros(3), jnp.int32(0))
    state, info = step(f, jax.random.key(0), init(f, jax.random.key(1)), blind)
    free = np.asarray(is_free(grid, state.poses))
    weights = np.exp(np.asarray(state.log_weights))
    assert 1 <= free.sum() < 40 and not weights[~free].any() and not bool(info.restarted)
    np.testing.assert_allclose(weights[free], 1 / free.sum(), rtol=1e-3)
    state, info = step(f, jax.random.key(2), state, at(episode, 1))
    assert_sound(state, info, 200)


@pytest.mark.parametrize("method", ["systematic", "multinomial"])
def test_members_whose_weights_all_vanish_are_drawn_evenly(method):
    """High powers of Eq 15 underflow for all of H while others, outside of it, still have weight."""
    member = jnp.arange(6) % 3 == 1
    weights = jnp.where(member, 0.0, 0.25)
    drawn = np.concatenate(
        [masked_ancestors(key, weights, member, method) for key in jax.random.split(jax.random.key(0), 50)]
    )
    assert set(drawn.tolist()) == {1, 4} and abs((drawn == 1).mean() - 0.5) < 0.12


def test_no_particles_are_refused():
    for config in (FilterConfig, RobustConfig):
        with pytest.raises(ValueError, match="at least one"):
            config(particles=0)
