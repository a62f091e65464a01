"""PF-Net and PFRNN as filters: their models by hand, their weights, and the promises of the runner."""

from __future__ import annotations

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import tiny_world
from dsom_jax import montecarlo
from dsom_jax.filters.common import Info
from dsom_jax.filters.learned import Prior
from dsom_jax.filters.methods import LEARNED, METHODS, STANDARD, build_filter, network_of
from dsom_jax.geometry import compose, inverse, relative, wrap_angle
from dsom_jax.nn.view_net import ScanCode
from dsom_jax.occupancy import from_cells, is_free
from dsom_jax.types import Inputs
from learned_kit import KINDS, MODELS, PFRNN, VIEW, make

TRUTH = tiny_world.drive().poses[0]
PRIOR = Prior(TRUTH, jnp.array([0.4, 0.15, 0.17]))


@pytest.fixture(scope="module")
def episode():
    return jax.tree.map(lambda leaf: leaf[:4], tiny_world.drive())


def inputs_at(episode, t):
    return jax.tree.map(lambda leaf: leaf[t], episode.inputs)


def test_motion_without_noise_is_exact():
    poses = jax.random.uniform(jax.random.key(0), (50, 3), minval=-3, maxval=3)
    odometry = jnp.array([0.4, -0.1, 0.3])
    moved = MODELS["pf_net"].move(poses, odometry, jnp.zeros((50, 3)))
    np.testing.assert_array_equal(moved, compose(poses, odometry))


def test_motion_noise_is_in_the_base_frame_and_never_below_its_floor():
    model, odometry = MODELS["pf_net"], jnp.array([0.4, -0.1, 0.3])
    noise = jax.random.normal(jax.random.key(0), (20, 3))
    pose = jnp.array([5.0, 2.0, 2.2])
    moved = model.move(jnp.broadcast_to(pose, (20, 3)), odometry, noise)
    np.testing.assert_allclose(relative(pose, moved), odometry + model.spread(odometry) * noise, atol=2e-6)
    for increment in (jnp.zeros(3), odometry, 10 * odometry):
        spread = np.asarray(model.spread(increment))
        assert (spread >= np.array([0.02, 0.02, 0.01])).all() and np.isfinite(spread).all()


def test_cell_is_a_gru_with_a_drawn_candidate():
    cell, rng = MODELS["pfrnn"].cell, np.random.default_rng(0)
    h, x, noise = (rng.normal(size=(5, n)) for n in (PFRNN.hidden, PFRNN.features + 3, PFRNN.hidden))
    new, log_likelihood = cell(*(jnp.asarray(v, jnp.float32) for v in (h, x, noise)))
    assert new.shape == (5, PFRNN.hidden) and log_likelihood.shape == (5,)

    def dense(layer, v):
        return v @ np.asarray(layer.kernel[...], np.float64) + np.asarray(layer.bias[...], np.float64)

    both = np.concatenate([h, x], 1)
    keep, reset = np.split(1 / (1 + np.exp(-dense(cell.gates, both))), 2, 1)
    mean, spread = np.split(dense(cell.candidate, np.concatenate([reset * h, x], 1)), 2, 1)
    candidate = np.tanh(mean + np.log1p(np.exp(spread - 1)) * noise)
    expected = (1 - keep) * candidate + keep * h
    np.testing.assert_allclose(new, expected, atol=1e-5)
    likelihood = dense(cell.likelihood, np.concatenate([expected, x], 1))[:, 0]
    np.testing.assert_allclose(log_likelihood, likelihood, atol=1e-5)


def test_corrections_are_bounded_and_in_the_particles_frame():
    poses = jnp.array([[1.0, 2.0, 3.0], [0.0, 0.0, -1.0]])
    wild = 1e3 * jax.random.normal(jax.random.key(0), (2, PFRNN.hidden))
    step = np.abs(relative(poses, MODELS["pfrnn"].correct(poses, wild)))
    assert (step <= np.array([0.5, 0.5, 0.3]) + 1e-5).all() and (step > 0.1).any()
    np.testing.assert_array_equal(MODELS["pfrnn"].correct(poses, jnp.zeros((2, PFRNN.hidden)))[:, :2], poses[:, :2])


def test_observation_network_by_hand():
    net = MODELS["pf_net"].observation
    views = np.random.default_rng(0).uniform(size=(3, VIEW.patches, 16))
    gate, shift = np.random.default_rng(1).normal(size=(2, VIEW.patches, 8))

    def leaky(v):
        return np.where(v > 0, v, 0.1 * v)

    def dense(layer, v):
        return v @ np.asarray(layer.kernel[...]) + np.asarray(layer.bias[...])

    x = leaky(views @ np.asarray(net.map_patch[...]) * gate + shift)
    x = leaky(dense(net.compare, x)).reshape(3, VIEW.patches // 4, -1)
    x = leaky(dense(net.whole, leaky(dense(net.join, x)).reshape(3, -1)))
    np.testing.assert_allclose(net(jnp.asarray(views, jnp.float32), ScanCode(gate, shift)), x, atol=1e-4)


@pytest.mark.parametrize("kind", KINDS)
def test_start_anywhere_or_from_a_prior(kind):
    lost = jax.jit(lambda f, key: f.init(key))(make(kind, 500), jax.random.key(0))
    assert is_free(tiny_world.grid(), lost.poses).all()
    assert np.asarray(lost.poses[:, :2]).std(0).min() > 0.8
    known = jax.jit(lambda f, key: f.init(key))(make(kind, 500, PRIOR), jax.random.key(0))
    offset = np.asarray(relative(TRUTH, known.poses))
    # 500 draws: the standard error of a mean is std / 22, of a standard deviation std / 32; five of them.
    assert (np.abs(offset.mean(0)) < 5 / 22 * np.asarray(PRIOR.std)).all()
    assert (np.abs(offset.std(0) / np.asarray(PRIOR.std) - 1) < 5 / 32).all()
    given = make(kind, 2).start(jnp.stack([TRUTH, TRUTH]))
    np.testing.assert_allclose(np.exp(given.log_weights), 0.5)


def test_the_scatter_of_left_and_right_turns_and_of_all_directions_is_one():
    spread = MODELS["pf_net"].spread
    np.testing.assert_array_equal(spread(jnp.array([0.4, 0.3, -0.3])), spread(jnp.array([0.5, 0.0, 0.3])))
    assert not np.array_equal(spread(jnp.array([0.0, 0.0, 1.0])), spread(jnp.array([0.0, 0.0, 0.0])))


class Spy(dict):
    """Stands in for the learned part of an update: keeps what it is given and returns a made-up likelihood."""

    def pf_net_move(self, network, poses, odometry, noise):
        self.update(poses=poses, odometry=odometry, noise=noise)
        return poses + 0.25

    def pf_net_likelihood(self, network, place, poses, code):
        self.update(weighed=poses)
        return jnp.sin(jnp.arange(len(poses)))

    def pfrnn_update(self, network, place, poses, hidden, odometry, code, noise):
        self.update(poses=poses, hidden=hidden, odometry=odometry, noise=noise)
        return poses + 0.25, hidden + 1.0, jnp.sin(jnp.arange(len(poses)))


@pytest.mark.parametrize("kind", KINDS)
def test_an_update_resamples_softly_moves_and_weighs(kind, monkeypatch):
    """What the networks are given and what becomes of it; the ancestors are told by their poses, all different."""
    n, spy, odometry = 40, Spy(), jnp.array([0.3, -0.1, 0.4])
    monkeypatch.setattr(type(MODELS["pf_net"]), "move", lambda *a: spy.pf_net_move(*a))
    monkeypatch.setattr(type(MODELS["pf_net"]), "log_likelihood", lambda *a: spy.pf_net_likelihood(*a))
    monkeypatch.setattr(type(MODELS["pfrnn"]), "update", lambda *a: spy.pfrnn_update(*a))
    poses = np.stack([np.arange(n), -np.arange(n), np.zeros(n)], -1).astype(np.float32)
    weights = np.where(np.arange(n) == 7, 0.61, 0.01)
    filter = make(kind, n)
    state = filter.start(jnp.asarray(poses))._replace(log_weights=jnp.log(jnp.asarray(weights, jnp.float32)))
    if kind == "pfrnn":
        state = state._replace(hidden=jnp.asarray(poses[:, :1] * np.ones(PFRNN.hidden, np.float32)))
    after = filter.advance(jax.random.key(0), state, Inputs(jnp.zeros(32), odometry, jnp.int32(1)), None)
    start = np.asarray(spy["poses"] if kind == "pf_net" else compose(spy["poses"], inverse(odometry)))
    ancestors = np.round(start[:, 0]).astype(int)
    np.testing.assert_allclose(start, poses[ancestors], atol=1e-4)
    # Half of the draws by weight, half from all alike: systematic, so that the number is exact but for one.
    assert abs((ancestors == 7).sum() - n * (0.5 * 0.61 + 0.5 / n)) < 1
    log_weights = np.log(weights / (0.5 * weights + 0.5 / n))[ancestors] + np.sin(np.arange(n))
    np.testing.assert_allclose(after.log_weights, log_weights - np.log(np.exp(log_weights).sum()), atol=1e-5)
    np.testing.assert_array_equal(after.poses, spy["poses"] + 0.25)
    np.testing.assert_array_equal(spy["odometry"], odometry)
    assert 0.7 < float(spy["noise"].std()) < 1.3 and len(np.unique(spy["noise"])) == spy["noise"].size
    if kind == "pf_net":
        np.testing.assert_array_equal(spy["weighed"], after.poses)
    else:
        np.testing.assert_array_equal(spy["hidden"][:, 0], ancestors)
        np.testing.assert_array_equal(after.hidden, spy["hidden"] + 1.0)


def test_the_cell_of_pfrnn_reads_scan_and_motion_and_its_head_corrects():
    model, filter, rng = MODELS["pfrnn"], make("pfrnn", 5), np.random.default_rng(0)
    code, _ = filter.prepare((), Inputs(jnp.full(32, 2.0), jnp.zeros(3), jnp.int32(0)))
    poses = jnp.stack([TRUTH] * 5) + jnp.arange(5)[:, None] * 0.1
    hidden, noise = (jnp.asarray(rng.normal(size=(5, PFRNN.hidden)), jnp.float32) for _ in range(2))
    odometry = jnp.array([0.3, -0.1, 0.2])
    given = model.inputs(filter.place, poses, odometry, code)
    # Metres twice, radians three times: updates are about half a metre or a third of a radian apart.
    np.testing.assert_allclose(given[:, -3:], np.tile([0.6, -0.2, 0.6], (5, 1)), rtol=1e-6)
    corrected, new, log_likelihood = model.update(filter.place, poses, hidden, odometry, code, noise)
    expected, likelihood = model.cell(hidden, given, noise)
    np.testing.assert_allclose(new, expected, atol=1e-6)
    np.testing.assert_allclose(log_likelihood, likelihood, atol=1e-6)
    np.testing.assert_allclose(corrected, model.correct(poses, new), atol=1e-6)


def test_the_estimate_is_that_of_the_weights(episode):
    filter = make("pf_net", 24, PRIOR)
    now = inputs_at(episode, 1)
    uneven = jax.nn.log_softmax(jnp.linspace(0.0, 9.0, 24))

    def step(key):
        return filter.step(key, filter.init(key)._replace(log_weights=uneven), now, filter.prepare((), now)[0])

    state, info = jax.jit(step)(jax.random.key(0))
    weights = np.exp(np.asarray(state.log_weights, np.float64))
    plain = np.asarray(state.poses)[:, :2].mean(0)
    assert np.abs(weights @ np.asarray(state.poses)[:, :2] - plain).max() > 5e-3
    np.testing.assert_allclose(info.mean[:2], weights @ np.asarray(state.poses)[:, :2], atol=1e-4)


def test_a_finer_map_is_brought_to_the_scale_of_the_network():
    cells = np.kron(tiny_world.cells(), np.ones((2, 2), bool))
    fine = from_cells(cells, resolution=0.125, origin=tiny_world.ORIGIN)
    ours, coarse = (LEARNED["pf_net"](MODELS["pf_net"], grid, tiny_world.LIDAR, 5).place for grid in
                    (fine, tiny_world.grid()))  # fmt: skip
    np.testing.assert_array_equal(ours.codes, coarse.codes)
    assert ours.resolution == coarse.resolution == 0.25


@pytest.mark.parametrize("kind", KINDS)
def test_update(kind, episode):
    chex.clear_trace_counter()
    filter = make(kind, 24, PRIOR)
    step = jax.jit(
        chex.assert_max_traces(lambda f, key, state, now: f.step(key, state, now, f.prepare((), now)[0]), n=1)
    )
    state = filter.init(jax.random.key(0))
    for t in range(3):
        state, info = step(filter, jax.random.key(t), state, inputs_at(episode, t))
        assert isinstance(info, Info) and info.mean.shape == info.cluster.shape == (3,)
        assert state.poses.shape == (24, 3) and np.isfinite(state.poses).all()
        np.testing.assert_allclose(np.exp(state.log_weights).sum(), 1.0, atol=1e-5)
        assert 0 <= float(info.lost) <= 1 and float(info.redrawn) == 0 and not bool(info.restarted)
        assert (np.abs(wrap_angle(state.poses[:, 2]) - state.poses[:, 2]) < 1e-5).all()
    if kind == "pfrnn":
        assert state.hidden.shape == (24, PFRNN.hidden) and (np.abs(state.hidden) <= 1).all()


@pytest.mark.parametrize("kind", KINDS)
def test_a_run_of_100_is_the_same_in_any_batch_bit_for_bit(kind, episode):
    keys = montecarlo.run_keys(0, 0, 100)
    whole = montecarlo.run(make(kind), episode, keys)
    for alone in (17, 99):
        # With one other: XLA rounds a batch of one differently.
        pair = montecarlo.run(make(kind), episode, keys[alone - 1 : alone + 1])
        jax.tree.map(
            lambda a, b, r=alone: np.testing.assert_array_equal(a[r], b[1]), (whole.info, whole.state),
            (pair.info, pair.state),
        )  # fmt: skip


def test_another_map_or_prior_needs_no_compilation(episode):
    first = montecarlo.signature(make("pfrnn", 24, PRIOR), episode)
    assert first == montecarlo.signature(make("pfrnn", 24, Prior(TRUTH + 1, PRIOR.std)), episode)


def test_names():
    assert set(LEARNED) == set(KINDS) <= set(METHODS) and not set(KINDS) & set(STANDARD)
    assert [network_of(name) for name in ("mcl", "adam_hybrid", "pf_net", "pfrnn")] == [None, "dsom", "pf_net", "pfrnn"]
    for kind in KINDS:
        own = {"particles": 7, "t_cut": 0.6, "checkpoint": MODELS[kind]}
        filter = build_filter(kind, tiny_world.grid(), tiny_world.LIDAR, **own)
        assert filter.particles == 7 and filter.prior is None


def test_beams_are_thinned_to_what_the_network_reads():
    lidar = tiny_world.LIDAR.__class__(beams=360, range_max=5.0)
    filter = LEARNED["pf_net"](MODELS["pf_net"], tiny_world.grid(), lidar, 5)
    assert filter.beam_step == 12 and filter.lidar.beams == 30
    ranges = jnp.linspace(0.5, 4.5, 360)
    expected = MODELS["pf_net"].observation.scan_code(ranges[::12], lidar.every(12))
    read, _ = filter.prepare((), Inputs(ranges, jnp.zeros(3), jnp.int32(0)))
    jax.tree.map(np.testing.assert_array_equal, read, expected)
