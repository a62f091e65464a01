"""Cutting logs: thinning, segments, splicing; the checks on the lidar; the choice of a reader."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dsom_jax import geometry
from dsom_jax.data import check_lidar, load_log, se2, segment_indices, segments, splice, thin, to_episode
from dsom_jax.data.log import RawLog, Report, limit_ranges, travelled
from dsom_jax.errors import UserError
from dsom_jax.lidar import LidarConfig


def make_log(odometry: np.ndarray, beams: int = 4) -> RawLog:
    n = len(odometry)
    ranges = np.arange(n * beams, dtype=np.float32).reshape(n, beams) / 100 + 1
    lidar = LidarConfig(beams=beams, range_max=1e4)
    return RawLog(ranges, np.asarray(odometry, float), 1e9 + 0.1 * np.arange(n), lidar, report=Report())


def drive(seed: int, n: int = 200) -> np.ndarray:
    """A random drive far from the origin of its odometry frame."""
    rng = np.random.default_rng(seed)
    poses = np.zeros((n, 3))
    poses[0] = [5000.0, -3000.0, 3.0]
    for k in range(1, n):
        poses[k] = se2.compose(poses[k - 1], np.array([rng.uniform(0, 0.1), 0.0, rng.normal(0, 0.08)]))
    return poses


def test_thin_literal() -> None:
    x = [0.0, 0.125, 0.24, 0.25, 0.375, 0.5, 0.5, 0.5]
    theta = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.125, 0.25]
    log = make_log(np.column_stack([x, np.zeros(8), theta]))
    np.testing.assert_array_equal(thin(log, 0.25, 0.25), [0, 3, 5, 7])
    np.testing.assert_array_equal(thin(log, 0.0, 0.0), np.arange(8))
    np.testing.assert_array_equal(thin(make_log(np.zeros((0, 3))), 0.25, 0.25), [])


def test_thin_counts_turns_over_pi() -> None:
    log = make_log(np.column_stack([np.zeros((3, 2)), [3.1, -3.1, -2.9]]))
    # 3.1 -> -3.1 is a turn of 0.083 only.
    np.testing.assert_array_equal(thin(log, 0.25, 0.2), [0, 2])


@given(seed=st.integers(0, 1000), d=st.floats(0.01, 1.0), a=st.floats(0.01, 1.0))
@settings(max_examples=40, deadline=None)
def test_thin_uses_a_scan_exactly_when_the_robot_has_moved(seed: int, d: float, a: float) -> None:
    log = make_log(drive(seed))
    used = thin(log, d, a)
    owner = used[np.searchsorted(used, np.arange(len(log)), side="left") - 1]
    moved = se2.relative(log.odometry[owner], log.odometry)
    due = (np.hypot(moved[:, 0], moved[:, 1]) >= d) | (np.abs(moved[:, 2]) >= a)
    due[0] = True
    np.testing.assert_array_equal(np.flatnonzero(due), used)


def test_negative_thresholds() -> None:
    with pytest.raises(UserError, match="update_min_d = -1"):
        thin(make_log(drive(0)), -1.0, 0.2)


def test_episode_increments_lead_along_the_odometry() -> None:
    log = replace(make_log(drive(1)), reference=drive(2))
    used = thin(log, 0.25, 0.2)
    episode = to_episode(log, used)
    assert episode.ranges.dtype == episode.odometry.dtype == episode.stamps.dtype == jnp.float32
    np.testing.assert_array_equal(episode.odometry[0], 0)
    pose = np.array([0.0, 0.0, 0.0])
    for step in np.asarray(episode.odometry, float):
        pose = se2.compose(pose, step)
    expected = se2.relative(log.odometry[used[0]], log.odometry[used[-1]])
    # Each increment is rounded to float32 once: 6e-8 of at most 0.4 m or rad, levered by the length of the drive.
    tolerance = len(used) * 0.4 * 6e-8 * (1 + travelled(log.odometry))
    np.testing.assert_allclose(se2.relative(pose, expected), 0, atol=tolerance)
    np.testing.assert_allclose(episode.stamps, log.stamps[used] - log.stamps[used[0]], atol=1e-5)
    np.testing.assert_allclose(episode.poses, log.reference[used], rtol=1e-6)
    np.testing.assert_array_equal(episode.ranges, log.ranges[used])
    assert not episode.kidnapped.any()


def test_se2_agrees_with_the_geometry_of_the_filters() -> None:
    a, b = drive(3)[:50] - [5000, -3000, 0], drive(4)[50:100] - [5000, -3000, 0]
    for mine, theirs in ((se2.compose, geometry.compose), (se2.relative, geometry.relative)):
        difference = mine(a, b) - np.asarray(theirs(jnp.asarray(a), jnp.asarray(b)))
        difference[:, 2] = se2.wrap(difference[:, 2])
        np.testing.assert_allclose(difference, 0, atol=1e-5)
    np.testing.assert_allclose(se2.compose(a, se2.inverse(a)), 0, atol=1e-12)


def test_poses_are_unknown_without_a_reference() -> None:
    assert np.isnan(to_episode(make_log(drive(0)), np.arange(5)).poses).all()


def test_contiguous_segments() -> None:
    log = make_log(drive(0))
    used = thin(log, 0.25, 0.2)
    rows = segment_indices(log, 3)
    np.testing.assert_array_equal(rows.ravel(), used[: 3 * (len(used) // 3)])
    assert [len(e.stamps) for e in segments(log, 3)] == [len(used) // 3] * 3


@pytest.mark.parametrize("count", [1, 4, 7])
def test_segments_of_given_length_are_spread_over_the_log(count: int) -> None:
    log = make_log(drive(0))
    used = thin(log, 0.25, 0.2)
    rows = segment_indices(log, count, steps_per_segment=10)
    assert rows.shape == (count, 10) and rows[0, 0] == used[0]
    assert count == 1 or rows[-1, -1] == used[-1]
    starts = np.searchsorted(used, rows[:, 0])
    assert count == 1 or np.ptp(np.diff(starts)) <= 1
    for row, start in zip(rows, starts, strict=True):
        np.testing.assert_array_equal(row, used[start : start + 10])
    # More than there is: the whole log.
    assert segment_indices(log, count, steps_per_segment=10**6).shape == (count, len(used))


@pytest.mark.parametrize(
    ("count", "steps", "message"), [(0, None, "segments = 0"), (500, None, "too few"), (2, 1, "steps_per_segment = 1")]
)
def test_impossible_segments(count: int, steps: int | None, message: str) -> None:
    with pytest.raises(UserError, match=message):
        segments(make_log(drive(0)), count, steps)


def test_splice_is_a_kidnapping() -> None:
    log = replace(make_log(drive(5)), reference=drive(5))
    a, b = segments(log, 2, steps_per_segment=12)
    # A piece cut from the middle would bring its own increment along: it must not be felt.
    b = b._replace(odometry=b.odometry.at[0].set(1.0))
    both = splice(a, b)
    np.testing.assert_array_equal(np.flatnonzero(both.kidnapped), [12])
    np.testing.assert_array_equal(both.odometry[12], 0)
    np.testing.assert_array_equal(both.odometry[13:], b.odometry[1:])
    np.testing.assert_array_equal(both.poses[12:], b.poses)
    np.testing.assert_array_equal(both.ranges[:12], a.ranges)
    assert (np.diff(both.stamps) > 0).all() and both.stamps[0] == 0


def test_splice_of_two_lidars() -> None:
    a = to_episode(make_log(drive(0)), np.arange(5))
    b = to_episode(make_log(drive(0), beams=6), np.arange(5))
    with pytest.raises(UserError, match="4 and 6 beams"):
        splice(a, b)


def test_ranges_follow_rep_117() -> None:
    ranges = [0.05, 0.1, 9.99, 10.0, 10.01, np.inf, -np.inf, np.nan, 0.0, -3.0]
    expected = [-np.inf, 0.1, 9.99, np.inf, np.inf, np.inf, -np.inf, np.nan, np.nan, np.nan]
    np.testing.assert_array_equal(limit_ranges(np.array(ranges), 0.1, 10.0), np.array(expected, np.float32))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda log: replace(log, ranges=log.ranges * np.nan), "every range of every scan is NaN"),
        (lambda log: replace(log, ranges=log.ranges * np.inf), "no beam returns within"),
        (lambda log: make_log(np.zeros((0, 3))), "holds no scan"),
        (lambda log: replace(log, lidar=LidarConfig(beams=360)), "wrong lidar for the log.*4 beams.*beams = 360"),
    ],
)
def test_hopeless_lidars(change, message: str) -> None:
    with pytest.raises(UserError, match=message):
        check_lidar(change(make_log(drive(0))))


def test_blind_scans_are_reported() -> None:
    log = make_log(drive(0))
    log.ranges[3] = np.nan
    check_lidar(log)
    assert log.report.counts == {"scans in which every range is NaN": 1}


def test_load_log_chooses_by_suffix(tmp_path: Path) -> None:
    line = "FLASER 3 1 2 3 0 0 0 0 0 0 1.0 host 1.0\n"
    for name in ("a.log", "b.CLF"):
        (tmp_path / name).write_text(line)
        assert len(load_log(tmp_path / name)) == 1
    shutil.copy(tmp_path / "a.log", tmp_path / "a.txt")
    with pytest.raises(UserError, match=r"unknown kind of log '.txt'; readable are .*\.clf.*\.mcap"):
        load_log(tmp_path / "a.txt")
    with pytest.raises(UserError, match=r"without metadata\.yaml"):
        load_log(tmp_path)
    with pytest.raises(UserError, match="range_max = 0"):
        load_log(tmp_path / "a.log", range_max=0.0)
    for name in ("no.log", "no.bag", "no.mcap"):
        with pytest.raises(UserError, match="no such"):
            load_log(tmp_path / name)
    (tmp_path / "a.tum").write_text("1.0 7 8 0 0 0 0 1\n")
    np.testing.assert_array_equal(load_log(tmp_path / "a.log", reference=tmp_path / "a.tum").reference, [[7, 8, 0]])


def test_all_nan_log_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "a.log").write_text("FLASER 3 nan nan nan 0 0 0 0 0 0 1.0 host 1.0\n")
    with pytest.raises(UserError, match="every range of every scan is NaN"):
        load_log(tmp_path / "a.log")
