"""A drive as a ROS 2 bag, without ROS: what a robot with a 2D lidar records."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dsom_jax.data.log import RawLog
from dsom_jax.errors import UserError

BASE, LASER, ODOM = "base_link", "laser", "odom"


def write_bag(path: Path, log: RawLog, moving_frames: bool = False) -> None:
    """Write ``log`` as a rosbag2 folder ``path`` (mcap): /scan, /odom and /tf_static; an older one is replaced.

    With ``moving_frames`` also /tf from odom to base_link, which other localizers listen to.
    """
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    messages = _Messages(get_typestore(Stores.ROS2_HUMBLE))
    draft = path.with_name(f".{path.name}.draft")
    try:
        shutil.rmtree(draft, ignore_errors=True)
        with Writer(draft, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
            parts = (("/tf_static", "tf2_msgs/msg/TFMessage"), ("/odom", "nav_msgs/msg/Odometry"),
                     ("/scan", "sensor_msgs/msg/LaserScan"),
                     *([("/tf", "tf2_msgs/msg/TFMessage")] if moving_frames else []))  # fmt: skip
            at = {topic: writer.add_connection(topic, kind, typestore=messages.store) for topic, kind in parts}

            def write(topic: str, stamp: float, message: Any) -> None:
                content = messages.store.serialize_cdr(message, message.__msgtype__)
                writer.write(at[topic], round(stamp * 1e9), content)

            first = float(log.stamps[0])
            write("/tf_static", first, messages.frame(first, BASE, LASER, log.lidar.mount))
            for stamp, pose in zip(*odometry_at_rate(log.stamps, log.odometry), strict=True):
                write("/odom", float(stamp), messages.odometry(float(stamp), pose.tolist()))
                if moving_frames:
                    write("/tf", float(stamp), messages.frame(float(stamp), ODOM, BASE, pose.tolist()))
            for stamp, scan in zip(log.stamps.tolist(), log.ranges, strict=True):
                write("/scan", stamp, messages.scan(stamp, scan, log))
        shutil.rmtree(path, ignore_errors=True)
        draft.rename(path)
    except OSError as error:
        raise UserError(f"{path}: cannot be written ({error.strerror}); choose another output folder") from None
    finally:
        shutil.rmtree(draft, ignore_errors=True)


def odometry_at_rate(stamps: np.ndarray, poses: np.ndarray, period: float = 0.05) -> tuple[np.ndarray, np.ndarray]:
    """Stamps (M,) at least every ``period`` seconds, those of the poses (N, 3) among them, and the poses (M, 3) there.

    Wheels report far more often than a filter takes scans, and readers do not guess over long gaps.
    """
    counts = np.maximum(np.ceil(np.diff(stamps) / period), 1).astype(int)
    rows = np.concatenate([*(n + np.arange(count) / count for n, count in enumerate(counts)), [len(stamps) - 1.0]])
    columns = (stamps, poses[:, 0], poses[:, 1], np.unwrap(poses[:, 2]))
    at, x, y, theta = (np.interp(rows, np.arange(len(stamps)), column) for column in columns)
    return at, np.stack([x, y, (theta + np.pi) % (2 * np.pi) - np.pi], -1)


class _Messages:
    """Messages of ROS 2."""

    def __init__(self, store: Any) -> None:
        self.store = store

    def _make(self, kind: str, **fields: Any) -> Any:
        return self.store.types[kind](**fields)

    def _header(self, stamp: float, frame: str) -> Any:
        whole = round(stamp * 1e9)
        time = self._make("builtin_interfaces/msg/Time", sec=whole // 10**9, nanosec=whole % 10**9)
        return self._make("std_msgs/msg/Header", stamp=time, frame_id=frame)

    def _turn(self, yaw: float) -> Any:
        z, w = float(np.sin(yaw / 2)), float(np.cos(yaw / 2))
        return self._make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=z, w=w)

    def _vector(self, x: float = 0.0, y: float = 0.0) -> Any:
        return self._make("geometry_msgs/msg/Vector3", x=x, y=y, z=0.0)

    def frame(self, stamp: float, parent: str, child: str, pose: Sequence[float]) -> Any:
        """Where ``child`` is in ``parent``: (x, y, yaw)."""
        x, y, yaw = pose
        transform = self._make("geometry_msgs/msg/Transform", translation=self._vector(x, y), rotation=self._turn(yaw))
        header = self._header(stamp, parent)
        stamped = self._make(
            "geometry_msgs/msg/TransformStamped", header=header, child_frame_id=child, transform=transform
        )
        return self._make("tf2_msgs/msg/TFMessage", transforms=[stamped])

    def odometry(self, stamp: float, pose: list[float]) -> Any:
        """Pose (x, y, yaw) of the base in the odometry frame."""
        x, y, yaw = pose
        point = self._make("geometry_msgs/msg/Point", x=x, y=y, z=0.0)
        where = self._make("geometry_msgs/msg/Pose", position=point, orientation=self._turn(yaw))
        still = self._make("geometry_msgs/msg/Twist", linear=self._vector(), angular=self._vector())
        zeros = np.zeros(36)
        return self._make(
            "nav_msgs/msg/Odometry", header=self._header(stamp, ODOM), child_frame_id=BASE,
            pose=self._make("geometry_msgs/msg/PoseWithCovariance", pose=where, covariance=zeros),
            twist=self._make("geometry_msgs/msg/TwistWithCovariance", twist=still, covariance=zeros),
        )  # fmt: skip

    def scan(self, stamp: float, ranges: np.ndarray, log: RawLog) -> Any:
        """Ranges (B,), REP-117."""
        lidar = log.lidar
        return self._make(
            "sensor_msgs/msg/LaserScan", header=self._header(stamp, LASER), angle_min=lidar.angle_min,
            angle_max=lidar.angle_min + lidar.angle_increment * (lidar.beams - 1),
            angle_increment=lidar.angle_increment, time_increment=0.0, scan_time=0.1, range_min=lidar.range_min,
            range_max=lidar.range_max, ranges=np.asarray(ranges, np.float32), intensities=np.zeros(0, np.float32),
        )  # fmt: skip
