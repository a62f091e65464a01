"""The transforms of a bag: where the laser is mounted, and odometry where there is no odometry topic."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from dsom_jax.data.trajectory import yaw_of

ODOM_FRAME = "odom"


@dataclass(frozen=True)
class Mount:
    """Pose of the laser on the base: metres, radians; ``tilt`` is the angle between its axis and the vertical."""

    x: float
    y: float
    yaw: float
    upside_down: bool
    tilt: float


def planar(position: Any, orientation: Any) -> tuple[float, float, float]:
    """(x, y, yaw) of a ROS position and quaternion."""
    return position.x, position.y, float(yaw_of(np.array([orientation.x, orientation.y, orientation.z, orientation.w])))


def matrix(translation: Any, rotation: Any) -> np.ndarray:
    """Homogeneous (4, 4) of a ROS translation and quaternion."""
    q = np.array([rotation.x, rotation.y, rotation.z, rotation.w], float)
    x, y, z, w = q / (np.linalg.norm(q) or 1.0)
    out = np.eye(4)
    out[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    out[:3, 3] = translation.x, translation.y, translation.z
    return out


@dataclass
class TfTree:
    """Frames of a robot. ``parents`` holds, by child frame, the parent and the first transform seen (4, 4);
    ``drives`` the rows (stamp, x, y, yaw) of each child of the odometry frame."""

    parents: dict[str, tuple[str, np.ndarray]] = field(default_factory=dict)
    drives: dict[str, list[list[float]]] = field(default_factory=dict)

    def add(self, message: Any) -> None:
        """Enter a tf2_msgs/TFMessage."""
        for stamped in message.transforms:
            # tf of ROS 1 wrote a leading slash.
            parent, child = stamped.header.frame_id.lstrip("/"), stamped.child_frame_id.lstrip("/")
            transform = stamped.transform
            self.parents.setdefault(child, (parent, matrix(transform.translation, transform.rotation)))
            if parent == ODOM_FRAME:
                stamp = stamped.header.stamp.sec + 1e-9 * stamped.header.stamp.nanosec
                row = [stamp, *planar(transform.translation, transform.rotation)]
                self.drives.setdefault(child, []).append(row)

    def base_frame(self) -> str:
        """The frame that moves in the odometry frame, ``base_link`` where none does."""
        return next(iter(self.drives), "base_link")

    def odometry_rows(self, base: str) -> np.ndarray:
        """Odometry (M, 4) = (stamp, x, y, yaw) of the base."""
        return np.array(self.drives.get(base.lstrip("/"), []), float).reshape(-1, 4)

    def _ancestors(self, frame: str) -> dict[str, np.ndarray]:
        """Pose (4, 4) of ``frame`` in itself and in each frame above it, up to the odometry frame."""
        pose, chain = np.eye(4), {frame: np.eye(4)}
        while frame in self.parents and frame not in self.drives:
            parent, transform = self.parents[frame]
            if parent in chain:
                break
            pose, frame = transform @ pose, parent
            chain[frame] = pose
        return chain

    def mount(self, base: str, laser: str) -> Mount | None:
        """Where the laser frame sits in the base frame; None if the transforms do not connect them."""
        base_chain, laser_chain = self._ancestors(base.lstrip("/")), self._ancestors(laser.lstrip("/"))
        common = next((frame for frame in laser_chain if frame in base_chain), None)
        if common is None:
            return None
        pose = np.linalg.inv(base_chain[common]) @ laser_chain[common]
        axis = float(np.clip(pose[2, 2], -1.0, 1.0))
        yaw = float(np.arctan2(pose[1, 0], pose[0, 0]))
        return Mount(float(pose[0, 3]), float(pose[1, 3]), yaw, axis < 0, float(np.arccos(abs(axis))))
