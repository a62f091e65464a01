"""Messages of ROS to numbers and back, and transforms, against the definitions of ROS; ROS itself is not needed."""

from __future__ import annotations

import math
from types import SimpleNamespace as Message

import numpy as np
import pytest

from dsom_jax.data import se2
from dsom_jax.data.tf_tree import Mount, seconds
from dsom_jax.errors import UserError
from dsom_jax.ros2 import messages
from dsom_jax.ros2.transforms import KEEP, Transforms
from ros2_kit import laser_scan, occupancy, pose, quaternion, stamp, tf, transform

BASE = Mount(0.0, 0.0, 0.0, False, 0.0)


@pytest.mark.parametrize("at", [0.0, 1234.000000001, 1.7e9 + 0.25, -0.5])
def test_stamps_there_and_back(at):
    told = Message(sec=0, nanosec=0)
    messages.set_stamp(told, at)
    assert 0 <= told.nanosec < 10**9 and isinstance(told.sec, int)
    # A double holds 1.7e9 s to 0.24 microseconds.
    assert seconds(told) == pytest.approx(at, abs=5e-7)


def test_ranges_become_rep_117():
    scan = messages.scan_of(laser_scan([0.0, 0.05, 2.0, 9.0, np.inf, np.nan, -np.inf, -1.0], -1.0, 0.25))
    lidar = messages.lidar_of_scan(scan, BASE, 0.1, 8.0)
    expected = [np.nan, -np.inf, 2.0, np.inf, np.inf, np.nan, -np.inf, np.nan]
    np.testing.assert_array_equal(messages.fitted(scan, lidar), np.array(expected, np.float32))
    assert (lidar.range_min, lidar.range_max, lidar.beams) == (0.1, 8.0, 8)


@pytest.mark.parametrize(
    ("least", "most", "told", "expected"),
    [
        (-1, 100, 10, (0.0, 10)),
        (-1, 8, 10, (0.0, 8)),
        (0.5, 25, math.inf, (0.5, 25)),
        (-1, 25, 0, (0.0, 25)),
    ],
)
def test_range_limits_are_those_of_nav2(least, most, told, expected):
    lidar = messages.lidar_of_scan(messages.scan_of(laser_scan([1.0, 2.0], 0.0, 0.1, limit=told)), BASE, least, most)
    assert (lidar.range_min, lidar.range_max) == expected


def test_a_scan_in_degrees_is_refused():
    scan = messages.scan_of(laser_scan(np.ones(180), -90.0, 1.0))
    with pytest.raises(UserError, match="radians"):
        messages.lidar_of_scan(scan, BASE, -1, 25)


def bearing_scan(beams: int, first: float, increment: float) -> messages.Scan:
    """Ranges that say their bearing: 5 + 2 sin(bearing)."""
    bearings = first + increment * np.arange(beams)
    return messages.scan_of(laser_scan(5 + 2 * np.sin(bearings), first, increment))


@pytest.mark.parametrize(
    ("beams", "first", "increment"),
    [
        (90, -math.pi / 2, math.pi / 89),
        (360, -math.pi / 2, math.pi / 359),
        (181, -math.pi / 2 + 0.004, math.pi / 180),
        (181, math.pi / 2, -math.pi / 180),
        (720, 0.0, 2 * math.pi / 720),
        (720, -2 * math.pi, 2 * math.pi / 720),
    ],
)
def test_other_beams_are_taken_from_the_nearest(beams, first, increment):
    lidar = messages.lidar_of_scan(bearing_scan(181, -math.pi / 2, math.pi / 180), BASE, -1, 25)
    ranges = messages.fitted(bearing_scan(beams, first, increment), lidar)
    wanted = lidar.angle_min + lidar.angle_increment * np.arange(181)
    # The nearest beam is half an increment away at most, and the slope of the ranges is 2.
    np.testing.assert_allclose(ranges, 5 + 2 * np.sin(wanted), atol=abs(increment) + 1e-5)


def test_bearings_that_nobody_measured_are_unknown():
    lidar = messages.lidar_of_scan(bearing_scan(181, -math.pi / 2, math.pi / 180), BASE, -1, 25)
    ranges = messages.fitted(bearing_scan(91, -math.pi / 4, math.pi / 180), lidar)
    np.testing.assert_array_equal(np.isfinite(ranges), (np.arange(181) >= 45) & (np.arange(181) <= 135))
    empty = messages.scan_of(laser_scan([], 0.0, 0.0))
    assert np.isnan(messages.fitted(empty, lidar)).all()


def test_same_beams_are_copied():
    scan = bearing_scan(181, -math.pi / 2, math.pi / 180)
    np.testing.assert_array_equal(messages.fitted(scan, messages.lidar_of_scan(scan, BASE, -1, 25)), scan.ranges)


def test_a_map_message_has_row_0_at_the_bottom():
    grid = messages.grid_of(occupancy([[0, 100, -1], [50, 0, 99]], 0.0500000007, pose(1.0, -2.0, 0.5)))
    np.testing.assert_array_equal(grid.occupied, [[0, 1, 0], [0, 0, 0]])
    np.testing.assert_array_equal(grid.free, [[1, 0, 0], [0, 1, 0]])
    assert grid.resolution == 0.05
    np.testing.assert_allclose(grid.origin, [1.0, -2.0, 0.5], atol=1e-6)


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (lambda m: m.data.pop(), "data holds 3 cells"),
        (lambda m: setattr(m.info, "resolution", 0.0), "resolution"),
        (lambda m: m.data.__setitem__(slice(None), [100] * 4), "no cell is free"),
        (lambda m: setattr(m.info.origin.position, "x", math.nan), "origin"),
        (lambda m: setattr(m.info.origin.position, "x", 1e9), "origin"),
    ],
)
def test_a_map_message_that_means_nothing(spoil, says):
    message = occupancy([[0, 0], [0, 0]])
    spoil(message)
    with pytest.raises(UserError, match=says):
        messages.grid_of(message)


def test_poses_there_and_back():
    told = pose()
    messages.set_pose(told, (1.0, -2.0, 2.5))
    covariance = np.arange(36.0)
    read, spread = messages.pose_of(Message(pose=told, covariance=covariance))
    np.testing.assert_allclose(read, [1.0, -2.0, 2.5])
    np.testing.assert_array_equal(spread, [[0, 1, 5], [6, 7, 11], [30, 31, 35]])
    back = messages.covariance36(spread)
    # nav2_amcl fills these five; a full 3 x 3 has four more.
    assert [back[i] for i in (0, 1, 6, 7, 35)] == [0, 1, 6, 7, 35] and np.count_nonzero(back) == 8


@pytest.mark.parametrize("spoil", ["pose", "quaternion", "covariance"])
def test_an_initial_pose_that_means_nothing(spoil):
    told, covariance = pose(), np.zeros(36)
    if spoil == "pose":
        told.position.x = math.inf
    elif spoil == "quaternion":
        told.orientation = Message(x=0.0, y=0.0, z=0.0, w=0.0)
    else:
        covariance[0] = math.nan
    with pytest.raises(UserError, match="initial pose"):
        messages.pose_of(Message(pose=told, covariance=covariance))


def test_map_to_odom_as_a_message():
    blank = transform(0.0, "", "", (0.0, 0.0, 0.0))
    messages.set_transform(blank, "map", "odom", np.array([1.0, 2.0, -3.0]), 7.5)
    tree = Transforms()
    tree.add(tf(blank))
    np.testing.assert_allclose(tree.planar("map", "odom", 7.5), [1.0, 2.0, -3.0])


def drive() -> Transforms:
    """odom -> base_footprint moves, base_footprint -> base_link -> laser is fixed, the laser hangs head down."""
    tree = Transforms()
    base = transform(0, "base_footprint", "base_link", (0.0, 0.0, 0.3))
    laser = transform(0, "/base_link", "/laser", (0.2, -0.1, 0.5), roll=math.pi, yaw=0.7)
    tree.add(tf(base, laser), static=True)
    for n in range(11):
        place = (0.1 * n, 0.0, 0.0)
        tree.add(tf(transform(0.1 * n, "odom", "base_footprint", place, yaw=se2.wrap(np.array(3.0 + 0.1 * n)))))
    return tree


def test_odometry_between_two_transforms():
    # From 3.1 to 3.2 the yaw passes pi.
    np.testing.assert_allclose(drive().planar("odom", "base_footprint", 0.15), [0.15, 0.0, se2.wrap(np.array(3.15))])
    np.testing.assert_allclose(drive().planar("odom", "base_link", 1.0), [1.0, 0.0, se2.wrap(np.array(4.0))])
    back = drive().planar("base_footprint", "odom", 0.15)
    np.testing.assert_allclose(se2.inverse(np.array([0.15, 0.0, 3.15])), back, atol=1e-12)


@pytest.mark.parametrize("at", [-0.01, 1.01])
def test_nothing_is_extrapolated(at):
    assert drive().planar("odom", "base_footprint", at) is None


def test_frames_that_do_not_connect():
    assert drive().planar("map", "base_footprint", 0.5) is None and drive().mount("base_link", "camera", 0.5) is None


def test_a_laser_head_down():
    mount = drive().mount("base_footprint", "laser", 0.5)
    assert mount.upside_down and mount.tilt == pytest.approx(0, abs=1e-6)
    np.testing.assert_allclose([mount.x, mount.y, mount.yaw], [0.2, -0.1, 0.7], atol=1e-12)
    # Its beam at bearing b points where the rotation takes it: yaw - b in the base frame.
    scan = messages.scan_of(laser_scan(np.ones(5), -1.0, 0.5))
    angles = messages.lidar_of_scan(scan, mount, -1, 25).angles()
    q = quaternion(roll=math.pi, yaw=0.7)
    turn = np.array([[1 - 2 * (q.y**2 + q.z**2), 2 * (q.x * q.y - q.z * q.w)],
                     [2 * (q.x * q.y + q.z * q.w), 1 - 2 * (q.x**2 + q.z**2)]])  # fmt: skip
    bearings = -1.0 + 0.5 * np.arange(5)
    directions = turn @ np.stack([np.cos(bearings), np.sin(bearings)])
    np.testing.assert_allclose(np.stack([np.cos(angles), np.sin(angles)]), directions, atol=1e-6)


def test_old_transforms_are_forgotten_and_a_clock_that_is_set_back_is_followed():
    tree = Transforms()
    for at in (0.0, KEEP, 2 * KEEP):
        tree.add(tf(transform(at, "odom", "base", (at, 0.0, 0.0))))
    assert tree.planar("odom", "base", 0.5 * KEEP) is None
    np.testing.assert_allclose(tree.planar("odom", "base", 1.5 * KEEP)[0], 1.5 * KEEP)
    tree.add(tf(transform(2 * KEEP - 0.5, "odom", "base", (-1.0, 0.0, 0.0))))  # late, not set back
    np.testing.assert_allclose(tree.planar("odom", "base", 2 * KEEP)[0], 2 * KEEP)
    tree.add(tf(transform(1.0, "odom", "base", (5.0, 0.0, 0.0))))
    assert tree.planar("odom", "base", 2 * KEEP) is None
    np.testing.assert_allclose(tree.planar("odom", "base", 1.0)[0], 5.0)


def test_transforms_that_are_no_numbers_are_left_out():
    tree = drive()
    tree.add(tf(transform(1.1, "odom", "base_footprint", (math.nan, 0.0, 0.0))))
    np.testing.assert_allclose(tree.planar("odom", "base_footprint", 1.0)[0], 1.0)
    assert tree.planar("odom", "base_footprint", 1.1) is None


def test_stamp_of_the_kit():
    assert seconds(stamp(12.5)) == 12.5
