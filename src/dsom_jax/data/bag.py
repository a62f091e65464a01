"""ROS bags without ROS: rosbag1 (.bag), rosbag2 (folder with metadata.yaml, .db3) and .mcap, through ``rosbags``."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from dsom_jax.data.log import RawLog, Report, limit_ranges, majority_beams, tidy
from dsom_jax.data.odometry import odometry_at
from dsom_jax.data.tf_tree import TfTree, planar
from dsom_jax.errors import UserError
from dsom_jax.lidar import LidarConfig

SCAN, ODOMETRY = "sensor_msgs/msg/LaserScan", "nav_msgs/msg/Odometry"
TF = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
"""The second is the name of the same message in bags from before 2013."""


def load_bag(
    path: str | Path, scan_topic: str | None = None, odom_topic: str | None = None, range_max: float | None = None
) -> RawLog:
    """Scans of one LaserScan topic with the odometry of one Odometry topic (or of /tf) at their stamps.

    Topics may be left out where there is no choice. The laser's mount comes from /tf and /tf_static, without them it is
    the base. ``range_max`` overrides what the scans say.
    """
    path, report = Path(path), Report()
    with _open(path) as reader:
        topics = {c.topic: c.msgtype for c in reader.connections}
        scan_topic = _choose(path, topics, SCAN, scan_topic, "scan_topic")
        if odom_topic or ODOMETRY in topics.values():
            odom_topic = _choose(path, topics, ODOMETRY, odom_topic, "odom_topic")
        scans, odometry, tree = _read(reader, scan_topic, odom_topic, report)
    if not scans:
        raise UserError(f"{path}: topic {scan_topic} holds no scan; {_listed(topics)}")
    base = odometry[0].child_frame_id if odometry and odometry[0].child_frame_id else tree.base_frame()
    rows = np.array([_odometry_row(m) for m in odometry]) if odometry else tree.odometry_rows(base)
    if len(rows) < 2:
        raise UserError(f"{path}: holds no odometry (nav_msgs/Odometry or /tf odom -> base_link); {_listed(topics)}")
    return _assemble(path, scans, rows, tree, base, range_max, report)


@contextmanager
def _open(path: Path) -> Iterator[Any]:
    """Reader of any kind of bag."""
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise UserError(f"{path}: reading bags needs rosbags; run: pip install 'dsom-jax[bags]'") from None
    if not path.exists():
        raise UserError(f"{path}: no such bag; check the path")
    try:
        reader = AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE))
        reader.open()
    except Exception as error:
        # Broken bags surface as whatever the storage underneath raises: sqlite3, struct, zstd, ...
        cause = (str(error) or type(error).__name__).splitlines()[0]
        raise UserError(f"{path}: not a readable bag ({cause}); record it again or try rosbag reindex") from error
    try:
        yield reader
    finally:
        reader.close()


def _listed(topics: dict[str, str]) -> str:
    """The topics of a bag for an error message."""
    names = ", ".join(f"{topic} ({kind})" for topic, kind in sorted(topics.items()))
    return f"topics in the bag: {names or 'none'}"


def _choose(path: Path, topics: dict[str, str], kind: str, wanted: str | None, argument: str) -> str:
    """The topic of message type ``kind``: the wanted one, or the only one."""
    found = sorted(topic for topic, msgtype in topics.items() if msgtype == kind)
    if wanted is not None and wanted in found:
        return wanted
    if wanted is None and len(found) == 1:
        return found[0]
    short = kind.replace("/msg", "")
    if wanted is not None:
        raise UserError(f"{path}: {argument} = {wanted}: no such {short} topic; {_listed(topics)}")
    if not found:
        raise UserError(f"{path}: holds no {short} topic; {_listed(topics)}")
    raise UserError(f"{path}: several {short} topics; set {argument} to one of {', '.join(found)}")


def _read(reader: Any, scan_topic: str, odom_topic: str | None, report: Report) -> tuple[list[Any], list[Any], TfTree]:
    """Scans and odometry messages in recording order, and the transforms."""
    wanted = [c for c in reader.connections if c.topic in (scan_topic, odom_topic) or c.msgtype in TF]
    scans: list[Any] = []
    odometry: list[Any] = []
    tree = TfTree()
    for topic, message in _messages(reader, wanted, report):
        if topic == scan_topic:
            scans.append(message)
        elif topic == odom_topic:
            odometry.append(message)
        else:
            tree.add(message)
    return scans, odometry, tree


def _messages(reader: Any, wanted: list[Any], report: Report) -> Iterator[tuple[str, Any]]:
    """Topic and message, as far as the bag can be read; what cannot is counted."""
    stream = reader.messages(connections=wanted)
    while True:
        try:
            connection, _, raw = next(stream)
        except StopIteration:
            return
        except Exception as error:
            report.add("broken places where the bag was left", type(error).__name__)
            return
        try:
            message = reader.deserialize(raw, connection.msgtype)
        except Exception as error:
            report.add(f"unreadable messages on {connection.topic}", type(error).__name__)
            continue
        yield connection.topic, message


def stamp_of(message: Any) -> float:
    """Header stamp in seconds."""
    return message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec


def _odometry_row(message: Any) -> list[float]:
    """(stamp, x, y, yaw) of a nav_msgs/Odometry."""
    pose = message.pose.pose
    return [stamp_of(message), *planar(pose.position, pose.orientation)]


def _assemble(
    path: Path, scans: list[Any], rows: np.ndarray, tree: TfTree, base: str, range_max: float | None, report: Report
) -> RawLog:
    """The log of scan messages and odometry rows (M, 4)."""
    keep = majority_beams([m.ranges for m in scans], report, path)
    scans = [m for m, kept in zip(scans, keep, strict=True) if kept]
    stamps = np.array([stamp_of(m) for m in scans])
    ranges = np.stack([m.ranges for m in scans])
    reach = range_max or _reach(scans[0], ranges, report)
    lidar = _lidar(path, scans[0], tree, base, reach, report)
    ranges = limit_ranges(ranges, lidar.range_min, lidar.range_max)
    return tidy(RawLog(ranges, odometry_at(rows, stamps, report), stamps, lidar, None, report, path))


def _reach(scan: Any, ranges: np.ndarray, report: Report) -> float:
    """range_max as the driver says; where it says infinity or nothing, a centimetre more than the longest reading."""
    told = float(scan.range_max)
    found = ranges[np.isfinite(ranges) & (ranges > scan.range_min)]
    if (np.isfinite(told) and told > scan.range_min) or not len(found):
        return told
    reach = float(found.max()) + 0.01
    report.add(f"range_max of {told:g} m in the scans: {reach:.2f} m is taken, after the longest reading")
    return reach


def _lidar(path: Path, scan: Any, tree: TfTree, base: str, range_max: float, report: Report) -> LidarConfig:
    """Geometry that the scans and /tf tell."""
    mount = tree.mount(base, scan.header.frame_id)
    if mount is None:
        report.add(f"missing transform {base} -> {scan.header.frame_id}: the laser is taken to sit on the base")
    elif mount.tilt > np.radians(5):
        report.add(f"laser tilted by {np.degrees(mount.tilt):.0f} deg: its scan is not a horizontal cut")
    x, y, yaw, upside_down = (mount.x, mount.y, mount.yaw, mount.upside_down) if mount else (0.0, 0.0, 0.0, False)
    try:
        return LidarConfig(
            beams=len(scan.ranges),
            angle_min=float(scan.angle_min),
            angle_increment=float(scan.angle_increment),
            range_min=float(scan.range_min),
            range_max=float(range_max),
            mount=(x, y, yaw),
            upside_down=upside_down,
        )
    except ValueError as error:
        raise UserError(f"{path}: LaserScan: {error}; give range_max or repair the driver's message") from None
