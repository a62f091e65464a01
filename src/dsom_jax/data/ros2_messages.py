"""Messages of ROS 2 out of numbers, without ROS: poses are (x, y, yaw), stamps are seconds."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from dsom_jax.lidar import LidarConfig
from dsom_jax.occupancy import OccupancyGrid

BASE, LASER, ODOM, MAP = "base_link", "laser", "odom", "map"
TF, SCAN, ODOMETRY = "tf2_msgs/msg/TFMessage", "sensor_msgs/msg/LaserScan", "nav_msgs/msg/Odometry"
"""Types of messages."""
OCCUPIED, FREE, UNKNOWN = 100, 0, -1
"""Of nav_msgs/OccupancyGrid, as map_server publishes them."""


class MessageMaker:
    """Makes messages of the types that a ``store`` of rosbags knows."""

    def __init__(self, store: Any) -> None:
        self._store = store

    def _make(self, kind: str, **fields: Any) -> Any:
        return self._store.types[kind](**fields)

    def _time(self, stamp: float) -> Any:
        whole = round(stamp * 1e9)
        return self._make("builtin_interfaces/msg/Time", sec=whole // 10**9, nanosec=whole % 10**9)

    def _header(self, stamp: float, frame: str) -> Any:
        return self._make("std_msgs/msg/Header", stamp=self._time(stamp), frame_id=frame)

    def _turn(self, yaw: float, upside_down: bool = False) -> Any:
        x, y, z, w = quaternion(yaw, upside_down)
        return self._make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)

    def _vector(self, x: float = 0.0, y: float = 0.0) -> Any:
        return self._make("geometry_msgs/msg/Vector3", x=x, y=y, z=0.0)

    def _pose(self, pose: Iterable[float]) -> Any:
        x, y, yaw = map(float, pose)
        point = self._make("geometry_msgs/msg/Point", x=x, y=y, z=0.0)
        return self._make("geometry_msgs/msg/Pose", position=point, orientation=self._turn(yaw))

    def frame(
        self, stamp: float, parent: str, child: str, pose: Sequence[float] | np.ndarray, upside_down: bool = False
    ) -> Any:
        """TFMessage: where ``child`` is in ``parent``."""
        x, y, yaw = map(float, pose)
        turn = self._turn(yaw, upside_down)
        transform = self._make("geometry_msgs/msg/Transform", translation=self._vector(x, y), rotation=turn)
        header = self._header(stamp, parent)
        stamped = self._make(
            "geometry_msgs/msg/TransformStamped", header=header, child_frame_id=child, transform=transform
        )
        return self._make(TF, transforms=[stamped])

    def mount(self, stamp: float, lidar: LidarConfig) -> Any:
        """TFMessage: where the lidar sits on the base."""
        return self.frame(stamp, BASE, LASER, lidar.mount, lidar.upside_down)

    def odometry(self, stamp: float, pose: Iterable[float]) -> Any:
        """Odometry: pose of the base in the odometry frame, standing still."""
        still = self._make("geometry_msgs/msg/Twist", linear=self._vector(), angular=self._vector())
        zeros = np.zeros(36)
        return self._make(
            ODOMETRY, header=self._header(stamp, ODOM), child_frame_id=BASE,
            pose=self._make("geometry_msgs/msg/PoseWithCovariance", pose=self._pose(pose), covariance=zeros),
            twist=self._make("geometry_msgs/msg/TwistWithCovariance", twist=still, covariance=zeros),
        )  # fmt: skip

    def scan(self, stamp: float, ranges: np.ndarray, lidar: LidarConfig) -> Any:
        """LaserScan: ranges (B,) metres, REP-117."""
        return self._make(
            SCAN, header=self._header(stamp, LASER), angle_min=lidar.angle_min,
            angle_max=lidar.angle_min + lidar.angle_increment * (lidar.beams - 1),
            angle_increment=lidar.angle_increment, time_increment=0.0, scan_time=0.1, range_min=lidar.range_min,
            range_max=lidar.range_max, ranges=np.asarray(ranges, np.float32), intensities=np.zeros(0, np.float32),
        )  # fmt: skip

    def grid(self, stamp: float, grid: OccupancyGrid) -> Any:
        """OccupancyGrid: the map."""
        height, width = grid.shape
        info = self._make(
            "nav_msgs/msg/MapMetaData", map_load_time=self._time(stamp), resolution=grid.resolution, width=width,
            height=height, origin=self._pose(np.asarray(grid.origin)),
        )  # fmt: skip
        cells = percentages(grid).reshape(-1)
        return self._make("nav_msgs/msg/OccupancyGrid", header=self._header(stamp, MAP), info=info, data=cells)

    def pose(self, stamp: float, pose: Iterable[float]) -> Any:
        """PoseStamped in the map frame."""
        return self._make("geometry_msgs/msg/PoseStamped", header=self._header(stamp, MAP), pose=self._pose(pose))

    def answer(self, stamp: float, pose: Iterable[float], covariance: np.ndarray) -> Any:
        """PoseWithCovarianceStamped in the map frame; covariance (3, 3) of (x, y, theta), m^2, m rad, rad^2."""
        both = self._make(
            "geometry_msgs/msg/PoseWithCovariance", pose=self._pose(pose), covariance=covariance36(covariance)
        )
        header = self._header(stamp, MAP)
        return self._make("geometry_msgs/msg/PoseWithCovarianceStamped", header=header, pose=both)

    def poses(self, stamp: float, poses: np.ndarray) -> Any:
        """PoseArray in the map frame: poses (P, 3)."""
        made = [self._pose(pose) for pose in poses]
        return self._make("geometry_msgs/msg/PoseArray", header=self._header(stamp, MAP), poses=made)

    def text(self, text: str) -> Any:
        """String."""
        return self._make("std_msgs/msg/String", data=text)


def covariance36(covariance: np.ndarray) -> np.ndarray:
    """(36,) row-major covariance over (x, y, z, roll, pitch, yaw) of one over (x, y, yaw)."""
    full = np.zeros((6, 6))
    full[np.ix_([0, 1, 5], [0, 1, 5])] = covariance
    return full.reshape(-1)


def percentages(grid: OccupancyGrid) -> np.ndarray:
    """(H, W) int8 cells of nav_msgs/OccupancyGrid, row 0 at the bottom."""
    cells = np.full(grid.shape, UNKNOWN, np.int8)
    cells[np.asarray(grid.free)] = FREE
    cells[np.asarray(grid.occupied)] = OCCUPIED
    return cells


def quaternion(yaw: float, upside_down: bool = False) -> tuple[float, float, float, float]:
    """(x, y, z, w) of a turn by ``yaw``; of what is upside down, which is first rolled over by half a turn."""
    s, c = float(np.sin(yaw / 2)), float(np.cos(yaw / 2))
    return (c, s, 0.0, 0.0) if upside_down else (0.0, 0.0, s, c)
