"""ROS 2 bags, without ROS: any messages, and a drive as what a robot with a 2D lidar records."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from dsom_jax.data.log import RawLog
from dsom_jax.data.ros2_messages import BASE, LASER, ODOM, ODOMETRY, SCAN, TF, MessageMaker
from dsom_jax.errors import UserError

Say = Callable[[str, float, Any], None]
"""Called with a topic, a stamp in seconds and a message."""


def write_bag(path: Path, log: RawLog, moving_frames: bool = False) -> None:
    """Write ``log`` as a rosbag2 folder ``path`` (mcap): /scan, /odom and /tf_static; an older one is replaced.

    With ``moving_frames`` also /tf from odom to base_link, which other localizers listen to.
    """
    draft = path.with_name(f".{path.name}.draft")
    topics = {"/tf_static": TF, "/odom": ODOMETRY, "/scan": SCAN} | ({"/tf": TF} if moving_frames else {})
    try:
        with new_bag(draft, topics) as (make, say):
            first = float(log.stamps[0])
            say("/tf_static", first, make.frame(first, BASE, LASER, log.lidar.mount))
            for stamp, pose in zip(*odometry_at_rate(log.stamps, log.odometry), strict=True):
                say("/odom", float(stamp), make.odometry(float(stamp), pose))
                if moving_frames:
                    say("/tf", float(stamp), make.frame(float(stamp), ODOM, BASE, pose))
            for stamp, scan in zip(log.stamps.tolist(), log.ranges, strict=True):
                say("/scan", stamp, make.scan(stamp, scan, log.lidar))
        shutil.rmtree(path, ignore_errors=True)
        draft.rename(path)
    except OSError as error:
        raise UserError(f"{path}: cannot be written ({error.strerror}); choose another output folder") from None
    finally:
        shutil.rmtree(draft, ignore_errors=True)


@contextmanager
def new_bag(
    folder: Path, topics: Mapping[str, str], lasting: Collection[str] = ()
) -> Iterator[tuple[MessageMaker, Say]]:
    """A rosbag2 (mcap) in place of whatever ``folder`` is, with ``topics`` and their types.

    Those in ``lasting`` are told once, and players repeat them to whoever comes later (transient local).
    """
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    shutil.rmtree(folder, ignore_errors=True)
    # Of version 8, as Humble cannot read the names by which version 9 tells how long a message lasts.
    with Writer(folder, version=8, storage_plugin=StoragePlugin.MCAP) as writer:
        at = {topic: writer.add_connection(topic, kind, typestore=store,
                                           offered_qos_profiles=[_lasting()] if topic in lasting else [])
              for topic, kind in topics.items()}  # fmt: skip

        def say(topic: str, stamp: float, message: Any) -> None:
            writer.write(at[topic], round(stamp * 1e9), store.serialize_cdr(message, message.__msgtype__))

        yield MessageMaker(store), say


def _lasting() -> Any:
    """What map_server and static transforms promise."""
    from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime

    ever = QosTime(9223372036, 854775807)
    return Qos(QosHistory.KEEP_LAST, 1, QosReliability.RELIABLE, QosDurability.TRANSIENT_LOCAL, ever, ever,
               QosLiveliness.AUTOMATIC, ever, False)  # fmt: skip


def odometry_at_rate(stamps: np.ndarray, poses: np.ndarray, period: float = 0.05) -> tuple[np.ndarray, np.ndarray]:
    """Stamps (M,) at least every ``period`` seconds, those of the poses (N, 3) among them, and the poses (M, 3) there.

    Wheels report far more often than a filter takes scans, and readers do not guess over long gaps.
    """
    counts = np.maximum(np.ceil(np.diff(stamps) / period), 1).astype(int)
    rows = np.concatenate([*(n + np.arange(count) / count for n, count in enumerate(counts)), [len(stamps) - 1.0]])
    columns = (stamps, poses[:, 0], poses[:, 1], np.unwrap(poses[:, 2]))
    at, x, y, theta = (np.interp(rows, np.arange(len(stamps)), column) for column in columns)
    return at, np.stack([x, y, (theta + np.pi) % (2 * np.pi) - np.pi], -1)
