"""One robot, live: the same numbers as a Monte-Carlo run, and what happens when scans or odometry are odd."""

from __future__ import annotations

import copy
import json
import math
from dataclasses import replace

import jax
import numpy as np
import pytest

import tiny_world
from dsom_jax.data import se2
from dsom_jax.errors import UserError
from dsom_jax.filters.methods import make_filter, make_proposal, watch
from dsom_jax.filters.settings import REAL
from dsom_jax.live import Localizer
from dsom_jax.montecarlo import run, run_keys
from dsom_jax.proposals.likelihood_grid import LikelihoodGridConfig
from dsom_jax.raycast import RaycastConfig

RAYS = RaycastConfig("exact")
SETTINGS = replace(
    REAL, particles=60, raycast=RAYS, robust_raycast=RAYS, grid=LikelihoodGridConfig(headings=32, raycast=RAYS)
)
STEPS = 12
START = np.array([7.0, -3.0, 2.0])
"""Where the odometry begins."""


@pytest.fixture(scope="module")
def episode():
    return tiny_world.drive(STEPS)


@pytest.fixture(scope="module")
def odometry(episode):
    poses = [START]
    for motion in np.asarray(episode.odometry, np.float64)[1:]:
        poses.append(se2.compose(poses[-1], motion))
    return np.stack(poses)


@pytest.fixture(scope="module")
def made():
    """Compiled once; never given a scan, as its copies share what they donate."""
    return Localizer(tiny_world.grid(), tiny_world.LIDAR, SETTINGS, seed=3, update_min_d=0.1, update_min_a=0.1)


@pytest.fixture
def robot(made):
    robot = copy.copy(made)
    robot.relocalize(run_keys(3, 0, 1))
    return robot


def follow(robot, episode, odometry, steps=range(STEPS), start=100.0):
    """Answers to the updates ``steps``."""
    return [robot.update(np.asarray(episode.ranges[t]), odometry[t], start + t) for t in steps]


def off(pose, truth):
    """Metres and radians between two poses."""
    x, y, turn = se2.relative(np.asarray(truth, float), np.asarray(pose, float))
    return math.hypot(x, y), abs(turn)


def test_same_numbers_as_run_0_bit_for_bit(robot, episode, odometry):
    proposal = make_proposal("likelihood_grid", tiny_world.grid(), tiny_world.LIDAR, SETTINGS)
    filter = make_filter("adam_robust", proposal, tiny_world.grid(), tiny_world.LIDAR, SETTINGS)
    filter = watch(filter, tiny_world.grid(), tiny_world.LIDAR, SETTINGS)
    batch = run(filter, episode, run_keys(3, 0, 1))
    for t, scan in enumerate(np.asarray(episode.ranges)):
        answer = robot.update(scan, odometry[t], float(t))
        assert answer.updated
        for name, leaf in batch.info._asdict().items():
            for ours, theirs in zip(jax.tree.leaves(getattr(robot.info, name)), jax.tree.leaves(leaf), strict=True):
                np.testing.assert_array_equal(ours, theirs[0, t], err_msg=f"{name} of update {t}")
        np.testing.assert_array_equal(answer.pose, np.float64(batch.info.cluster[0, t]))
    poses, weights = robot.particles()
    np.testing.assert_array_equal(poses, np.float64(batch.state.state.poses[0]))
    np.testing.assert_allclose(weights, np.exp(batch.state.state.log_weights[0]), rtol=1e-5)


def test_run_0_of_several_differs_by_rounding_alone(robot, episode, odometry):
    # XLA sums the particles of one run in another order than those of several.
    proposal = make_proposal("likelihood_grid", tiny_world.grid(), tiny_world.LIDAR, SETTINGS)
    filter = make_filter("adam_robust", proposal, tiny_world.grid(), tiny_world.LIDAR, SETTINGS)
    filter = watch(filter, tiny_world.grid(), tiny_world.LIDAR, SETTINGS)
    batch = run(filter, episode, run_keys(3, 0, 4))
    poses = np.array([answer.pose for answer in follow(robot, episode, odometry)])
    np.testing.assert_allclose(poses, batch.info.cluster[0], atol=1e-4)


def test_it_finds_the_robot_and_says_so(robot, episode, odometry):
    answers = follow(robot, episode, odometry)
    distance, turn = off(answers[-1].pose, episode.poses[-1])
    assert distance < 0.1 and turn < 0.1 and answers[-1].localized and answers[-1].p_lost < 0.05
    assert all(a.updated and not a.note and a.seconds > 0 for a in answers)
    weights = [h.weight for h in answers[-1].hypotheses]
    assert weights == sorted(weights, reverse=True) and 0.5 < sum(weights) < 1 + 1e-5


def test_covariance_is_the_second_moment_of_the_particles(robot, episode, odometry):
    answer = follow(robot, episode, odometry)[-1]
    poses, weights = robot.particles()
    away = poses - answer.pose
    away[:, 2] = se2.wrap(away[:, 2])
    np.testing.assert_allclose(answer.covariance, (weights[:, None] * away).T @ away, atol=1e-5)


def test_nothing_is_compiled_after_construction(robot, episode, odometry, tmp_path):
    compiled = []
    jax.monitoring.register_event_duration_secs_listener(lambda event, *_, **__: compiled.append(event))
    try:
        follow(robot, episode, odometry, range(4))
        robot.update(np.ones(17), odometry[4], 110.0)
        robot.set_pose(episode.poses[4], np.eye(3) * 0.01)
        robot.particles()
        robot.relocalize()
        robot.update(np.asarray(episode.ranges[5]), odometry[5], 111.0)
        robot.save(tmp_path / "pose.json")
    finally:
        jax.monitoring.clear_event_listeners()
    assert not [event for event in compiled if "compile" in event or "trace" in event]


def test_between_updates_the_odometry_carries_the_answer(robot, episode, odometry):
    last = follow(robot, episode, odometry)[-1]
    step = np.array([0.05, 0.0, 0.02])
    answer = robot.update(np.full(32, np.nan), se2.compose(odometry[-1], step), 200.0)
    assert not answer.updated and answer.stamp == 200.0 and answer.verdict == last.verdict
    np.testing.assert_allclose(answer.pose, se2.compose(last.pose, step))
    np.testing.assert_allclose(answer.hypotheses[0].pose, se2.compose(last.hypotheses[0].pose, step))
    # Moments of points carried along, to first order in their spread.
    rng = np.random.default_rng(0)
    tight = 1e-6 * last.covariance / np.trace(last.covariance)
    points = se2.compose(rng.multivariate_normal(last.pose, tight, 100_000), step)
    ratio = np.cov(points.T) / 1e-6 * np.trace(last.covariance)
    np.testing.assert_allclose(answer.covariance, ratio, atol=0.02 * np.trace(last.covariance))
    assert not robot.update(np.full(32, np.nan), odometry[-1], 201.0).updated
    assert robot.update(np.asarray(episode.ranges[-1]), se2.compose(odometry[-1], np.array([0.11, 0, 0])), 202).updated


def test_force_uses_a_scan_although_the_robot_stands(robot, episode, odometry):
    follow(robot, episode, odometry, range(2))
    scan = np.asarray(episode.ranges[1])
    assert not robot.update(scan, odometry[1], 102.0).updated
    robot.force()
    assert robot.update(scan, odometry[1], 103.0).updated and not robot.update(scan, odometry[1], 104.0).updated


@pytest.mark.parametrize(
    ("pose", "stamp", "note"),
    [
        (None, 103.0, "that of the scan before"),
        (None, 101.5, "older than the last"),
        (np.array([np.nan, 0.0, 0.0]), 104.0, "not finite"),
        (np.array([0.0, 0.0, np.inf]), 104.0, "not finite"),
        (None, math.nan, "not finite"),
    ],
)
def test_what_cannot_be_used_changes_nothing(robot, episode, odometry, pose, stamp, note):
    before = follow(robot, episode, odometry, range(4))[-1]
    answer = robot.update(np.asarray(episode.ranges[9]), odometry[9] if pose is None else pose, stamp)
    assert not answer.updated and note in answer.note
    np.testing.assert_array_equal(answer.pose, before.pose)
    # As if it had never come: the next answers are those of the drive without it.
    rest = follow(robot, episode, odometry, range(4, STEPS))
    robot.relocalize(run_keys(3, 0, 1))
    robot._odometry, robot._stamp = None, -math.inf
    expected = follow(robot, episode, odometry)[4:]
    for ours, theirs in zip(rest, expected, strict=True):
        np.testing.assert_array_equal(ours.pose, theirs.pose)


def test_before_any_scan_it_is_nowhere(robot):
    answer = robot.update(np.ones(32), [np.nan] * 3, 1.0)
    assert not answer.localized and answer.p_lost == 1 and np.isnan(answer.pose).all() and not answer.hypotheses
    with pytest.raises(ValueError, match="shape"):
        robot.update(np.ones(32), [0.0, 0.0], 1.0)


def test_a_clock_that_is_set_back_is_followed(robot, episode, odometry):
    follow(robot, episode, odometry, range(4))
    answers = follow(robot, episode, odometry, range(4, STEPS), start=-90.0)
    assert all(a.updated and not a.note for a in answers) and off(answers[-1].pose, episode.poses[-1])[0] < 0.1


@pytest.mark.parametrize("reset", [np.zeros(3), np.array([1000.0, -500.0, -3.0])])
def test_an_odometry_that_is_reset_costs_nothing(robot, episode, odometry, reset):
    follow(robot, episode, odometry, range(6))
    # The encoders start anew where the robot stands.
    shift = se2.compose(reset, se2.inverse(odometry[5]))
    later = np.stack([se2.compose(shift, pose) for pose in odometry])
    answer = robot.update(np.asarray(episode.ranges[5]), later[5], 105.5)
    assert answer.updated and "reset" in answer.note
    answers = follow(robot, episode, later, range(6, STEPS))
    assert answers[-1].localized and not answers[-1].note and off(answers[-1].pose, episode.poses[-1])[0] < 0.1


@pytest.mark.parametrize("beams", [16, 63, 64, 500])
def test_other_numbers_of_beams_span_the_same_angle(robot, episode, odometry, beams):
    follow(robot, episode, odometry, range(6))
    lidar = replace(tiny_world.LIDAR, beams=beams, angle_increment=31 * tiny_world.LIDAR.angle_increment / (beams - 1))
    scans = np.asarray(tiny_world.cast(tiny_world.tables(), episode.poses, lidar))
    answers = [robot.update(scans[t], odometry[t], 100.0 + t) for t in range(6, STEPS)]
    assert off(answers[-1].pose, episode.poses[-1])[0] < 0.15 and answers[-1].localized


def test_blind_scans_leave_the_odometry(robot, episode, odometry):
    follow(robot, episode, odometry, range(8))
    for t, scan in ((8, []), (9, np.full(32, np.nan)), (10, np.zeros(32))):
        answer = robot.update(scan, odometry[t], 100.0 + t)
        assert answer.updated and np.isfinite(answer.pose).all() and np.isfinite(answer.covariance).all()
    assert off(answer.pose, episode.poses[10])[0] < 0.3


def test_a_pose_that_is_told_is_believed(robot, episode, odometry):
    truth = np.asarray(episode.poses[0], np.float64)
    robot.set_pose(truth, np.diag([0.05, 0.05, 0.05]) ** 2)
    poses, weights = robot.particles()
    np.testing.assert_allclose((weights[:, None] * poses).sum(0)[:2], truth[:2], atol=4 * 0.05 / math.sqrt(60))
    answers = follow(robot, episode, odometry)
    assert max(off(a.pose, pose)[0] for a, pose in zip(answers, episode.poses, strict=True)) < 0.15
    assert all(a.localized and len(a.hypotheses) == 1 for a in answers)


def test_a_wrong_pose_is_corrected_by_the_scans(robot, episode, odometry):
    wrong = np.asarray(tiny_world.grid().from_grid(np.array([1.0, 4.0, -2.0])))
    follow(robot, episode, odometry, range(2))
    robot.set_pose(wrong, np.diag([0.1, 0.1, 0.1]) ** 2)
    first = robot.update(np.full(32, np.nan), odometry[2], 102.0)
    assert off(first.pose, wrong)[0] < 0.6
    answers = follow(robot, episode, odometry, range(3, STEPS))
    assert off(answers[-1].pose, episode.poses[-1])[0] < 0.3


@pytest.mark.parametrize(
    ("pose", "covariance", "says"),
    [
        ([1e3, 0.0, 0.0], np.eye(3) * 0.01, "nowhere near free space"),
        ([np.nan, 0.0, 0.0], np.eye(3), "give finite"),
        ([0.0, 0.0, 0.0], np.eye(2), "give finite"),
        ([3.0, 1.0, 0.0], np.diag([-1.0, 1.0, 1.0]), "negative variance"),
    ],
)
def test_poses_that_mean_nothing_are_refused(robot, episode, odometry, pose, covariance, says):
    before = follow(robot, episode, odometry, range(3))[-1]
    with pytest.raises(UserError, match=says):
        robot.set_pose(pose, covariance)
    np.testing.assert_array_equal(robot.update([], odometry[2], 103.0).pose, before.pose)


def test_looking_everywhere_again(robot, episode, odometry):
    follow(robot, episode, odometry, range(6))
    robot.relocalize()
    assert np.isnan(robot.update([], [np.nan] * 3, 200.0).pose).all()
    answers = follow(robot, episode, odometry, range(6, STEPS))
    assert answers[0].updated and off(answers[-1].pose, episode.poses[-1])[0] < 0.15


def test_a_pose_survives_a_restart(robot, made, episode, odometry, tmp_path):
    follow(robot, episode, odometry, range(8))
    robot.save(tmp_path / "pose.json")
    again = copy.copy(made)
    again.relocalize(run_keys(3, 0, 1))
    assert again.restore(tmp_path / "pose.json")
    # The odometry begins anew; the room has no two places alike, but one scan would not tell as surely.
    later = np.stack([se2.relative(odometry[7], pose) for pose in odometry])
    answer = again.update(np.asarray(episode.ranges[7]), later[7], 5000.0)
    assert off(answer.pose, episode.poses[7])[0] < 0.15 and answer.localized


def test_a_pose_that_was_not_trusted_is_not_restored(robot, tmp_path):
    robot.save(tmp_path / "pose.json")
    assert not robot.restore(tmp_path / "pose.json")


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (lambda saved: saved.pop("pose"), "not a pose"),
        (lambda saved: saved.update(pose=[1, 2]), "not a pose"),
        (lambda saved: saved.update(covariance=None), "not a pose"),
        (lambda saved: saved.update(pose=[math.nan] * 3), "not a pose"),
        (lambda saved: saved.update(map=[1, 2, 3]), "another map"),
        (lambda saved: saved.update(pose=[1e3, 0, 0]), "nowhere near"),
    ],
)
def test_saved_poses_that_are_none(robot, episode, odometry, tmp_path, spoil, says):
    follow(robot, episode, odometry, range(8))
    robot.save(tmp_path / "pose.json")
    saved = json.loads((tmp_path / "pose.json").read_text())
    spoil(saved)
    (tmp_path / "pose.json").write_text(json.dumps(saved))
    with pytest.raises(UserError, match=says):
        robot.restore(tmp_path / "pose.json")
    with pytest.raises(UserError, match="no such saved pose"):
        robot.restore(tmp_path / "other.json")


def test_the_paper_s_filter_runs_live_but_takes_no_pose(episode, odometry):
    proposal = make_proposal("uniform", tiny_world.grid(), tiny_world.LIDAR, SETTINGS)
    filter = make_filter("mcl", proposal, tiny_world.grid(), tiny_world.LIDAR, SETTINGS)
    robot = Localizer(tiny_world.grid(), tiny_world.LIDAR, seed=3, update_min_d=0.1, update_min_a=0.1, filter=filter)
    batch = run(filter, episode, run_keys(3, 0, 1))
    for t in range(4):
        robot.update(np.asarray(episode.ranges[t]), odometry[t], float(t))
        np.testing.assert_array_equal(robot.info.mean, batch.info.mean[0, t])
    with pytest.raises(TypeError, match="MCL cannot start from a pose"):
        robot.set_pose([0.0, 0.0, 0.0], np.eye(3))
