"""ROS messages to numbers and back, without ROS: any object with the fields of the message will do."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from dsom_jax.data.files import FAR
from dsom_jax.data.log import limit_ranges
from dsom_jax.data.ros2_messages import covariance36 as covariance36
from dsom_jax.data.tf_tree import Mount, planar, stamp_of
from dsom_jax.data.trajectory import yaw_of
from dsom_jax.errors import UserError
from dsom_jax.lidar import LidarConfig
from dsom_jax.occupancy import OccupancyGrid, from_cells

_FREE, _OCCUPIED = 0, 100
"""Of nav_msgs/OccupancyGrid, as nav2_amcl takes them: whatever lies between is unknown."""
_SAME_BEARING = 1e-3
"""Radians by which a driver may move its beams before they count as others."""


@dataclass(frozen=True)
class Scan:
    """A LaserScan.

    Attributes:
        stamp: seconds.
        frame: of the sensor.
        ranges: (B,) float32 metres as the driver wrote them.
        angle_min, angle_increment: bearings of the beams in the sensor frame, radians.
        range_min, range_max: metres.
    """

    stamp: float
    frame: str
    ranges: np.ndarray
    angle_min: float
    angle_increment: float
    range_min: float
    range_max: float


def set_stamp(stamp: Any, at: float) -> None:
    """Write seconds, which may be negative, into a builtin_interfaces/Time."""
    nanoseconds = round(at * 1e9)
    stamp.sec, stamp.nanosec = nanoseconds // 10**9, nanoseconds % 10**9


def scan_of(message: Any) -> Scan:
    """Numbers of a sensor_msgs/LaserScan."""
    return Scan(
        stamp_of(message),
        message.header.frame_id.lstrip("/"),
        np.asarray(message.ranges, np.float32),
        float(message.angle_min),
        float(message.angle_increment),
        float(message.range_min),
        float(message.range_max),
    )


def lidar_of_scan(scan: Scan, mount: Mount, least: float, most: float) -> LidarConfig:
    """Geometry that the filter is compiled for, of the first scan.

    ``least`` and ``most`` are ``laser_min_range`` and ``laser_max_range`` of nav2: negative leaves the scan's own.
    A laser that hangs upside down has its axis down; its tilt is told by the caller.

    Raises:
        UserError: the scan's own numbers mean nothing.
    """
    shortest = scan.range_min if least < 0 else max(least, 0.0)
    reach = scan.range_max if math.isfinite(scan.range_max) and scan.range_max > 0 else math.inf
    longest = min(reach, most) if most > 0 else reach
    try:
        return LidarConfig(
            beams=len(scan.ranges),
            angle_min=scan.angle_min,
            angle_increment=scan.angle_increment,
            range_min=shortest if math.isfinite(shortest) else 0.0,
            range_max=longest,
            mount=(mount.x, mount.y, mount.yaw),
            upside_down=mount.upside_down,
        )
    except ValueError as error:
        raise UserError(f"LaserScan in frame {scan.frame}: {error}; repair the driver's message") from None


def fitted(scan: Scan, lidar: LidarConfig) -> np.ndarray:
    """(B,) REP-117 ranges of a scan at the beams of ``lidar``: each takes the nearest, NaN where there is none near.

    Drivers that jitter their first angle, their increment or their number of beams would else compile anew.
    """
    ranges = limit_ranges(scan.ranges, lidar.range_min, lidar.range_max)
    wanted = lidar.angle_min + lidar.angle_increment * np.arange(lidar.beams)
    if len(ranges) == lidar.beams and np.abs(_bearings(scan)[[0, -1]] - wanted[[0, -1]]).max() < _SAME_BEARING:
        return ranges
    if not len(ranges) or not scan.angle_increment:
        return np.full(lidar.beams, np.nan, np.float32)
    ahead = (wanted - scan.angle_min) * np.sign(scan.angle_increment)
    # A full turn may begin anywhere; half an increment before the first beam still belongs to it.
    half = abs(scan.angle_increment) / 2
    index = np.rint(((ahead + half) % (2 * np.pi) - half) / abs(scan.angle_increment)).astype(int)
    return np.where(index < len(ranges), ranges[np.minimum(index, len(ranges) - 1)], np.float32(np.nan))


def _bearings(scan: Scan) -> np.ndarray:
    return scan.angle_min + scan.angle_increment * np.arange(len(scan.ranges))


def grid_of(message: Any) -> OccupancyGrid:
    """Map of a nav_msgs/OccupancyGrid.

    Raises:
        UserError: sizes do not fit, or there is no free cell.
    """
    info = message.info
    cells = np.asarray(message.data, np.int16)
    if cells.size != info.width * info.height or not cells.size:
        raise UserError(f"OccupancyGrid: data holds {cells.size} cells, info says {info.width} x {info.height}")
    if not (math.isfinite(info.resolution) and 1e-3 <= info.resolution <= 10):
        raise UserError(f"OccupancyGrid: resolution = {info.resolution}: not metres per cell of a building")
    cells = cells.reshape(info.height, info.width)
    if not (cells == _FREE).any():
        raise UserError("OccupancyGrid: no cell is free (0); check the thresholds of the map server")
    origin = planar(info.origin.position, info.origin.orientation)
    if not all(map(math.isfinite, origin)) or max(map(abs, origin[:2])) > FAR:
        raise UserError(f"OccupancyGrid: origin = {origin}: must be finite and within {FAR:g} m")
    # ROS carries the resolution in single precision: 0.05 arrives as 0.0500000007.
    resolution = round(float(info.resolution), 6)
    return from_cells(cells == _OCCUPIED, cells == _FREE, resolution=resolution, origin=origin)


def pose_of(message: Any) -> tuple[np.ndarray, np.ndarray]:
    """Pose (3,) and covariance (3, 3) of a PoseWithCovariance.

    Raises:
        UserError: numbers that are not finite, or no quaternion.
    """
    q = message.pose.orientation
    quaternion = np.array([q.x, q.y, q.z, q.w], float)
    pose = np.array([message.pose.position.x, message.pose.position.y, float(yaw_of(quaternion))])
    covariance = np.asarray(message.covariance, float).reshape(6, 6)[np.ix_([0, 1, 5], [0, 1, 5])]
    if not (np.isfinite(pose).all() and np.isfinite(covariance).all() and quaternion.any()):
        raise UserError("initial pose: must be finite numbers and a quaternion that is not zero; it is left out")
    return pose, covariance


def set_pose(message: Any, pose: Sequence[float] | np.ndarray) -> None:
    """Write a pose (3,) into a geometry_msgs/Pose."""
    x, y, yaw = (float(v) for v in pose)
    message.position.x, message.position.y = x, y
    message.orientation.z, message.orientation.w = math.sin(yaw / 2), math.cos(yaw / 2)


def set_transform(message: Any, parent: str, child: str, pose: np.ndarray, at: float) -> None:
    """Write the pose of ``child`` in ``parent`` into a geometry_msgs/TransformStamped."""
    set_stamp(message.header.stamp, at)
    message.header.frame_id, message.child_frame_id = parent, child
    x, y, yaw = (float(v) for v in pose)
    message.transform.translation.x, message.transform.translation.y = x, y
    message.transform.rotation.z, message.transform.rotation.w = math.sin(yaw / 2), math.cos(yaw / 2)
