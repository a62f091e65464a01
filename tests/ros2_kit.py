"""Messages with the fields of ROS's, made without ROS."""

from __future__ import annotations

import math
from types import SimpleNamespace as Message
from typing import Any

import numpy as np


def stamp(seconds: float) -> Message:
    """builtin_interfaces/Time."""
    return Message(sec=math.floor(seconds), nanosec=round((seconds - math.floor(seconds)) * 1e9))


def header(seconds: float, frame: str) -> Message:
    return Message(stamp=stamp(seconds), frame_id=frame)


def quaternion(roll: float = 0.0, pitch: float = 0.0, yaw: float = 0.0) -> Message:
    """Of roll, pitch and yaw, in this order about fixed axes."""
    (sr, cr), (sp, cp), (sy, cy) = ((math.sin(a / 2), math.cos(a / 2)) for a in (roll, pitch, yaw))
    return Message(
        x=sr * cp * cy - cr * sp * sy,
        y=cr * sp * cy + sr * cp * sy,
        z=cr * cp * sy - sr * sp * cy,
        w=cr * cp * cy + sr * sp * sy,
    )


def transform(seconds: float, parent: str, child: str, xyz: Any, **angles: float) -> Message:
    """geometry_msgs/TransformStamped."""
    x, y, z = xyz
    moved = Message(translation=Message(x=x, y=y, z=z), rotation=quaternion(**angles))
    return Message(header=header(seconds, parent), child_frame_id=child, transform=moved)


def tf(*transforms: Message) -> Message:
    """tf2_msgs/TFMessage."""
    return Message(transforms=list(transforms))


def laser_scan(ranges: Any, angle_min: float, increment: float, seconds: float = 0.0, limit: float = 10.0) -> Message:
    """sensor_msgs/LaserScan."""
    return Message(header=header(seconds, "laser"), ranges=ranges, angle_min=angle_min, angle_increment=increment,
                   range_min=0.0, range_max=limit)  # fmt: skip


def pose(x: float = 0.0, y: float = 0.0, yaw: float = 0.0) -> Message:
    """geometry_msgs/Pose."""
    return Message(position=Message(x=x, y=y, z=0.0), orientation=quaternion(yaw=yaw))


def occupancy(cells: Any, resolution: float = 0.05, origin: Message | None = None) -> Message:
    """nav_msgs/OccupancyGrid of (H, W) numbers."""
    height, width = np.shape(cells)
    info = Message(width=width, height=height, resolution=resolution, origin=origin or pose())
    return Message(info=info, data=np.asarray(cells, np.int8).reshape(-1).tolist())
