"""Training of PF-Net and PFRNN: sequences, losses, a tiny problem, checkpoints, and the command line."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dsom_jax
import tiny_world
from dsom_jax import checkpoint
from dsom_jax.errors import UserError
from dsom_jax.geometry import relative, wrap_angle
from dsom_jax.judging.tracking import tracked
from dsom_jax.lidar import LidarConfig
from dsom_jax.nn import create_pf_net
from dsom_jax.occupancy import OccupancyGrid, is_free
from dsom_jax.training import filter_loop
from dsom_jax.training.filter_loop import (
    averaged_filter_model,
    init_filter_state,
    make_filter_step,
    stack_maps,
    start_poses,
)
from dsom_jax.training.filter_loss import huber, particle_loss, prediction_loss
from dsom_jax.training.sequences import make_windows, path_distance, plan_paths, spoil_world
from learned_kit import DATA, KINDS, MODELS, PF_NET, training

GRID = replace(tiny_world.grid(), origin=jnp.zeros(3))


@pytest.fixture(scope="module")
def pool():
    return plan_paths(0, [GRID, GRID], DATA)


@pytest.fixture(scope="module")
def windows(pool):
    make = jax.jit(lambda key: make_windows(key, pool, DATA, GRID.resolution, 4, 12))
    return make(jax.random.key(0))


def test_paths_are_free_and_a_function_of_the_seed(pool):
    again, other = plan_paths(0, [GRID, GRID], DATA), plan_paths(1, [GRID, GRID], DATA)
    np.testing.assert_array_equal(pool.poses, again.poses)
    assert not np.array_equal(pool.poses, other.poses)
    assert pool.poses.shape == (8, 12, 3) and is_free(GRID, pool.poses).all()
    assert pool.where.tolist() == [0] * 4 + [1] * 4


def test_windows_are_pieces_of_paths(pool, windows):
    assert windows.ranges.shape == (4, 4, 32) and windows.strays.shape == (4, 12, 3)
    paths = np.asarray(pool.poses)
    for poses, where in zip(np.asarray(windows.poses), np.asarray(windows.where), strict=True):
        found = [n for n in range(8) for t in range(9) if np.array_equal(paths[n, t : t + 4], poses)]
        assert found and all(pool.where[n] == where for n in found)
    assert (windows.odometry[:, 0] == 0).all() and is_free(GRID, windows.strays).all()


def test_odometry_tells_the_motion_with_some_noise(windows):
    moved = jax.vmap(relative)(windows.poses[:, :-1], windows.poses[:, 1:])
    error = np.array(windows.odometry[:, 1:] - moved)
    error[..., 2] = np.asarray(wrap_angle(jnp.asarray(error[..., 2])))
    # Of 0.2 m or 0.3 rad: standard deviations below 0.02 m and 0.04 rad; five of them.
    assert (np.abs(error) < np.array([0.1, 0.1, 0.2])).all() and np.abs(error).max() > 0


def test_the_world_differs_from_the_map_but_not_on_the_path(pool):
    poses = pool.poses[0, :4]
    spoil = jax.jit(lambda key: spoil_world(key, GRID, poses, DATA))
    worlds = [spoil(jax.random.key(n)) for n in range(6)]
    assert any((world.occupied & ~GRID.occupied).any() for world in worlds)
    assert any((GRID.occupied & ~world.occupied).any() for world in worlds)
    far = np.asarray(path_distance(GRID, poses)) > 1.0 + 2.5  # removed pieces are at most 2.5 m wide
    for world in worlds:
        i, j = (np.floor(np.asarray(poses)[:, axis] / GRID.resolution).astype(int) for axis in (1, 0))
        assert not np.asarray(world.occupied)[i, j].any()
        assert (np.asarray(world.occupied) == np.asarray(GRID.occupied))[far].all()


def test_distance_to_a_path_by_hand():
    grid = OccupancyGrid(jnp.zeros((2, 3), bool), jnp.ones((2, 3), bool), jnp.zeros(3), 1.0)
    distance = path_distance(grid, jnp.array([[0.5, 0.5, 0.0], [2.5, 0.5, 1.0]]))
    np.testing.assert_allclose(distance, [[0, 1, 0], [1, np.sqrt(2), 1]], atol=1e-6)


def test_prediction_loss_by_hand():
    poses = jnp.array([[0.0, 0.0, 0.0], [0.4, 0.0, 0.2]])
    even = jnp.log(jnp.array([0.5, 0.5]))
    loss = prediction_loss(poses, even, jnp.zeros(3), 2.0)
    np.testing.assert_allclose(loss, 0.2**2 + 2 * 2 * (1 - (1 + np.cos(0.2)) / 2), rtol=1e-4)
    assert float(prediction_loss(poses, even, jnp.array([0.2, 0.0, 2 * np.pi]), 0.0)) < 1e-6
    np.testing.assert_allclose(huber(jnp.array([0.25, 1.0, 9.0])), [0.25, 1.0, 5.0])


def test_particle_loss_by_hand():
    poses = jnp.array([[0.0, 0.0, 0.0], [1.0, 0.0, -np.pi]])
    loss = particle_loss(poses, jnp.array([0.0, 0.0, 2 * np.pi]), 0.5, 0.2)
    far = np.exp(-0.5 * (1 / 0.25 + np.pi**2 / 0.04))
    np.testing.assert_allclose(loss, -np.log(0.5 * (1 + far)), rtol=1e-5)


def test_particles_start_about_the_truth(windows):
    window = jax.tree.map(lambda leaf: leaf[0], windows)
    config = training("pf_net", strays=0.0, start_xy=(0.1, 0.1), start_theta=(0.05, 0.05), particles=12)
    offset = relative(window.poses[0], start_poses(jax.random.key(0), window, config))
    assert np.abs(offset).max() < 0.7
    half = training("pf_net", strays=0.99)
    draw = jax.jit(lambda key: start_poses(key, window, half))
    starts = jnp.stack([draw(jax.random.key(n)) for n in range(20)])
    share = (starts == window.strays).all(-1).mean(1)
    assert 0.3 < float((share == 0).mean()) < 0.8 and float(share.max()) > 0.4


@pytest.mark.parametrize("kind", KINDS)
def test_training_lowers_the_loss(kind, pool, windows):
    config = training(kind, learning_rate=3e-3)
    step, state = make_filter_step(config, stack_maps(pool, GRID.resolution)), init_filter_state(config)
    first = [np.array(leaf) for leaf in jax.tree.leaves(state.params)]
    losses = []
    for _ in range(60):
        state, metrics = step(state, windows, jnp.int32(1000))
        losses.append(float(metrics["total"]))
    # Only PFRNN is paid for the likelihood of its particles.
    weight = config.particle_weight if kind == "pfrnn" else 0.0
    assert losses[-1] == pytest.approx(float(metrics["prediction"] + weight * metrics["particles"]), rel=1e-5)
    assert np.mean(losses[-10:]) < 0.8 * np.mean(losses[:10])
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(state))
    changed = [not np.array_equal(a, b) for a, b in zip(first, jax.tree.leaves(state.params), strict=True)]
    assert all(changed), "a weight without gradient"
    assert averaged_filter_model(config, state).config == config.model
    check_average(step, config, windows)


def check_average(step, config, windows):
    """The first step weighs fresh weights by a tenth, later ones by up to ``ema``; each has luck of its own."""
    first, totals = init_filter_state(config), []
    for done, decay in ((0, 0.1), (10, 11 / 20), (10**6, config.ema)):
        before = jax.tree.map(np.array, first.average)
        state, metrics = step(
            jax.tree.map(jnp.copy, first._replace(step=jnp.int32(done))), windows, jnp.int32(2 * 10**6)
        )
        expected = jax.tree.map(lambda a, b, d=decay: d * a + (1 - d) * np.asarray(b), before, state.params)
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-6), state.average, expected)
        totals.append(float(metrics["total"]))
    assert len(set(totals)) == 3


def test_a_sequence_is_followed_on_its_own_map(pool, windows, monkeypatch):
    class Seen(Exception):
        pass

    def stop(params, graph, config, place):
        raise Seen(place)

    monkeypatch.setattr(filter_loop, "make_tracker", stop)
    two = pool._replace(occupied=jnp.stack([pool.occupied[0], ~pool.occupied[1]]))
    places, config = stack_maps(two, GRID.resolution), training("pf_net")
    for where in (0, 1):
        window = jax.tree.map(lambda leaf: leaf[0], windows)._replace(where=jnp.int32(where))
        with pytest.raises(Seen) as seen:
            filter_loop.follow(None, None, config, places, jax.random.key(0), window)
        np.testing.assert_array_equal(seen.value.args[0].codes, places.codes[where])


def test_scans_are_thinned(pool):
    thin = replace(DATA, beam_step=3)
    made = jax.eval_shape(lambda key: make_windows(key, pool, thin, GRID.resolution, 4, 12), jax.random.key(0))
    assert made.ranges.shape == (4, 4, 11)


def test_summary_of_tracking():
    error = np.zeros((4, 3, 2))
    error[:, -1, 0] = [0.1, 0.2, 0.3, 0.9]
    assert tracked(jnp.asarray(error)) | {"e_pos_m": 0} == {
        "sequences": 4, "updates": 3, "tracked": 0.75, "e_pos_m": 0, "e_theta_rad": 0.0,
    }  # fmt: skip


@pytest.mark.parametrize("kind", KINDS)
def test_checkpoint_round_trip(kind, tmp_path):
    checkpoint.save(tmp_path / "c", MODELS[kind])
    loaded = checkpoint.load(tmp_path / "c", tiny_world.LIDAR, GRID.resolution, kind=kind)
    assert loaded.config == MODELS[kind].config
    jax.tree.map(np.testing.assert_array_equal, jax.tree.leaves(loaded), jax.tree.leaves(MODELS[kind]))
    other = "dsom" if kind == "pf_net" else "pf_net"
    with pytest.raises(UserError, match=f"field kind is {kind}, but a {other} is needed"):
        checkpoint.load(tmp_path / "c", kind=other)
    with pytest.raises(UserError, match="does not fit the lidar: range_max 4 m"):
        checkpoint.load(tmp_path / "c", LidarConfig(range_max=4.0), kind=kind)
    with pytest.raises(UserError, match=r"works at 0\.25 m per cell"):
        checkpoint.load(tmp_path / "c", resolution=0.05, kind=kind)


@pytest.mark.parametrize("kind", KINDS)
def test_shipped_checkpoints_fit_the_suite(kind):
    folder = checkpoint.shipped(kind)
    assert folder is not None
    assert checkpoint.load(folder, dsom_jax.load_suite("synthetic-v1").lidar, 1 / 3, kind)
    record = checkpoint.load_provenance(folder, kind)
    assert record["steps"] == record["total"] and record["metrics"]["tracked"] >= 0.9
    text = (folder / record["weights"] / "commit_success.txt").read_text()
    assert text == f"Checkpoint commit was successful to {record['weights']}"


def test_fresh_networks_depend_on_the_seed_alone():
    first, again, other = (jax.tree.leaves(create_pf_net(PF_NET, seed)) for seed in (1, 1, 2))
    assert all(np.array_equal(a, b) for a, b in zip(first, again, strict=True))
    assert not np.array_equal(first[0], other[0]) or not np.array_equal(first[-1], other[-1])
