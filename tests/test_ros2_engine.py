"""What the node does with scans, maps and poses, with a filter that only writes down what it is asked."""

from __future__ import annotations

import math
import threading

import numpy as np
import pytest

from dsom_jax.data import se2
from dsom_jax.errors import UserError
from dsom_jax.live import NOWHERE
from dsom_jax.ros2.engine import Engine
from dsom_jax.ros2.messages import grid_of, scan_of
from dsom_jax.ros2.parameters import Parameters
from ros2_kit import laser_scan, occupancy, pose, tf, transform

OFFSET = np.array([10.0, -5.0, 1.0])
"""Pose of the odometry frame in the map, as the filter below believes it."""


OTHER = grid_of(occupancy([[0, 0, 0]]))
"""Another map than that of :meth:`Robot.ready`."""


class Filter:
    """In place of a Localizer: always at OFFSET from the odometry."""

    made: list  # type: ignore[type-arg]

    def __init__(self, grid, lidar, settings, seed, *, update_min_d, update_min_a):
        self.grid, self.lidar, self.settings, self.seed = grid, lidar, settings, seed
        self.update_min_d, self.update_min_a = update_min_d, update_min_a
        self.calls, self.last, self.trusted = [], NOWHERE, True
        self.made.append(self)
        self.meanwhile()

    def meanwhile(self):
        """What happens while the filter is made, which takes its time."""

    def update(self, ranges, odometry, stamp):
        self.calls.append(("update", stamp, tuple(np.round(odometry, 6))))
        pose = se2.compose(OFFSET, np.asarray(odometry))
        verdict = "localized" if self.trusted else "lost"
        self.last = NOWHERE._replace(stamp=stamp, pose=pose, covariance=np.eye(3), verdict=verdict, updated=True)
        return self.last

    def answer(self):
        return self.last

    def set_pose(self, pose, covariance, odometry=None):
        self.calls.append(("set_pose", tuple(np.round(pose, 6)), tuple(np.round(odometry, 6))))
        if pose[0] > 1000:
            raise UserError("nowhere near free space")

    def relocalize(self):
        self.calls.append(("relocalize",))

    def force(self):
        self.calls.append(("force",))

    def save(self, path):
        path.write_text("saved")

    def restore(self, path):
        self.calls.append(("restore", path))
        if not path.endswith("good.json"):
            raise UserError("not a pose")
        return True


class Robot:
    """An engine, and a robot that drives 0.1 m between two scans."""

    def __init__(self, **parameters):
        self.said = []
        self.kind = type("Kind", (Filter,), {"made": []})
        self.engine = Engine(Parameters(**parameters), lambda level, text: self.said.append(text), self.kind)
        static = (transform(0, "base_footprint", "laser", (0.1, 0.0, 0.2)),)
        self.engine.hear_transforms(tf(*static), True)
        self.t = 0

    def ready(self):
        """With a map, active, and with its filter made."""
        self.engine.hear_map(grid_of(occupancy([[0, 100], [0, 0]])))
        self.engine.activate()
        assert self.drive() is None
        return self

    @property
    def filter(self):
        return self.kind.made[-1]

    def move(self):
        self.t += 1
        self.engine.hear_transforms(tf(transform(self.t, "odom", "base_footprint", (0.1 * self.t, 0, 0))), False)

    def see(self, at=None):
        message = laser_scan(np.ones(8), -1.0, 0.25, self.t if at is None else at)
        self.engine.hear_scan(scan_of(message))

    def drive(self):
        """A transform, a scan and what is made of them."""
        self.move()
        self.see()
        return self.engine.step()


def test_an_answer_is_map_to_odom():
    robot = Robot().ready()
    output = robot.drive()
    np.testing.assert_allclose(output.map_to_odom, OFFSET, atol=1e-12)
    np.testing.assert_allclose(output.answer.pose, se2.compose(OFFSET, np.array([0.2, 0.0, 0.0])))
    assert output.beams == 8 and output.latency >= 0 and robot.filter.lidar.mount[:2] == (0.1, 0.0)
    assert robot.filter.lidar.range_max == 10 and robot.engine.counts.answered == 1


def test_nothing_without_map_or_while_inactive():
    robot = Robot()
    assert robot.drive() is None and robot.drive() is None and not robot.kind.made
    robot.engine.activate()
    assert robot.drive() is None and not robot.kind.made
    robot.engine.hear_map(grid_of(occupancy([[0, 0]])))
    assert robot.drive() is None and robot.drive() is not None
    robot.engine.deactivate()
    assert robot.drive() is None
    robot.engine.activate()
    assert robot.drive() is not None and len(robot.kind.made) == 1


def test_scans_are_dropped_and_never_queued():
    robot = Robot().ready()
    for _ in range(50):
        robot.move()
        robot.see()
    output = robot.engine.step()
    assert output.answer.stamp == robot.t and robot.engine.step() is None
    counts = robot.engine.counts
    assert (counts.received, counts.answered, counts.dropped) == (51, 1, 49)


def test_a_scan_waits_for_its_odometry():
    robot = Robot().ready()
    robot.see(robot.t + 0.5)
    robot.see(robot.t + 1.5)
    assert robot.engine.step() is None
    robot.move()
    output = robot.engine.step()
    # Half way between two transforms; the later scan still waits.
    assert output.answer.stamp == robot.t - 0.5 and robot.filter.calls[-1][2] == (0.15, 0, 0)
    robot.move()
    assert robot.engine.step().answer.stamp == robot.t - 0.5
    assert robot.engine.counts.dropped == 0


def test_without_odometry_it_says_why():
    robot = Robot(odom_frame_id="odometry").ready()
    for _ in range(40):
        assert robot.drive() is None
    assert [text for text in robot.said if "no transform odometry -> base_footprint" in text]
    assert len(robot.said) == len(set(robot.said))


def test_without_a_mount_it_says_why():
    robot = Robot()
    robot.engine = Engine(Parameters(), lambda level, text: robot.said.append(text), robot.kind)
    robot.ready()
    assert not robot.kind.made and "no transform base_footprint -> laser yet" in robot.said[-1]


@pytest.mark.parametrize("publish_while_lost", [True, False])
def test_while_not_localized_the_last_trusted_transform_or_none(publish_while_lost):
    robot = Robot(publish_while_lost=publish_while_lost).ready()
    robot.filter.trusted = False
    assert robot.drive().map_to_odom is None
    robot.filter.trusted = True
    assert robot.drive().map_to_odom is not None
    robot.filter.trusted = False
    last = robot.drive().map_to_odom
    assert (last is not None) == publish_while_lost
    robot.engine.look_everywhere()
    assert robot.drive().map_to_odom is None and ("relocalize",) in robot.filter.calls


def test_an_initial_pose_is_moved_on_by_the_odometry_since():
    robot = Robot()
    robot.engine.hear_pose(np.array([1.0, 2.0, 0.3]), np.eye(3), 1.0)  # while inactive: kept
    robot.ready()
    robot.drive()
    assert robot.filter.calls[0] == ("set_pose", (1.0, 2.0, 0.3), (0.1, 0.0, 0.0))
    robot.engine.hear_pose(np.array([1.0, 2.0, 0.3]), np.eye(3), 0.0)
    robot.drive()
    assert robot.filter.calls[-2] == ("set_pose", (1.0, 2.0, 0.3), (0.3, 0.0, 0.0))
    robot.engine.hear_pose(np.array([2000.0, 2.0, 0.3]), np.eye(3), 0.0)
    assert robot.drive() is not None and "nowhere near" in robot.said[-1]


def test_services():
    robot = Robot().ready()
    robot.engine.use_next()
    robot.drive()
    robot.engine.look_everywhere()
    robot.drive()
    assert [call[0] for call in robot.filter.calls] == ["force", "update", "relocalize", "update"]


def test_an_initial_pose_of_the_parameters():
    robot = Robot(set_initial_pose=True, initial_pose_x=3.0, initial_pose_yaw=0.5).ready()
    robot.drive()
    assert robot.filter.calls[0][:2] == ("set_pose", (3.0, 0.0, 0.5))
    robot.engine.deactivate()
    robot.engine.activate()
    robot.drive()
    assert "relocalize" not in [call[0] for call in robot.filter.calls]


def test_the_pose_is_forgotten_on_activation_if_asked_for():
    robot = Robot(always_reset_initial_pose=True).ready()
    robot.drive()
    robot.engine.deactivate()
    robot.engine.activate()
    robot.drive()
    assert [call[0] for call in robot.filter.calls] == ["update", "relocalize", "update"]


@pytest.mark.parametrize("name", ["good.json", "bad.json"])
def test_a_saved_pose(tmp_path, name):
    path = str(tmp_path / name)
    robot = Robot(saved_pose_filepath=path, initialize_at_saved_pose=True, set_initial_pose=True).ready()
    robot.drive()
    kinds = [call[0] for call in robot.filter.calls]
    assert kinds == (["restore", "update"] if name == "good.json" else ["restore", "set_pose", "update"])
    assert (tmp_path / name).read_text() == "saved"


def test_another_map_takes_the_pose_along_unless_the_first_counts():
    robot = Robot().ready()
    robot.drive()
    robot.engine.hear_map(OTHER)
    robot.kind.meanwhile = lambda new: [robot.move() for _ in range(20)]
    assert robot.drive() is None and len(robot.kind.made) == 2 and robot.filter.grid.shape == (1, 3)
    robot.drive()
    # It has driven 2.4 m in all, and is where it is: 22 of 24 steps of that while the filter was made.
    now = np.array([2.4, 0, 0])
    assert robot.filter.calls[0] == ("set_pose", tuple(np.round(se2.compose(OFFSET, now), 6)), tuple(now))
    assert [call[0] for call in robot.filter.calls] == ["set_pose", "update"]
    robot.drive()
    assert [call[0] for call in robot.filter.calls] == ["set_pose", "update", "update"]
    first = Robot(first_map_only=True).ready()
    first.engine.hear_map(OTHER)
    assert first.drive() is not None and len(first.kind.made) == 1 and "first_map_only" in first.said[-1]


def test_the_same_map_again_changes_nothing():
    robot = Robot().ready()
    robot.drive()
    robot.engine.hear_map(grid_of(occupancy([[0, 100], [0, 0]])))
    assert robot.drive() is not None and len(robot.kind.made) == 1
    for cells, where in (([[0, 0], [0, 0]], {}), ([[0, 0], [0, 0]], {"resolution": 0.1}),
                         ([[0, 0], [0, 0]], {"resolution": 0.1, "origin": pose(1.0)})):  # fmt: skip
        robot.engine.hear_map(grid_of(occupancy(cells, **where)))
        made = len(robot.kind.made)
        assert robot.drive() is None and len(robot.kind.made) == made + 1


@pytest.mark.parametrize("localized", [True, False])
def test_a_pose_told_while_another_map_is_built_is_kept(localized):
    robot = Robot().ready()
    robot.filter.trusted = localized
    robot.drive()

    def meanwhile(new):
        robot.engine.hear_pose(np.array([1.0, 2.0, 0.3]), np.eye(3), float(robot.t))
        for _ in range(20):  # longer than transforms are kept
            robot.move()

    robot.kind.meanwhile = meanwhile
    robot.engine.hear_map(OTHER)
    robot.drive()
    robot.drive()
    # Where the robot was when the pose was told: at the third step.
    assert robot.filter.calls[0] == ("set_pose", (1.0, 2.0, 0.3), (0.3, 0.0, 0.0))
    assert [call[0] for call in robot.filter.calls] == ["set_pose", "update"]


def test_a_robot_that_was_lost_on_the_map_before_is_looked_for():
    robot = Robot().ready()
    robot.drive()
    robot.engine.look_everywhere()
    robot.engine.hear_map(OTHER)
    robot.drive()
    robot.drive()
    assert [call[0] for call in robot.filter.calls] == ["relocalize", "update"]


def test_a_pose_told_while_the_saved_one_is_read_is_kept(tmp_path):
    robot = Robot(saved_pose_filepath=str(tmp_path / "bad.json"), initialize_at_saved_pose=True)

    def restore(filter, path):
        robot.engine.hear_pose(np.array([1.0, 2.0, 0.3]), np.eye(3), 0.0)
        raise UserError("not a pose")

    robot.kind.restore = restore
    robot.ready().drive()
    assert robot.filter.calls[0][:2] == ("set_pose", (1.0, 2.0, 0.3))


def test_changes_reach_the_filter():
    robot = Robot().ready()
    robot.engine.parameters = Parameters(update_min_d=0.7)
    robot.drive()
    assert robot.filter.update_min_d == 0.7


def test_a_scan_that_means_nothing_is_told_once():
    robot = Robot()
    robot.engine.hear_map(grid_of(occupancy([[0, 0]])))
    robot.engine.activate()
    for _ in range(3):
        robot.move()
        robot.engine.hear_scan(scan_of(laser_scan(np.ones(180), -90.0, 1.0, robot.t)))
        assert robot.engine.step() is None
    assert not robot.kind.made and len([text for text in robot.said if "radians" in text]) == 1


def test_scans_of_another_laser_are_left_out():
    robot = Robot().ready()
    robot.move()
    other = laser_scan(np.ones(8), -1.0, 0.25, robot.t)
    other.header.frame_id = "laser_2"
    robot.engine.hear_scan(scan_of(other))
    assert robot.engine.step() is None and "laser_2" in robot.said[-1]


def test_the_worker_answers_and_ends():
    robot = Robot().ready()
    answers, got = [], threading.Event()
    worker = threading.Thread(target=robot.engine.run, args=(lambda o: (answers.append(o), got.set()),))
    worker.start()
    robot.move()
    robot.see()
    assert got.wait(10) and not math.isnan(answers[0].answer.pose[0])
    robot.engine.stop()
    worker.join(10)
    assert not worker.is_alive()
