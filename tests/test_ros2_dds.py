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

from geometry_msgs.msg import PoseWithCovarianceStamped
from lifecycle_msgs.srv import GetState
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import SetParameters
from std_srvs.srv import Empty

from dsom_jax.data import se2
from dsom_jax.ros2 import messages
from dsom_jax.ros2.node import optional
from fixtures.ros2_player import FRAMES, Player, wait_for
from test_ros2_parameters import NAV2

PARAMETERS = NAV2 | FRAMES | {
    "use_sim_time": False, "min_particles": 200, "update_min_d": 0.1, "update_min_a": 0.1, "random_seed": 4,
    "transform_tolerance": 0.5, "cloud_rate": 5.0,
}  # fmt: skip
TOLERANCE = PARAMETERS["transform_tolerance"]


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
