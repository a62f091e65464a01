"""Transforms of a running robot: the newest seconds of every moving frame, with interpolation, without tf2."""

from __future__ import annotations

from bisect import bisect_right
from collections import deque
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from dsom_jax.data.tf_tree import Mount, matrix, mount_of, stamp_of

KEEP = 10.0
"""Seconds of transforms that are kept, as tf2 does."""
_BACK = 1.0
"""Seconds by which a stamp may run back before the clock counts as set back."""


class Transforms:
    """What ``/tf`` and ``/tf_static`` said. Not safe for threads: its owner locks."""

    def __init__(self) -> None:
        self._fixed: dict[str, tuple[str, np.ndarray]] = {}
        self._moving: dict[str, tuple[str, deque[tuple[float, np.ndarray]]]] = {}

    def add(self, message: Any, static: bool = False) -> None:
        """Enter a tf2_msgs/TFMessage; transforms that are not finite are left out."""
        for stamped in message.transforms:
            # tf of ROS 1 wrote a leading slash.
            parent, child = stamped.header.frame_id.lstrip("/"), stamped.child_frame_id.lstrip("/")
            pose = matrix(stamped.transform.translation, stamped.transform.rotation)
            if not np.isfinite(pose).all():
                continue
            if static:
                self._fixed[child] = parent, pose
            else:
                self._enter(parent, child, stamp_of(stamped), pose)

    def _enter(self, parent: str, child: str, stamp: float, pose: np.ndarray) -> None:
        known, poses = self._moving.get(child, (parent, deque()))
        if known != parent or (poses and stamp < poses[-1][0] - _BACK):
            poses = deque()
        if poses and stamp <= poses[-1][0]:
            return
        poses.append((stamp, pose))
        while poses[0][0] < stamp - KEEP:
            poses.popleft()
        self._moving[child] = parent, poses

    def planar(self, parent: str, child: str, stamp: float) -> np.ndarray | None:
        """Pose (3,) of ``child`` in ``parent`` at ``stamp``, seen from above; None while it cannot be told."""
        pose = self._pose(parent, child, stamp)
        return None if pose is None else np.array([pose[0, 3], pose[1, 3], np.arctan2(pose[1, 0], pose[0, 0])])

    def mount(self, base: str, laser: str, stamp: float) -> Mount | None:
        """Where the laser sits on the base; None while it cannot be told."""
        pose = self._pose(base, laser, stamp)
        return None if pose is None else mount_of(pose)

    def _chain(self, frame: str) -> list[str]:
        """``frame`` and all above it."""
        chain = [frame]
        while (above := (self._fixed.get(chain[-1]) or self._moving.get(chain[-1]))) and above[0] not in chain:
            chain.append(above[0])
        return chain

    def _pose(self, parent: str, child: str, stamp: float) -> np.ndarray | None:
        ups, downs = self._chain(child.lstrip("/")), self._chain(parent.lstrip("/"))
        common = next((frame for frame in ups if frame in downs), None)
        if common is None:
            return None
        child_pose = self._climb(ups[: ups.index(common)], stamp)
        parent_pose = self._climb(downs[: downs.index(common)], stamp)
        return None if child_pose is None or parent_pose is None else np.linalg.inv(parent_pose) @ child_pose

    def _climb(self, frames: list[str], stamp: float) -> np.ndarray | None:
        """Pose of the first of ``frames`` in the parent of the last."""
        pose = np.eye(4)
        for frame in frames:
            step = self._fixed[frame][1] if frame in self._fixed else self._at(frame, stamp)
            if step is None:
                return None
            pose = step @ pose
        return pose

    def _at(self, frame: str, stamp: float) -> np.ndarray | None:
        """Transform of a moving frame, interpolated; None before the first and after the last."""
        poses = self._moving[frame][1]
        after = bisect_right(poses, stamp, key=lambda entry: entry[0])
        if after == 0 or (after == len(poses) and stamp > poses[-1][0]):
            return None
        t0, a = poses[after - 1]
        if after == len(poses) or t0 == stamp:
            return a
        t1, b = poses[after]
        return between(a, b, (stamp - t0) / (t1 - t0))


def between(a: np.ndarray, b: np.ndarray, share: float) -> np.ndarray:
    """Transform (4, 4) a ``share`` of the way from ``a`` to ``b``: straight, and turning about one axis."""
    out = np.eye(4)
    out[:3, 3] = (1 - share) * a[:3, 3] + share * b[:3, 3]
    turn = Rotation.from_matrix(a[:3, :3].T @ b[:3, :3]).as_rotvec()
    out[:3, :3] = a[:3, :3] @ Rotation.from_rotvec(share * turn).as_matrix()
    return out
