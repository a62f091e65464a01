"""The transforms of a bag: where the lidar is mounted, what moves, and where one frame is in another over time."""

from __future__ import annotations

from array import array
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from dsom_jax.data import se2
from dsom_jax.data.trajectory import yaw_of

Edge = tuple[str, str]
"""Parent and child frame."""
FIXED = ("map", "world", "earth")
"""Names of frames that stand still, whose child is moved by a localization and not by odometry."""
_STILL = (0.01, np.radians(0.5))
"""Metres and radians that a transform may differ over a log and still be called fixed."""
MAX_GAP = 5.0
"""Seconds between two transforms that are bridged by interpolation."""


@dataclass(frozen=True)
class Mount:
    """Pose of the laser on the base: metres, radians; ``tilt`` is the angle between its axis and the vertical."""

    x: float
    y: float
    yaw: float
    upside_down: bool
    tilt: float


def mount_of(pose: np.ndarray) -> Mount:
    """The mount that a pose (4, 4) of the laser in the base frame is, seen from above."""
    axis = float(np.clip(pose[2, 2], -1.0, 1.0))
    yaw = float(np.arctan2(pose[1, 0], pose[0, 0]))
    return Mount(float(pose[0, 3]), float(pose[1, 3]), yaw, axis < 0, float(np.arccos(abs(axis))))


def seconds(stamp: Any) -> float:
    """builtin_interfaces/Time in seconds."""
    return stamp.sec + 1e-9 * stamp.nanosec


def stamp_of(message: Any) -> float:
    """Header stamp in seconds."""
    return seconds(message.header.stamp)


def pose_row(message: Any, pose: Any) -> list[float]:
    """(stamp, x, y, yaw) of a message with a header."""
    return [stamp_of(message), *planar(pose.position, pose.orientation)]


def planar(position: Any, orientation: Any) -> tuple[float, float, float]:
    """(x, y, yaw) of a ROS position and quaternion."""
    return position.x, position.y, float(yaw_of(np.array([orientation.x, orientation.y, orientation.z, orientation.w])))


def matrix(translation: Any, rotation: Any) -> np.ndarray:
    """Homogeneous (4, 4) of a ROS translation and quaternion."""
    t, q = translation, rotation
    return homogeneous(np.array([t.x, t.y, t.z, q.x, q.y, q.z, q.w], float))


def homogeneous(row: np.ndarray) -> np.ndarray:
    """Homogeneous (4, 4) of a translation and a quaternion (7,) = (x, y, z, qx, qy, qz, qw)."""
    q = row[3:] / (np.linalg.norm(row[3:]) or 1.0)
    x, y, z, w = q
    out = np.eye(4)
    out[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    out[:3, 3] = row[:3]
    return out


def last_name(frame: str) -> str:
    """A frame's name without the robot's: ``odom`` of ``robot1/odom``."""
    return frame.rsplit("/", 1)[-1]


@dataclass
class TfTree:
    """Frames of a robot. ``edges`` holds, by parent and child, rows (stamp, x, y, z, qx, qy, qz, qw), flat."""

    edges: dict[Edge, array[float]] = field(default_factory=dict)

    def add(self, message: Any) -> None:
        """Enter a tf2_msgs/TFMessage."""
        for stamped in message.transforms:
            # tf of ROS 1 wrote a leading slash.
            edge = stamped.header.frame_id.lstrip("/"), stamped.child_frame_id.lstrip("/")
            p, q = stamped.transform.translation, stamped.transform.rotation
            row = (stamp_of(stamped), p.x, p.y, p.z, q.x, q.y, q.z, q.w)
            self.edges.setdefault(edge, array("d")).extend(row)

    def table(self, edge: Edge) -> np.ndarray:
        """(M, 8) all transforms of an edge."""
        return np.asarray(self.edges[edge]).reshape(-1, 8)

    def rows(self, edge: Edge) -> np.ndarray:
        """(M, 4) = (stamp, x, y, yaw) of the child in the parent, sorted by stamp, finite."""
        table = self.table(edge)
        rows = np.column_stack([table[:, :3], yaw_of(table[:, 4:])])
        rows = rows[np.isfinite(rows).all(-1)]
        return rows[np.unique(rows[:, 0], return_index=True)[1]]

    def extent(self, edge: Edge) -> tuple[float, float]:
        """Metres and radians that the child has moved about in the parent."""
        rows = self.rows(edge)
        if len(rows) < 2:
            return 0.0, 0.0
        return float(np.ptp(rows[:, 1:3], axis=0).max()), float(np.ptp(np.unwrap(rows[:, 3])))

    def moves(self, edge: Edge) -> bool:
        """Whether the transform changes over the log."""
        return any(found > still for found, still in zip(self.extent(edge), _STILL, strict=True))

    def above(self, frame: str) -> Edge | None:
        """The edge to the parent. Of several parents the one named after odometry, then the one told most often."""
        found = [edge for edge in self.edges if edge[1] == frame]
        return max(found, key=lambda edge: ("odom" in last_name(edge[0]), len(self.edges[edge])), default=None)

    def chain(self, frame: str) -> list[Edge]:
        """The edges from ``frame`` up to its root, the lowest first; a ring is cut where it closes."""
        edges: list[Edge] = []
        while (edge := self.above(frame)) is not None and edge[0] not in {child for _, child in edges}:
            edges.append(edge)
            frame = edge[0]
        return edges

    def known(self, frame: str) -> str:
        """``frame`` as the transforms name it: with a robot's name before it, if that is the only one of its kind."""
        frames = {name for edge in self.edges for name in edge}
        alike = [name for name in frames if last_name(name) == last_name(frame)]
        return alike[0] if frame not in frames and len(alike) == 1 else frame

    def odometry_edge(self, laser: str, odom_frame: str | None = None) -> Edge | None:
        """The edge of /tf that is odometry, None without any.

        It is on the chain from the laser's frame upwards, or if that leads nowhere, anywhere. The parent's name decides
        (``odom_frame``, else one with "odom"), then what moves: below a fixed frame such as ``map``, by more
        than turning on the spot as lidars that pan do, and as near to the laser as there is.
        """
        chain = self.chain(laser)
        edges = chain if any(self.moves(edge) for edge in chain) else chain + [e for e in self.edges if e not in chain]
        if odom_frame is not None:
            named = [edge for edge in [*chain, *self.edges] if edge[0] == odom_frame]
            # Where the chain does not come by, the child that has moved most.
            return next((e for e in named if e in chain), max(named, key=self.extent, default=None))
        named = [edge for edge in edges if "odom" in last_name(edge[0]).lower()]
        moving = [edge for edge in edges if self.moves(edge)]
        driven = [edge for edge in moving if self.extent(edge)[0] > 0.05] or moving
        lower = [edge for edge in driven if last_name(edge[0]) not in FIXED] or driven
        choices = [e for e in named if e in moving and e[1] not in FIXED] or lower or named
        if chain and choices and choices[0] in chain:
            return choices[0]
        return max(choices, key=self.extent, default=None)

    def _ancestors(self, frame: str, top: str | None) -> dict[str, np.ndarray]:
        """Pose (4, 4) of ``frame`` in itself and in each frame above it, below ``top``."""
        pose, chain = np.eye(4), {frame: np.eye(4)}
        for edge in self.chain(frame):
            if edge[0] == top:
                break
            pose = homogeneous(self.table(edge)[0, 1:]) @ pose
            chain[edge[0]] = pose
        return chain

    def carrier(self, laser: str, top: str | None) -> str | None:
        """The highest frame below ``top`` that the laser hangs on; None if there is no other."""
        *_, highest = self._ancestors(laser, top)
        return None if highest == laser else highest

    def mount(self, base: str, laser: str, top: str | None = None) -> Mount | None:
        """Where the laser sits in the base frame; None if no transforms below the frame ``top`` connect them."""
        base_chain, laser_chain = self._ancestors(base, top), self._ancestors(laser, top)
        common = next((frame for frame in laser_chain if frame in base_chain), None)
        if common is None:
            return None
        return mount_of(np.linalg.inv(base_chain[common]) @ laser_chain[common])

    def poses_in(self, fixed: str, frame: str, stamps: np.ndarray) -> np.ndarray | None:
        """Poses (N, 3) of ``frame`` in the frame ``fixed`` at ``stamps``, NaN in gaps; None if not connected."""
        up = [frame] + [edge[0] for edge in self.chain(frame)]
        down = [fixed] + [edge[0] for edge in self.chain(fixed)]
        common = next((name for name in up if name in down), None)
        if common is None:
            return None
        return se2.relative(self._climbed(fixed, common, stamps), self._climbed(frame, common, stamps))

    def _climbed(self, frame: str, top: str, stamps: np.ndarray) -> np.ndarray:
        """Poses (N, 3) of ``frame`` in ``top``, which is above it."""
        poses = np.zeros((len(stamps), 3))
        for edge in self.chain(frame):
            if frame == top:
                break
            poses, frame = se2.compose(self._at(edge, stamps), poses), edge[0]
        return poses

    def _at(self, edge: Edge, stamps: np.ndarray) -> np.ndarray:
        """(N, 3) transform of an edge at ``stamps``: a fixed one always, one that moves where it is told."""
        rows = self.rows(edge)
        if not self.moves(edge):
            return np.broadcast_to(rows[0, 1:] if len(rows) else np.full(3, np.nan), (len(stamps), 3))
        return at_stamps(rows, stamps, MAX_GAP)


def at_stamps(rows: np.ndarray, stamps: np.ndarray, hold: float) -> np.ndarray:
    """Poses (N, 3) at ``stamps`` from sorted rows (M, 4), NaN outside of them and in gaps of more than ``hold`` s."""
    after = np.clip(np.searchsorted(rows[:, 0], stamps), 1, max(len(rows) - 1, 1))
    after = np.minimum(after, len(rows) - 1)
    before = np.maximum(after - 1, 0)
    # The last transform before the first scan and the first after the last are close enough.
    inside = (stamps >= rows[0, 0] - 0.2) & (stamps <= rows[-1, 0] + 0.2)
    told = inside & (rows[after, 0] - rows[before, 0] <= hold)
    return np.where(told[:, None], se2.interpolate(rows[:, 0], rows[:, 1:], stamps), np.nan)
