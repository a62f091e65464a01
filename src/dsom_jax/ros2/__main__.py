"""``python -m dsom_jax.ros2``: the node in place of nav2_amcl."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

from dsom_jax.cli import parse
from dsom_jax.data import load_map
from dsom_jax.errors import UserError, run_cli
from dsom_jax.ros2 import parameters

_NEEDED = ("rclpy", "sensor_msgs", "nav_msgs", "geometry_msgs", "std_srvs", "tf2_msgs", "lifecycle_msgs")
_ROS = "--ros-args"


@dataclass(frozen=True)
class NodeArgs:
    """Localize one robot: a ROS 2 node with the topics, services and parameters of nav2_amcl.

    Whatever follows --ros-args is ROS's own, such as -r __ns:=/robot or -p update_min_d:=0.1.
    """

    params_file: Path | None = None
    """ROS parameter file with a section amcl, such as nav2's own."""
    map: Path | None = None
    """Map in place of the map topic: a ROS map_server YAML, or a drawing."""
    name: str = "amcl"
    """Name of the node, and of its section in the parameter file."""
    autostart: bool = False
    """Configure and activate at once, where no lifecycle manager does."""


def main() -> None:
    """Command line."""
    own, of_ros = split(sys.argv[1:])
    sys.argv[1:] = own
    args = parse(NodeArgs, "python -m dsom_jax.ros2")
    if args.params_file is not None:
        parameters.understood(parameters.read_file(args.params_file, args.name))
        of_ros = ["--params-file", str(args.params_file), *of_ros]
    lacking = missing()
    if lacking:
        raise UserError(
            f"ROS 2 is needed, and Python does not find {', '.join(lacking)}: source /opt/ros/DISTRO/setup.bash, and "
            "start with a Python of that version; docs/ros2.md says more"
        )
    grid = None if args.map is None else load_map(args.map)
    from dsom_jax.ros2.node import spin

    spin([_ROS, *of_ros], args.name, grid, args.autostart)


def split(words: list[str]) -> tuple[list[str], list[str]]:
    """Our own words, and those of ROS between ``--ros-args`` and ``--``."""
    if _ROS not in words:
        return words, []
    at = words.index(_ROS)
    ours, theirs = words[:at], words[at + 1 :]
    if "--" in theirs:
        end = theirs.index("--")
        ours, theirs = ours + theirs[end + 1 :], theirs[:end]
    return ours, theirs


def missing() -> list[str]:
    """Packages of ROS that Python does not find."""
    return [name for name in _NEEDED if find_spec(name) is None]


if __name__ == "__main__":
    run_cli(main)
