"""The reference that a bag brings along: a topic of poses in the map, or the frame of the map in /tf."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from dsom_jax.data import se2
from dsom_jax.data.log import Report
from dsom_jax.data.log_options import LogOptions
from dsom_jax.data.tf_tree import MAX_GAP, TfTree, at_stamps, planar, pose_row, stamp_of
from dsom_jax.errors import UserError

STAMPED = "geometry_msgs/msg/PoseStamped"
REFERENCES = (
    "nav_msgs/msg/Odometry",
    STAMPED,
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "geometry_msgs/msg/TransformStamped",
)


def reference_of(
    path: Path,
    messages: list[Any],
    tree: TfTree,
    drive: Any,
    stamps: np.ndarray,
    options: LogOptions,
    report: Report,
) -> np.ndarray | None:
    """Poses (N, 3) of the base in the map at ``stamps``, NaN where the bag does not tell; None if none is asked for.

    ``drive`` is the bag's odometry: it carries a pose of the reference to the scans around it.
    """
    if options.reference_topic:
        poses, name = _of_topic(path, messages, drive, stamps, options.reference_topic), options.reference_topic
    elif options.reference_tf:
        poses, name = _of_tf(path, tree, drive, stamps, options.reference_tf.lstrip("/")), options.reference_tf
    else:
        return None
    missing = int(np.isnan(poses).any(-1).sum())
    if missing == len(stamps):
        raise UserError(f"{path}: {name} tells no pose within {MAX_GAP:g} s of any scan; both must use the same clock")
    if missing:
        report.add("scans without a reference pose", count=missing)
    return poses


def _of_topic(path: Path, messages: list[Any], drive: Any, stamps: np.ndarray, topic: str) -> np.ndarray:
    """Poses told now and then, as amcl does, and between them what the odometry says, blended from both sides."""
    rows = np.array([_row(message) for message in messages]).reshape(-1, 4)
    rows = rows[np.isfinite(rows).all(-1)]
    rows = rows[np.unique(rows[:, 0], return_index=True)[1]]
    if not len(rows):
        raise UserError(f"{path}: --reference-topic {topic}: holds no pose")
    odometry = drive.rows[np.unique(drive.rows[:, 0], return_index=True)[1]]
    here, there = (se2.interpolate(odometry[:, 0], odometry[:, 1:], at) for at in (stamps, rows[:, 0]))
    after = np.searchsorted(rows[:, 0], stamps)
    sides = [np.clip(after - 1, 0, len(rows) - 1), np.clip(after, 0, len(rows) - 1)]
    carried = [se2.compose(rows[side, 1:], se2.relative(there[side], here)) for side in sides]
    gaps = np.stack([np.abs(stamps - rows[side, 0]) for side in sides])
    # The nearer pose counts for more; one that is too far away, not at all.
    weights = np.where(gaps <= MAX_GAP, 1 / (gaps + 1e-9), 0.0)
    known = weights.sum(axis=0) > 0
    part = weights[1] / np.where(known, weights.sum(axis=0), 1.0)
    between = carried[1] - carried[0]
    between[:, 2] = se2.wrap(between[:, 2])
    poses = carried[0] + part[:, None] * between
    poses[:, 2] = se2.wrap(poses[:, 2])
    return np.where(known[:, None], poses, np.nan)


def _row(message: Any) -> list[float]:
    """(stamp, x, y, yaw) of any message of :data:`REFERENCES`."""
    if hasattr(message, "transform"):
        return [stamp_of(message), *planar(message.transform.translation, message.transform.rotation)]
    return pose_row(message, message.pose if message.__msgtype__ == STAMPED else message.pose.pose)


def _of_tf(path: Path, tree: TfTree, drive: Any, stamps: np.ndarray, fixed: str) -> np.ndarray:
    """The base in the frame ``fixed``, through /tf, or through the odometry topic where /tf ends at its frame."""
    poses = tree.poses_in(fixed, drive.base, stamps)
    if poses is not None:
        return poses
    frame = None if drive.frame is None else tree.poses_in(fixed, drive.frame, stamps)
    if frame is None:
        frames = ", ".join(sorted({name for edge in tree.edges for name in edge}))
        raise UserError(
            f"{path}: --reference-tf {fixed}: /tf does not connect it with {drive.base}; it knows {frames or 'none'}"
        )
    odometry = drive.rows[np.unique(drive.rows[:, 0], return_index=True)[1]]
    return se2.compose(frame, at_stamps(odometry, stamps, MAX_GAP))
