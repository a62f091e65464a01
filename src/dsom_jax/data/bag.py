"""ROS bags without ROS: rosbag1 (.bag), rosbag2 (folder with metadata.yaml, .db3) and .mcap, through ``rosbags``."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from dsom_jax.data import se2
from dsom_jax.data.assemble import Sensor, assemble
from dsom_jax.data.bag_file import listed, messages_of_topics, open_bag
from dsom_jax.data.bag_reference import REFERENCES, reference_of
from dsom_jax.data.log import RawLog, Report
from dsom_jax.data.log_options import AS_TOLD, LogOptions, option
from dsom_jax.data.ros2_messages import ODOMETRY, SCAN, TF
from dsom_jax.data.scans import Scans, table
from dsom_jax.data.tf_tree import FIXED, TfTree, last_name, pose_row, stamp_of
from dsom_jax.errors import UserError

ECHOES, CLOUD = "sensor_msgs/msg/MultiEchoLaserScan", "sensor_msgs/msg/PointCloud2"
_TF = (TF, "tf/msg/tfMessage")
"""The second is the name of the same message in bags from before 2013."""


@dataclass
class BagMessages:
    """What was read of a bag, in recording order.

    Attributes:
        scans: scan messages, and ``received`` when each was recorded, seconds.
        odometry, reference: messages of the topics chosen.
        tree: transforms.
    """

    scans: list[Any] = field(default_factory=list)
    received: list[float] = field(default_factory=list)
    odometry: list[Any] = field(default_factory=list)
    reference: list[Any] = field(default_factory=list)
    tree: TfTree = field(default_factory=TfTree)


@dataclass(frozen=True)
class BagOdometry:
    """Odometry of a bag.

    Attributes:
        rows: (M, 4) = (stamp, x, y, yaw) of the base.
        frame: the frame that it is told in; None if the messages do not say.
        base: the frame that moves.
    """

    rows: np.ndarray
    frame: str | None
    base: str


def load_bag(path: str | Path, options: LogOptions = AS_TOLD, range_max: float | None = None) -> RawLog:
    """Scans of one lidar with the odometry of one Odometry topic, or of /tf, at their stamps.

    Topics and frames may be left out where there is no choice. The lidar's mount comes from /tf and /tf_static, without
    them it is the base. ``range_max`` overrides what the scans say.
    """
    path, report = Path(path), Report()
    with open_bag(path) as reader:
        topics = {c.topic: c.msgtype for c in reader.connections}
        scan_topic = _scan_topic(path, topics, options)
        if options.reference_topic:
            _choose(path, topics, REFERENCES, options.reference_topic, "reference_topic")
        odom_topic = _odometry_topic(path, topics, scan_topic, options, report)
        messages = _read(reader, (scan_topic, odom_topic, options.reference_topic), report)
    if not messages.scans:
        raise UserError(f"{path}: topic {scan_topic} holds no scan; {listed(topics)}")
    messages, laser = _of_one_lidar(path, messages, options, report)
    drive = _drive(path, topics, messages, laser, options, report)
    sensor = _sensor(messages, laser, drive, range_max, options, report)
    log = assemble(_table(messages, report), drive.rows, sensor, options, report, path)
    reference = reference_of(path, messages.reference, messages.tree, drive, log.stamps, options, report)
    return log if reference is None else replace(log, reference=reference)


def _choose(path: Path, topics: dict[str, str], kinds: tuple[str, ...], wanted: str | None, name: str) -> str:
    """The topic of one of the message types ``kinds``: the wanted one, or the only one; ``name`` is the option's."""
    found = sorted(topic for topic, msgtype in topics.items() if msgtype in kinds)
    if wanted is not None and wanted in found:
        return wanted
    if wanted is None and len(found) == 1:
        return found[0]
    short = " or ".join(kind.replace("/msg", "") for kind in kinds)
    if wanted is not None:
        raise UserError(f"{path}: {option(name)} {wanted}: no such {short} topic; {listed(topics)}")
    if not found:
        raise UserError(f"{path}: holds no {short} topic; {listed(topics)}")
    raise UserError(f"{path}: several {short} topics; set {option(name)} to one of {', '.join(found)}")


def _scan_topic(path: Path, topics: dict[str, str], options: LogOptions) -> str:
    """Where the scans are; point clouds alone are no scans, and the message says what to do with them."""
    echoes = _of(topics, ECHOES)
    kinds = (SCAN, ECHOES) if options.scan_topic in echoes or (echoes and not _of(topics, SCAN)) else (SCAN,)
    clouds = _of(topics, CLOUD)
    if clouds and not set(kinds) & set(topics.values()):
        how = f"ros2 run pointcloud_to_laserscan pointcloud_to_laserscan_node --ros-args -r cloud_in:={clouds[0]}"
        raise UserError(f"{path}: holds point clouds ({clouds[0]}) and no LaserScan; play it, run {how}, record /scan")
    return _choose(path, topics, kinds, options.scan_topic, "scan_topic")


def _of(topics: dict[str, str], kind: str) -> list[str]:
    """Topics of one message type."""
    return sorted(topic for topic, msgtype in topics.items() if msgtype == kind)


def _namespace(topic: str) -> str:
    """``/robot1`` of ``/robot1/scan``."""
    return topic.rsplit("/", 1)[0]


def _odometry_topic(
    path: Path, topics: dict[str, str], scan_topic: str, options: LogOptions, report: Report
) -> str | None:
    """Where the odometry is, None for /tf. Of several topics the only one beside the scans, of the same robot."""
    if options.odom_topic:
        return _choose(path, topics, (ODOMETRY,), options.odom_topic, "odom_topic")
    found = [topic for topic in _of(topics, ODOMETRY) if topic != options.reference_topic]
    if options.odom_frame or not found:
        return None
    beside = [topic for topic in found if _namespace(topic) == _namespace(scan_topic)]
    if len(found) > 1 and len(beside) == 1:
        others = ", ".join(topic for topic in found if topic not in beside)
        report.add(f"odometry topic {beside[0]} taken, beside {scan_topic}; --odom-topic chooses another", others)
        return beside[0]
    return _choose(
        path, {t: k for t, k in topics.items() if t != options.reference_topic}, (ODOMETRY,), None, "odom_topic"
    )


def _read(reader: Any, chosen: tuple[str, str | None, str | None], report: Report) -> BagMessages:
    """The messages of the topics chosen (scans, odometry, reference), and the transforms of the scans' robot."""
    scan_topic, odom_topic, reference_topic = chosen
    transforms = [c for c in reader.connections if c.msgtype in _TF]
    # nav2 gives each robot its own /robot1/tf.
    own = [c for c in transforms if _namespace(c.topic) == _namespace(scan_topic)]
    transforms = own if len({_namespace(c.topic) for c in transforms}) > 1 and own else transforms
    wanted = [c for c in reader.connections if c.topic in chosen]
    wanted += [c for c in transforms if c not in wanted]
    messages = BagMessages()
    for topic, received, message in messages_of_topics(reader, wanted, report):
        if topic == scan_topic:
            messages.scans.append(message)
            messages.received.append(1e-9 * received)
        elif topic == odom_topic:
            messages.odometry.append(message)
        elif topic == reference_topic:
            messages.reference.append(message)
        else:
            messages.tree.add(message)
    return messages


def _of_one_lidar(path: Path, messages: BagMessages, options: LogOptions, report: Report) -> tuple[BagMessages, str]:
    """The scans of one frame: the one asked for, or the most frequent; and its name as /tf writes it."""
    frames = [message.header.frame_id.lstrip("/") for message in messages.scans]
    counts = Counter(frames)
    wanted = options.scan_frame.lstrip("/") if options.scan_frame else counts.most_common(1)[0][0]
    if wanted not in counts:
        raise UserError(f"{path}: --scan-frame {options.scan_frame}: the scans are of {', '.join(sorted(counts))}")
    for other, count in counts.items():
        if other != wanted:
            report.add(f"scans of another lidar, {other}, left out; --scan-frame chooses it over {wanted}", count=count)
    keep = [n for n, frame in enumerate(frames) if frame == wanted]
    scans, received = [messages.scans[n] for n in keep], [messages.received[n] for n in keep]
    laser = messages.tree.known(wanted)
    if laser != wanted:
        report.add(f"scans of the frame {wanted}: taken for {laser}, which /tf knows")
    return replace(messages, scans=scans, received=received), laser


def _drive(
    path: Path, topics: dict[str, str], messages: BagMessages, laser: str, options: LogOptions, report: Report
) -> BagOdometry:
    """The odometry of the topic, or of the edge of /tf that is odometry."""
    tree = messages.tree
    if messages.odometry:
        first = messages.odometry[0]
        rows = np.array([pose_row(m, m.pose.pose) for m in messages.odometry])
        frame, base = first.header.frame_id.lstrip("/"), first.child_frame_id.lstrip("/")
        edge = tree.odometry_edge(laser)
        return _of_base(
            BagOdometry(rows, frame or None, base or (edge[1] if edge else "base_link")), messages, options, report
        )
    edge = tree.odometry_edge(laser, options.odom_frame)
    if edge is None:
        if options.odom_frame:
            frames = ", ".join(sorted({parent for parent, child in tree.edges if tree.moves((parent, child))}))
            raise UserError(
                f"{path}: --odom-frame {options.odom_frame}: frames that something moves in: {frames or 'none'}"
            )
        fix = "record /odom or /tf too, or play it through scan odometry such as rf2o_laser_odometry and record that"
        raise UserError(f"{path}: holds no odometry (nav_msgs/Odometry or /tf above {laser}); {fix}; {listed(topics)}")
    rows = tree.rows(edge)
    if len(rows) < 2:
        raise UserError(f"{path}: holds no odometry: /tf tells {edge[0]} -> {edge[1]} once; {listed(topics)}")
    if edge[0] != "odom":
        report.add(f"odometry taken from /tf: {edge[0]} -> {edge[1]}; --odom-frame chooses another")
    if last_name(edge[0]) in FIXED:
        report.add(f"odometry of the fixed frame {edge[0]}: it may be corrected already, and what is found too good")
    return _of_base(BagOdometry(rows, edge[0], edge[1]), messages, options, report)


def _of_base(drive: BagOdometry, messages: BagMessages, options: LogOptions, report: Report) -> BagOdometry:
    """The odometry of ``--base-frame``, where that is another frame than the one that the odometry moves."""
    base = options.base_frame.lstrip("/") if options.base_frame else drive.base
    if base == drive.base:
        return drive
    sits = messages.tree.mount(drive.base, base, drive.frame)
    if sits is None:
        report.add(f"missing transform {drive.base} -> {base}: the odometry is taken to be that of {base}")
        return replace(drive, base=base)
    return BagOdometry(_shifted(drive.rows, np.array([sits.x, sits.y, sits.yaw])), drive.frame, base)


def _shifted(rows: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Rows (M, 4) of a frame that sits at ``pose`` (3,) on the one whose rows these are."""
    return np.column_stack([rows[:, 0], se2.compose(rows[:, 1:], pose)])


def _sensor(
    messages: BagMessages, laser: str, drive: BagOdometry, range_max: float | None, options: LogOptions, report: Report
) -> Sensor:
    """Limits that the scans tell, and where the lidar sits by /tf."""
    first, tree, base = messages.scans[0], messages.tree, drive.base
    mount = tree.mount(base, laser, drive.frame)
    if options.mount is None and mount is None:
        carrier = tree.carrier(laser, drive.frame)
        fix = "--base-frame or --mount says how it sits"
        if carrier is None:
            report.add(f"missing transform {base} -> {laser}: the laser is taken to sit on the base; {fix}")
        else:
            mount = tree.mount(carrier, laser, drive.frame)
            report.add(f"missing transform {base} -> {laser}: {carrier} -> {laser} is taken for it; {fix}")
    if mount is not None and mount.tilt > np.radians(5):
        report.add(f"laser tilted by {np.degrees(mount.tilt):.0f} deg: its scan is not a horizontal cut")
    where = ((mount.x, mount.y, mount.yaw), mount.upside_down) if mount else ((0.0, 0.0, 0.0), False)
    told = float(np.median([m.range_max for m in messages.scans]))
    return Sensor(float(first.range_min), range_max or told, float(first.scan_time), *where)


def _table(messages: BagMessages, report: Report) -> Scans:
    """The scan messages as arrays."""
    scans = messages.scans
    echoes = scans[0].__msgtype__ == ECHOES
    if echoes:
        report.add("scans of several echoes: the first one of each beam is used", count=len(scans))
    stamps = np.array([stamp_of(m) for m in scans])
    if not stamps.any():
        report.add("scans without a stamp: the time of recording is taken", count=len(scans))
        stamps = np.array(messages.received)

    def column(name: str) -> np.ndarray:
        return np.array([getattr(m, name) for m in scans], float)

    return table(
        [_first_echoes(m) if echoes else m.ranges for m in scans],
        stamps=stamps,
        start=column("angle_min"),
        end=column("angle_max"),
        step=column("angle_increment"),
        beam_time=column("time_increment"),
    )


def _first_echoes(message: Any) -> np.ndarray:
    """(B,) the first echo of each beam, NaN where there is none."""
    return np.array([beam.echoes[0] if len(beam.echoes) else np.nan for beam in message.ranges], np.float32)
