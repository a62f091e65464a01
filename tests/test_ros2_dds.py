"""The node over DDS, in a process of its own, against this process, which plays a drive and judges the answers.

Needs ROS 2's Python packages; ``.ci/ros2`` makes an environment with them, and runs this file there.
"""

from __future__ import annotations

import importlib.util
import json
import math
import os
import random
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
import yaml

if importlib.util.find_spec("rclpy") is None or importlib.util.find_spec("tf2_msgs") is None:
    pytest.skip("ROS 2 is not here; .ci/ros2 runs these tests", allow_module_level=True)

os.environ |= {
    "ROS_DOMAIN_ID": str(random.SystemRandom().randint(1, 100)),
    "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
    "RMW_IMPLEMENTATION": "rmw_fastrtps_cpp",
}

import rclpy
from geometry_msgs.msg import PoseArray, PoseWithCovarianceStamped, TransformStamped
from lifecycle_msgs.srv import ChangeState, GetState
from nav_msgs.msg import OccupancyGrid
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import SetParameters
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from sensor_msgs.msg import LaserScan
from std_srvs.srv import Empty
from tf2_msgs.msg import TFMessage

import tiny_world
from dsom_jax.data import se2
from dsom_jax.filters.settings import REAL
from dsom_jax.lidar import LidarConfig
from dsom_jax.raycast import RaycastConfig, make_tables
from dsom_jax.ros2 import messages
from dsom_jax.ros2.node import optional
from test_ros2_parameters import NAV2

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
MOUNT = (0.1, 0.05, 2.0)
LIDAR = LidarConfig(beams=720, angle_increment=2 * math.pi / 720, range_max=5.0, mount=MOUNT, upside_down=True)
"""Head down, turned and beside the axis: all of it has to come from tf."""
RADIUS, STEPS = 0.6, 240
PLACES = ((2.92, 2.87), (4.3, 1.5))
"""Middles of two circles, in the frame of the tiny room."""
FRAMES = {"odom_frame_id": "robot/odom", "base_frame_id": "robot/base_footprint"}
PARAMETERS = NAV2 | FRAMES | {
    "use_sim_time": False, "min_particles": 200, "update_min_d": 0.1, "update_min_a": 0.1, "random_seed": 4,
    "transform_tolerance": 0.5, "cloud_rate": 5.0,
}  # fmt: skip
TOLERANCE = PARAMETERS["transform_tolerance"]


def circle(place: tuple[float, float]) -> np.ndarray:
    """(STEPS, 3) poses in the map frame, once round."""
    phase = 2 * np.pi * np.arange(STEPS) / STEPS
    x, y = place[0] + RADIUS * np.cos(phase), place[1] + RADIUS * np.sin(phase)
    local = np.stack([x, y, se2.wrap(phase + np.pi / 2)], -1)
    return np.asarray(tiny_world.grid().from_grid(local), np.float64)


class Player:
    """A robot that drives in a circle, and what it hears from the node."""

    def __init__(self) -> None:
        rclpy.init()
        self.node = rclpy.create_node("player")
        grid = tiny_world.grid()
        # The walls of maps made from scans do not begin at the near edge of their cells.
        tables = make_tables(grid, RaycastConfig("exact", surface=REAL.robust_raycast.surface), LIDAR.range_max)
        self.paths = [circle(place) for place in PLACES]
        self.scans = [np.asarray(tiny_world.cast(tables, path, LIDAR)) for path in self.paths]
        self.lock, self.truth, self.sent = threading.Lock(), {}, {}
        self.place, self.step, self.speed, self.rate = 0, 0, 1, 20.0
        self.odometry = np.array([-3.0, 8.0, 1.0])
        self.poses: list = []
        self.transforms: list = []
        self.clouds: list = []
        self.places: list = []
        self.told: list = []
        self._publishers(grid)
        self._subscriptions()
        self.executor = SingleThreadedExecutor()
        self.executor.add_node(self.node)
        self.running = True
        self.threads = [threading.Thread(target=self.executor.spin, daemon=True),
                        threading.Thread(target=self.play, daemon=True)]  # fmt: skip
        for thread in self.threads:
            thread.start()

    def _publishers(self, grid) -> None:
        node = self.node
        self.scan_out = node.create_publisher(LaserScan, "scan", qos_profile_sensor_data)
        self.tf_out = node.create_publisher(TFMessage, "/tf", 100)
        self.initial = node.create_publisher(PoseWithCovarianceStamped, "initialpose", 10)
        self.static_out = node.create_publisher(TFMessage, "/tf_static", LATCHED)
        x, y, yaw = MOUNT
        mount = TransformStamped(child_frame_id="robot/laser")
        mount.header.frame_id = FRAMES["base_frame_id"]
        mount.transform.translation.x, mount.transform.translation.y = x, y
        # Half a turn about x, then the yaw: the quaternion of both.
        mount.transform.rotation.x, mount.transform.rotation.y = math.cos(yaw / 2), math.sin(yaw / 2)
        mount.transform.rotation.w = 0.0
        self.static_out.publish(TFMessage(transforms=[mount]))
        self.map_out = node.create_publisher(OccupancyGrid, "map", LATCHED)
        message = OccupancyGrid()
        message.header.frame_id = "map"
        message.info.height, message.info.width = grid.shape
        message.info.resolution = grid.resolution
        messages.set_pose(message.info.origin, np.asarray(grid.origin))
        message.data = np.where(np.asarray(grid.occupied), 100, 0).astype(np.int8).reshape(-1).tolist()
        self.map_out.publish(message)

    def _subscriptions(self) -> None:
        node = self.node

        def hear(kind, topic, qos, where):
            node.create_subscription(kind, topic, lambda m: where.append((time.time(), m)), qos)

        hear(PoseWithCovarianceStamped, "amcl_pose", LATCHED, self.poses)
        hear(TFMessage, "/tf", 100, self.transforms)
        hear(optional("nav2_msgs/msg", "ParticleCloud") or PoseArray, "particle_cloud", qos_profile_sensor_data,
             self.clouds)  # fmt: skip
        hear(PoseArray, "hypotheses", LATCHED, self.places)
        diagnostics = optional("diagnostic_msgs/msg", "DiagnosticArray")
        if diagnostics:
            hear(diagnostics, "/diagnostics", 10, self.told)

    def play(self) -> None:
        """Scans and odometry at ``rate``, stamped as they are sent."""
        due = time.time()
        while self.running:
            before = self.paths[self.place][self.step]
            self.step = (self.step + self.speed) % STEPS
            pose = self.paths[self.place][self.step]
            self.odometry = se2.compose(self.odometry, se2.relative(before, pose))
            self.send(time.time(), pose, self.scans[self.place][self.step])
            due = max(due + 1 / self.rate, time.time() - 0.1)
            time.sleep(max(due - time.time(), 0.0))

    def send(self, at: float, pose: np.ndarray, ranges: np.ndarray) -> None:
        transform = TransformStamped()
        messages.set_transform(transform, FRAMES["odom_frame_id"], FRAMES["base_frame_id"], self.odometry, at)
        self.tf_out.publish(TFMessage(transforms=[transform]))
        scan = LaserScan(angle_min=LIDAR.angle_min, angle_increment=LIDAR.angle_increment, range_max=LIDAR.range_max)
        messages.set_stamp(scan.header.stamp, at)
        scan.header.frame_id, scan.ranges = "robot/laser", ranges
        with self.lock:
            self.truth[round(at, 6)] = pose, self.odometry
            self.sent[round(at, 6)] = at
        self.scan_out.publish(scan)

    def true_at(self, stamp: float) -> tuple[np.ndarray, np.ndarray]:
        """Pose in the map and of the odometry when the scan of ``stamp`` was sent."""
        with self.lock:
            return self.truth[round(stamp, 6)]

    def carry_off(self) -> None:
        """To the other circle, unnoticed by the odometry."""
        self.place, self.step = 1 - self.place, (self.step + STEPS // 3) % STEPS

    def errors(self, since: float = 0.0) -> list[tuple[float, float]]:
        """Metres and radians that the poses heard since then are off."""
        found = []
        for heard, message in list(self.poses):
            if heard >= since:
                pose, _ = messages.pose_of(message.pose)
                truth, _ = self.true_at(messages.stamp_of(message))
                x, y, turn = se2.relative(truth, pose)
                found.append((math.hypot(x, y), abs(turn)))
        return found

    def map_to_odom(self, since: float = 0.0) -> list[tuple[float, float, np.ndarray]]:
        """(heard, stamp, pose) of the transforms that the node sent."""
        return [
            (heard, messages.stamp_of(t), np.array([
                t.transform.translation.x, t.transform.translation.y,
                2 * math.atan2(t.transform.rotation.z, t.transform.rotation.w)]))
            for heard, message in list(self.transforms)
            for t in message.transforms
            if t.child_frame_id == FRAMES["odom_frame_id"] and heard >= since
        ]  # fmt: skip

    def ask(self, kind, name: str, request, within: float = 90.0):
        """The answer of a service."""
        client = self.node.create_client(kind, name)
        try:
            assert client.wait_for_service(within), f"no service {name}"
            future = client.call_async(request)
            wait_for(future.done, within, f"an answer of {name}")
            return future.result()
        finally:
            self.node.destroy_client(client)

    def transition(self, number: int) -> None:
        request = ChangeState.Request()
        request.transition.id = number
        assert self.ask(ChangeState, "amcl/change_state", request).success

    def found(self, within: float = 120.0) -> float:
        """Wait for three good poses in a row from now on; seconds that it took."""
        start = time.time()

        def good() -> bool:
            errors = self.errors(start)
            return len(errors) >= 3 and all(metres < 0.3 and turn < 0.2 for metres, turn in errors[-3:])

        wait_for(good, within, "three good poses")
        return time.time() - start

    def close(self) -> None:
        self.running = False
        self.threads[1].join(2)
        self.executor.shutdown()
        rclpy.shutdown()


def wait_for(true, within: float, what: str) -> None:
    """Wait until ``true()``."""
    end = time.time() + within
    while not true():
        assert time.time() < end, f"no {what} within {within} s"
        time.sleep(0.05)


@pytest.fixture(scope="module")
def player():
    player = Player()
    yield player
    player.close()


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("node")


@pytest.fixture(scope="module")
def nodes(folder):
    """Starts a node; all of them are ended."""
    started: list[subprocess.Popen] = []

    def start(*words: str, **parameters) -> subprocess.Popen:
        path = folder / f"nav2_params_{len(started)}.yaml"
        path.write_text(yaml.safe_dump({"amcl": {"ros__parameters": PARAMETERS | parameters}}))
        log = (folder / f"node_{len(started)}.log").open("w")
        environment = os.environ | {"ROS_LOG_DIR": str(folder)}
        command = [sys.executable, "-m", "dsom_jax.ros2", "--params-file", str(path), *words]
        started.append(subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT, env=environment))
        return started[-1]

    yield start
    for node in started:
        node.kill()
        node.wait()


@pytest.fixture(scope="module")
def node(nodes, player, folder):
    """A node that a lifecycle manager has configured and activated, and that has found the robot."""
    node = nodes(saved_pose_filepath=str(folder / "pose.json"), save_pose_rate=5.0)
    begun = time.time()
    try:
        player.transition(1)
        configured = time.time() - begun
        player.transition(3)
        wait_for(lambda: player.poses, 400, "a first pose")
    finally:
        print((folder / "node_0.log").read_text())
    print(f"first pose {time.time() - begun:.1f} s after the start, configured after {configured:.1f} s")
    player.found()
    return node


def test_poses_and_transforms_are_those_of_the_robot(node, player):
    start = time.time()
    wait_for(lambda: len(player.errors(start)) >= 10, 30, "ten poses")
    metres, turns = np.array(player.errors(start)).T
    print(f"median error {np.median(metres):.3f} m, {np.median(turns):.3f} rad")
    assert np.median(metres) < 0.1 and np.median(turns) < 0.05
    sent = player.map_to_odom(start)
    assert len(sent) >= len(metres)  # with every scan; a slow machine makes an update of each that it answers
    for _, stamp, map_to_odom in sent:
        pose, odometry = player.true_at(stamp - TOLERANCE)
        x, y, turn = se2.relative(pose, se2.compose(map_to_odom, odometry))
        assert math.hypot(x, y) < 0.5 and abs(turn) < 0.3
    _, message = player.poses[-1]
    covariance = np.array(message.pose.covariance).reshape(6, 6)
    assert message.header.frame_id == "map" and (np.diag(covariance)[[0, 1, 5]] > 0).all()


def test_particles_hypotheses_and_diagnostics(node, player):
    wait_for(lambda: player.clouds and player.places and player.told, 20, "cloud, hypotheses and diagnostics")
    cloud = player.clouds[-1][1]
    particles = getattr(cloud, "particles", None) or cloud.poses
    assert len(particles) == 200 and cloud.header.frame_id == "map"
    if hasattr(cloud, "particles"):
        assert sum(p.weight for p in particles) == pytest.approx(1, abs=1e-3)
    assert len(player.places[-1][1].poses) >= 1
    (status,) = player.told[-1][1].status
    values = {pair.key: pair.value for pair in status.values}
    assert values["verdict"] == status.message == "localized" and status.level == b"\0"
    assert float(values["p_lost"]) < 0.05 and int(values["beams"]) > 600 and float(values["latency_median_ms"]) > 0


def test_a_kidnapped_robot_is_found_again(node, player):
    player.carry_off()
    print(f"found again after {player.found():.1f} s")


def test_looking_everywhere_again(node, player):
    player.ask(Empty, "reinitialize_global_localization", Empty.Request())
    print(f"found again after {player.found():.1f} s")


def test_an_update_although_the_robot_stands(node, player):
    speed, player.speed = player.speed, 0
    try:
        time.sleep(1.0)
        start = time.time()
        time.sleep(1.0)
        assert not player.errors(start)
        player.ask(Empty, "request_nomotion_update", Empty.Request())
        wait_for(lambda: player.errors(start), 10, "a pose of a robot that stands")
    finally:
        player.speed = speed


@pytest.mark.parametrize("by", ["topic", "service"])
def test_an_initial_pose(node, player, by):
    service = optional("nav2_msgs/srv", "SetInitialPose")
    if by == "service" and service is None:
        pytest.skip("nav2_msgs is not here")
    message = PoseWithCovarianceStamped()
    message.header.frame_id = "map"
    at = max(player.truth)
    messages.set_stamp(message.header.stamp, at)
    messages.set_pose(message.pose.pose, player.true_at(at)[0])
    message.pose.covariance = messages.covariance36(np.diag([0.05, 0.05, 0.05]) ** 2)
    start = time.time()
    if by == "topic":
        player.initial.publish(message)
    else:
        request = service.Request()
        request.pose = message
        player.ask(service, "set_initial_pose", request)
    wait_for(lambda: len(player.errors(start)) >= 3, 20, "three poses")
    assert all(metres < 0.3 for metres, _ in player.errors(start))


def test_parameters_while_it_runs(node, player):
    def change(name: str, value: float | int):
        whole = isinstance(value, int)
        kind = ParameterType.PARAMETER_INTEGER if whole else ParameterType.PARAMETER_DOUBLE
        told = ParameterValue(type=kind, **{"integer_value" if whole else "double_value": value})
        request = SetParameters.Request(parameters=[Parameter(name=name, value=told)])
        return player.ask(SetParameters, "amcl/set_parameters", request).results[0]

    assert change("update_min_d", 0.15).successful
    refused = change("max_beams", 30)
    assert not refused.successful and "compiled" in refused.reason
    assert "negative" in change("update_min_d", -1.0).reason


def test_no_answer_is_old_at_forty_scans_a_second(node, player):
    player.rate, player.speed = 40.0, 1
    try:
        time.sleep(1.0)
        start, seconds = time.time(), 5.0
        time.sleep(seconds)
        received = [(heard, stamp - TOLERANCE) for heard, stamp, _ in player.map_to_odom(start)]
        ages = 1e3 * np.array([heard - player.sent[round(stamp, 6)] for heard, stamp in received])
        sent = sum(start <= at <= start + seconds for at in list(player.sent))
    finally:
        player.rate = 20.0
    load = os.getloadavg()[0] / len(os.sched_getaffinity(0))
    print(f"{len(ages)} answers to {sent} scans; age median {np.median(ages):.0f} ms, p99 "
          f"{np.percentile(ages, 99):.0f} ms, greatest {ages.max():.0f} ms; load {load:.1f} per core")  # fmt: skip
    # Whatever the machine, the newest scan is answered next: ages do not grow.
    half = len(ages) // 2
    assert len(ages) > 3 and np.median(ages[half:]) < 2 * np.median(ages[:half]) + 100
    if load < 0.7:
        assert ages.max() < 150


def test_inactive_it_is_silent(node, player):
    player.transition(4)
    time.sleep(0.5)
    start = time.time()
    time.sleep(1.0)
    assert not player.map_to_odom(start)
    assert player.ask(GetState, "amcl/get_state", GetState.Request()).current_state.label == "inactive"
    player.transition(3)
    wait_for(lambda: player.map_to_odom(start), 20, "an answer after activation")


def test_killed_and_started_again_it_knows_where_it_was(node, nodes, player, folder):
    player.found()
    player.speed = 0
    time.sleep(1.0)
    path, stands = str(folder / "pose.json"), time.time()
    wait_for(lambda: json.loads(Path(path).read_text())["stamp"] > stands, 20, "a saved pose of where it stands")
    node.send_signal(signal.SIGKILL)
    node.wait()
    start = time.time()
    nodes("--autostart", saved_pose_filepath=path, initialize_at_saved_pose=True)
    wait_for(lambda: player.errors(start), 400, "a pose after the restart")
    print(f"first pose {time.time() - start:.1f} s after the restart")
    print((folder / "node_1.log").read_text())
    metres, turn = player.errors(start)[0]
    assert metres < 0.5 and turn < 0.3 and f"starts from {path}" in Path(folder / "node_1.log").read_text()
    player.speed = 1
    player.found()
