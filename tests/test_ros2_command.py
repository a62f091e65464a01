"""``python -m dsom_jax.ros2`` without ROS: its arguments, and what it says where ROS is missing."""

from __future__ import annotations

import subprocess
import sys

import pytest

from dsom_jax.ros2.__main__ import missing, split


@pytest.mark.parametrize(
    ("words", "ours", "theirs"),
    [
        (["--map", "m.yaml"], ["--map", "m.yaml"], []),
        (["--autostart", "--ros-args", "-r", "__ns:=/a"], ["--autostart"], ["-r", "__ns:=/a"]),
        (["--ros-args", "-p", "a:=1", "--", "--autostart"], ["--autostart"], ["-p", "a:=1"]),
    ],
)
def test_words_of_ros_are_left_to_ros(words, ours, theirs):
    assert split(words) == (ours, theirs)


def test_where_ros_is_missing_one_line_says_so(tmp_path):
    if not missing():
        pytest.skip("ROS is here")
    done = subprocess.run([sys.executable, "-m", "dsom_jax.ros2"], capture_output=True, text=True, cwd=tmp_path)
    (line,) = done.stderr.splitlines()
    assert done.returncode == 2 and line.startswith("error: ROS 2 is needed") and "rclpy" in line


def test_a_wrong_parameter_file_is_named_before_ros_is_asked_for(tmp_path):
    (tmp_path / "p.yaml").write_text("amcl:\n  ros__parameters:\n    max_beams: many\n")
    words = [sys.executable, "-m", "dsom_jax.ros2", "--params-file", "p.yaml"]
    done = subprocess.run(words, capture_output=True, text=True, cwd=tmp_path)
    assert done.returncode == 2 and "max_beams = 'many'" in done.stderr and len(done.stderr.splitlines()) == 1
