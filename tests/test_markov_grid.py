"""The likelihood grid with a memory: its motion against a slow reference, Bayes' rule, and its filter."""

from __future__ import annotations

import math
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import tiny_world
from dsom_jax.belief.grid_memory import GridBeliefConfig
from dsom_jax.filters.adam import AdamMCL
from dsom_jax.filters.adam_memory import AdamMemory, AdamPlaces
from dsom_jax.filters.adam_robust import AdamRobust, RobustConfig, RobustState
from dsom_jax.filters.methods import build_filter, make_filter, remembering
from dsom_jax.filters.settings import Settings
from dsom_jax.filters.world import World
from dsom_jax.geometry import compose, inverse, wrap_angle
from dsom_jax.montecarlo import run, run_keys
from dsom_jax.motion import OdometryMotion
from dsom_jax.occupancy import from_cells
from dsom_jax.plotting import maps
from dsom_jax.pose_grid import cell_pose, pose_cell
from dsom_jax.proposals.likelihood_grid import LikelihoodGridConfig, likelihood_grid
from dsom_jax.proposals.markov_grid import MarkovGrid, MarkovGridConfig
from dsom_jax.proposals.uniform import free_space
from dsom_jax.raycast import RaycastConfig
from dsom_jax.types import Inputs, prepare_alone
from filters_kit import BEAM, GRID, LIDAR
from reference import markov

ROOM = np.ones((7, 9), bool)
ROOM[1:6, 1:8] = False
ROOM[2, 4] = True
SMALL = LikelihoodGridConfig(resolution=0.5, headings=8, angles_per_heading=2, beams=8, model=BEAM)


@pytest.fixture(scope="module")
def room():
    """Grid with memory of a room of 7 x 9 cells of 0.5 m with a pillar, turned by 0.4 rad."""
    grid = from_cells(ROOM, resolution=0.5, origin=(3.0, -1.0, 0.4))
    return MarkovGrid(likelihood_grid(grid, LIDAR, SMALL), MarkovGridConfig(kidnap=1e-4, slip=0.2))


@pytest.fixture(scope="module")
def memory():
    return MarkovGrid(likelihood_grid(tiny_world.grid(), LIDAR, GRID))


def dense(markov_grid, belief):
    """(C, K) at the free cells -> (H, W, K)."""
    likelihood = markov_grid.likelihood
    full = np.zeros((likelihood.free.size + 1, likelihood.config.headings))
    full[np.asarray(likelihood.cells)] = np.asarray(belief)
    return full[:-1].reshape(likelihood.pose_grid.shape)


@pytest.mark.parametrize("odometry", [(0.7, 0.0, 0.0), (0.33, -0.2, 0.9), (-0.6, 0.1, -2.5), (0.0, 0.0, math.pi)])
def test_motion_against_the_slow_reference(room, odometry):
    rng = np.random.default_rng(1)
    belief = np.asarray(room.begin()) * rng.random(room.begin().shape)
    moved = dense(room, room.predict(jnp.asarray(belief, jnp.float32), jnp.asarray(odometry, jnp.float32)))
    expected = markov.predict(dense(room, belief), ~ROOM, odometry, 0.5, slip=0.2)
    # Sums of some 30 products of float32 numbers, each with a relative error of 1e-7 times a few.
    np.testing.assert_allclose(moved, expected, rtol=2e-5, atol=1e-6 * expected.max())


def test_a_certain_robot_in_the_open_drives_where_its_odometry_says(memory):
    grid = memory.likelihood.pose_grid
    belief = np.zeros(memory.begin().shape, np.float32)
    start = list(np.asarray(memory.likelihood.cells)).index(8 * grid.width + 12)
    belief[start, 12] = 1.0  # heading -pi + 12 * 2 pi / 16 = pi / 2: up the rows
    still = replace(memory, config=MarkovGridConfig(slip=0.0))
    moved = dense(memory, still.predict(jnp.asarray(belief), jnp.array([0.6, 0.0, 0.0])))
    i, j, k = (np.average(np.arange(n), weights=moved.sum(axes)) for n, axes in
               zip(moved.shape, [(1, 2), (0, 2), (0, 1)], strict=True))  # fmt: skip
    # Quadratic B-splines reproduce straight lines: the mean is exact.
    np.testing.assert_allclose([i, j, k], [8 + 0.6 / 0.25, 12, 12], atol=1e-4)
    rows = moved.sum((1, 2))
    assert np.average((np.arange(len(rows)) - i) ** 2, weights=rows) == pytest.approx(0.25, abs=1e-4)
    assert moved.sum() == pytest.approx(1.0, abs=1e-5)


@pytest.mark.parametrize("mount", [(0.0, 0.0, 0.0), (0.4, -0.2, 1.0)])
def test_a_turning_robot_goes_where_compose_says(mount):
    grid = from_cells(np.zeros((16, 16), bool), resolution=0.5, origin=(3.0, -1.0, 0.4))
    likelihood = likelihood_grid(grid, replace(LIDAR, mount=mount), SMALL)
    still = MarkovGrid(likelihood, MarkovGridConfig(slip=0.0))
    belief = np.zeros(still.begin().shape, np.float32)
    belief[8 * 16 + 7, 5] = 1.0
    odometry, sensor = jnp.array([0.8, -0.3, 0.9]), jnp.array([*mount[:2], 0.0])
    start = cell_pose(likelihood.pose_grid, jnp.array(8.0), jnp.array(7.0), jnp.array(5.0))
    base = compose(compose(start, inverse(sensor)), odometry)
    expected = pose_cell(likelihood.pose_grid, compose(base, sensor))
    moved = dense(still, still.predict(jnp.asarray(belief), odometry))
    i, j, k = (np.average(np.arange(n), weights=moved.sum(axes)) for n, axes in
               zip(moved.shape, [(1, 2), (0, 2), (0, 1)], strict=True))  # fmt: skip
    np.testing.assert_allclose([i, j, k], expected, atol=1e-4)


@pytest.mark.parametrize("odometry", [(1.0, 0.0, 0.0), (-0.8, 0.6, 0.7)])
def test_no_belief_comes_in_where_a_map_ends_in_free_space(odometry):
    open_space = np.zeros((7, 9), bool)
    grid = from_cells(open_space, resolution=0.5)
    memory = MarkovGrid(likelihood_grid(grid, LIDAR, SMALL), MarkovGridConfig(slip=0.2))
    belief, expected = memory.begin(), dense(memory, memory.begin())
    for _ in range(2):
        belief = memory.predict(belief, jnp.asarray(odometry, jnp.float32))
        expected = markov.predict(expected, ~open_space, odometry, 0.5, slip=0.2)
    np.testing.assert_allclose(dense(memory, belief), expected, rtol=2e-5, atol=1e-6 * expected.max())
    assert float(belief.sum()) == pytest.approx(expected.sum(), rel=1e-5)


def test_an_update_is_bayes_rule(room):
    inputs = Inputs(jnp.full(LIDAR.beams, 1.1), jnp.array([0.3, 0.0, 0.2]), jnp.int32(4))
    rng = np.random.default_rng(0)
    before = np.asarray(room.begin()) * rng.random(room.begin().shape)
    before /= before.sum()
    recollection, after = room.prepare(jnp.asarray(before, jnp.float32), inputs)
    moved = dense(room, room.predict(jnp.asarray(before, jnp.float32), inputs.odometry)).astype(np.float64)
    prior = (1 - 1e-4) * moved / moved.sum() + 1e-4 * dense(room, room.begin())
    likelihood = np.exp(dense(room, room.likelihood.log_likelihood(inputs.ranges)))
    posterior = prior * likelihood
    np.testing.assert_allclose(dense(room, after), posterior / posterior.sum(), rtol=1e-3, atol=1e-8)
    for pm, mass in zip(recollection, (prior, posterior), strict=True):
        np.testing.assert_allclose(
            np.asarray(pm.mass) / float(pm.cumulative[-1]), mass / mass.sum(), rtol=1e-3, atol=1e-8
        )


def test_the_first_scan_is_that_of_the_likelihood_grid(memory):
    first = jax.tree.map(lambda leaf: leaf[0], tiny_world.drive().inputs)
    plain = prepare_alone(memory.likelihood, first)
    belief = prepare_alone(memory, first).posterior
    np.testing.assert_allclose(belief.mass / belief.cumulative[-1], plain.mass / plain.cumulative[-1], atol=1e-7)
    # Whatever its number, and the way that is said to lie behind: nothing is known of where it began.
    late = prepare_alone(memory, first._replace(index=jnp.int32(7), odometry=jnp.array([2.0, 0.0, 1.0]))).posterior
    np.testing.assert_array_equal(late.mass, belief.mass)


def test_log_prior_is_the_density_of_the_belief_before_the_scan(memory):
    first = jax.tree.map(lambda leaf: leaf[0], tiny_world.drive().inputs)
    prepared = prepare_alone(memory, first)
    poses, _ = memory.sample(jax.random.key(0), prepared, 50)
    space = free_space(tiny_world.grid())
    np.testing.assert_allclose(memory.log_prior(prepared, poses), space.log_density_value, atol=1e-4)


@pytest.fixture(scope="module")
def filters(memory):
    grid = tiny_world.grid()
    world = World.on(grid, LIDAR, OdometryMotion(), BEAM, RaycastConfig("table", angles=72))
    config = RobustConfig(particles=150)
    return AdamMemory(world, memory, config), AdamRobust(world, memory.likelihood, config)


def test_the_first_update_is_that_of_adam_robust(filters):
    episode = tiny_world.drive()
    first = jax.tree.map(lambda leaf: leaf[:1], episode)
    with_memory, without = (run(f, first, run_keys(0, 0, 3)) for f in filters)
    np.testing.assert_allclose(with_memory.state.poses, without.state.poses, atol=1e-4)
    np.testing.assert_allclose(with_memory.state.log_weights, without.state.log_weights, atol=2e-3)


def test_shares_of_grid_and_particles(filters):
    """Weights of particles and of the grid's poses in an update without evidence: 1 - a and a, by Bayes' rule."""
    blind = Inputs(jnp.full(LIDAR.beams, jnp.nan), jnp.zeros(3), jnp.int32(0))
    step = jax.jit(lambda f, key, state, prepared: f.step(key, state, blind, prepared)[0])
    prepared, belief = filters[0].prepare(filters[0].begin(), blind)
    poses, _ = filters[0].world.space.sample(jax.random.key(1), None, 150)
    state = RobustState(poses, jnp.full(150, -math.log(150)), jnp.float32(0.5), jnp.int32(2))
    masses = {}
    for share in (0.5, 0.1):
        after = step(replace(filters[0], share=(share, share)), jax.random.key(0), state, prepared)
        # The first half is redrawn, as the filter is lost by half.
        masses[share] = float(jnp.exp(after.log_weights)[:75].sum())
    # Both halves stand for the same uniform belief; some kept particles drift into walls but still weigh.
    assert masses == {share: pytest.approx(share, abs=0.02) for share in masses}
    assert float(belief.sum()) == pytest.approx(1.0, abs=1e-5)


def test_it_finds_the_robot_keeps_it_and_run_r_is_the_same_in_any_batch(filters):
    episode = tiny_world.drive()
    keys = run_keys(3, 0, 6)
    info = run(filters[0], episode, keys).info
    # With one other: XLA rounds a batch of one differently.
    apart = run(filters[0], episode, keys[4:6]).info
    np.testing.assert_array_equal(np.asarray(info.cluster)[4:6], np.asarray(apart.cluster))
    off = np.asarray(info.cluster) - np.asarray(episode.poses)
    near = (np.hypot(off[..., 0], off[..., 1]) < 0.5) & (np.abs(wrap_angle(off[..., 2])) < math.radians(10))
    assert near[:, -5:].all()


@pytest.mark.parametrize("field", ["kidnap", "slip"])
def test_shares_are_checked(field):
    with pytest.raises(ValueError, match=field):
        MarkovGridConfig(**{field: 1.5})


@pytest.mark.parametrize("share", [(0.0, 0.5), (0.1, 1.0), (0.5, 0.1), (math.nan, 0.5), (0.5,), 0.5])
def test_the_share_of_the_grid_is_checked(filters, share):
    with pytest.raises(ValueError, match="share"):
        replace(filters[0], share=share)
    with pytest.raises(ValueError, match="memory_share"):
        Settings(memory_share=share)


def test_settings_reach_the_memory(memory):
    belief = GridBeliefConfig(temper=0.07, rows=64, pool=128, samples=64)
    settings = Settings(memory=True, memory_share=(0.2, 0.3), memory_temper=0.06, belief=belief, grid=GRID)
    built = make_filter("adam_robust", memory.likelihood, tiny_world.grid(), LIDAR, settings)
    assert isinstance(built, AdamPlaces) and built.share == (0.2, 0.3) and built.proposal.config == belief
    assert built.proposal.likelihood is memory.likelihood
    assert remembering(memory.likelihood, settings).likelihood.config.model.temper == 0.06
    assert memory.likelihood.config.model.temper == GRID.model.temper


def test_what_the_memory_says_counts_as_much_as_the_filter_is_lost(filters):
    """With the share at both of its ends, and between them."""
    prepared = prepare_alone(filters[0], jax.tree.map(lambda leaf: leaf[0], tiny_world.drive().inputs))
    state = filters[0].init(jax.random.key(0))._replace(updates=jnp.int32(3))
    poses = tiny_world.drive().poses[:1]
    prior = filters[0].proposal.log_prior(prepared, poses)
    for lost, share in [(0.0, 0.01), (0.2, 0.2), (0.9, 0.5)]:
        state = state._replace(lost=jnp.float32(lost))
        said = filters[0]._log_redrawn(state, poses, prepared) - prior
        np.testing.assert_allclose([said[0], filters[0]._log_kept(state)], np.log([share, 1 - share]), rtol=1e-5)


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_odometry_that_is_no_number_moves_nothing(room, bad):
    belief = room.begin() * jax.random.uniform(jax.random.key(0), room.begin().shape)
    ranges = jnp.full(LIDAR.beams, 1.1)
    spoilt, after = room.prepare(belief, Inputs(ranges, jnp.array([0.3, bad, 0.2]), jnp.int32(4)))
    # A robot that starts there has not moved either.
    first, expected = room.prepare(belief, Inputs(ranges, jnp.zeros(3), jnp.int32(0)))
    np.testing.assert_array_equal(after, expected)
    np.testing.assert_array_equal(spoilt.prior.mass, first.prior.mass)


def test_a_filter_outlives_odometry_that_is_no_number(filters):
    episode = tiny_world.drive()
    spoilt = episode._replace(odometry=episode.odometry.at[3].set(jnp.nan))
    info = run(filters[0], spoilt, run_keys(3, 0, 6)).info
    off = np.asarray(info.cluster) - np.asarray(episode.poses)
    assert (np.hypot(off[..., 0], off[..., 1])[:, -5:] < 0.5).all()


def test_alg_1_redraws_from_all_scans_so_far(memory):
    """A scan that says nothing: without trust in any particle, all come from what the drive has told."""
    episode = tiny_world.drive()
    filter = make_filter("adam", memory, tiny_world.grid(), LIDAR, Settings(particles=60))
    assert isinstance(filter, AdamMCL)
    prepare, belief = jax.jit(filter.prepare), filter.begin()
    for t in range(len(episode.ranges)):
        _, belief = prepare(belief, jax.tree.map(lambda leaf, t=t: leaf[t], episode.inputs))
    blind = Inputs(jnp.full(LIDAR.beams, jnp.nan), jnp.zeros(3), jnp.int32(len(episode.ranges)))
    state = filter.init(jax.random.key(0))
    lost = state._replace(weights=jnp.zeros(60).at[0].set(1e-6), updates=jnp.int32(9))
    poses = filter.step(jax.random.key(1), lost, blind, prepare(belief, blind)[0])[0].poses
    off = np.asarray(poses - episode.poses[-1])
    assert (np.hypot(off[:, 0], off[:, 1]) < 0.5).mean() > 0.9


def test_pictures_show_the_belief_after_the_scan(memory):
    prepared = prepare_alone(memory, jax.tree.map(lambda leaf: leaf[3], tiny_world.drive().inputs))
    shown = maps._pm_of(prepared)["pm"]
    # In units of the best cell, a peaked PM has little mass.
    assert shown is prepared.posterior.mass and float(shown.sum()) < 0.5 * float(prepared.prior.mass.sum())


def test_methods_with_the_memory_are_offered(memory):
    made = {"likelihood_grid": memory.likelihood}
    for name, kind in (("adam_markov_grid", AdamMCL), ("robust_markov_grid", AdamMemory)):
        own = {"particles": 20, "t_cut": 0.6, "sources": made}
        built = build_filter(name, tiny_world.grid(), LIDAR, **own)
        assert isinstance(built, kind) and built.proposal.likelihood.expected is memory.likelihood.expected


def test_a_robot_may_have_been_carried_anywhere(room):
    """The prior of an update holds ``kidnap`` of an even belief, wherever the belief before it was."""
    belief = jnp.zeros_like(room.begin()).at[0, 0].set(1.0)
    blind = Inputs(jnp.full(LIDAR.beams, jnp.nan), jnp.zeros(3), jnp.int32(4))
    prepared, after = room.prepare(belief, blind)
    cells, headings = int((np.asarray(room.begin()) > 0).sum()), room.likelihood.config.headings
    far = np.asarray(after)[room.likelihood.free.sum() - 1, headings // 2]
    assert far == pytest.approx(1e-4 / cells, rel=1e-3)
    assert float(np.asarray(after).sum()) == pytest.approx(1.0, abs=1e-5)
    np.testing.assert_allclose(prepared.prior.mass, prepared.posterior.mass, rtol=1e-5)
