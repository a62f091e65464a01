"""Scan against scan: how the sensor moved between two scans, found without any odometry.

A coarse search over turns and shifts in a blurred picture of the first scan, then point-to-line ICP (Censi 2008) from
its best places. Nothing is assumed but that the world stood still: a mirrored scan matches a mirrored scan as well.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from scipy.spatial import cKDTree

from dsom_jax.data import se2
from dsom_jax.lidar import LidarConfig

_REACH = 20.0
"""Metres; longer readings say little about a step of a metre and cost room in the picture."""
_TURN, _SHIFT = 0.95, 1.6
"""The coarse search looks this far: radians, metres."""
CELL = 0.1
NEIGHBOURS = 7
"""Points through which the line at a point is laid."""
_CLOSE = 0.12
"""Metres within which a matched point lies on the other scan."""


class Match(NamedTuple):
    """How a scan lies in the frame of another.

    Attributes:
        move: (3,) pose of the second sensor in the frame of the first (m, m, rad).
        information: (3, 3) inverse covariance of ``move`` up to one common factor; singular along a bare corridor.
        share: of the points of the second scan in view of the first, those within ``_CLOSE`` of it.
    """

    move: np.ndarray
    information: np.ndarray
    share: float


def bearings(lidar: LidarConfig) -> np.ndarray:
    """(B,) bearings in the frame of the sensor, its yaw on the base left out."""
    return lidar.angles().astype(float) - lidar.mount[2]


def points_of(scan: np.ndarray, angles: np.ndarray, cell: float, reach: float = _REACH) -> np.ndarray:
    """(n, 2) returns of a scan (B,), one for each ``cell`` metres of wall."""
    used = np.isfinite(scan) & (scan < reach)
    points = scan[used, None] * np.column_stack([np.cos(angles[used]), np.sin(angles[used])])
    return thinned(points, cell)


def thinned(points: np.ndarray, cell: float) -> np.ndarray:
    """The first of the points (n, 2) in each cell."""
    keys = np.round(points / cell).astype(np.int64)
    _, first = np.unique(keys[:, 0] * 1_000_003 + keys[:, 1], return_index=True)
    return points[np.sort(first)]


def transform(pose: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Points (n, 2) of the frame ``pose`` (3,) in its parent."""
    c, s = np.cos(pose[2]), np.sin(pose[2])
    return points @ np.array([[c, s], [-s, c]]) + pose[:2]


class Reference:
    """The scan that others are held against: a picture for the coarse search, points with normals for the fine one."""

    def __init__(self, scan: np.ndarray, angles: np.ndarray) -> None:
        self.points = points_of(scan, angles, 0.05)
        self.tree = cKDTree(self.points)
        self.normals = normals(self.points, self.tree)
        self.view = (float(angles.min()), float(angles.max()))

    def picture(self) -> tuple[np.ndarray, int]:
        """uint8 (S, S) nearness to the scan, 255 on it, and the cell of the sensor."""
        half = int((_REACH + 2 * _SHIFT) / CELL) + 2
        blank = np.full((2 * half + 1, 2 * half + 1), 255, np.uint8)
        cells = np.floor(self.points / CELL + 0.5).astype(int) + half
        blank[cells[:, 1], cells[:, 0]] = 0
        distance = cv2.distanceTransform(blank, cv2.DIST_L2, 3) * CELL
        return (255 * np.exp(-0.5 * (np.minimum(distance, 1.0) / 0.2) ** 2)).astype(np.uint8), half

    def sees(self, points: np.ndarray) -> np.ndarray:
        """(n,) bool, points (n, 2) within the field of view."""
        middle, width = sum(self.view) / 2, (self.view[1] - self.view[0]) / 2
        return np.abs(se2.wrap(np.arctan2(points[:, 1], points[:, 0]) - middle)) <= width


def normals(points: np.ndarray, tree: cKDTree) -> np.ndarray:
    """(n, 2) unit normals of the lines through each point's neighbours."""
    near = points[tree.query(points, min(NEIGHBOURS, len(points)))[1]]
    off = near - near.mean(1, keepdims=True)
    xx, yy, xy = (off[..., 0] ** 2).mean(1), (off[..., 1] ** 2).mean(1), (off[..., 0] * off[..., 1]).mean(1)
    along = 0.5 * np.arctan2(2 * xy, xx - yy)
    return np.column_stack([-np.sin(along), np.cos(along)])


def match(reference: Reference, points: np.ndarray) -> Match | None:
    """The best place of ``points`` (n, 2) of another scan; None where either shows too little."""
    if len(points) < 20 or len(reference.points) < 20:
        return None
    first, second = coarse(reference, points)
    found = _refine(reference, points, first)
    return found if found.share > 0.75 else max(found, _refine(reference, points, second), key=lambda m: m.share)


def coarse(reference: Reference, points: np.ndarray) -> list[np.ndarray]:
    """The two best poses of different turns on the grid of turns and shifts."""
    few = points[np.linspace(0, len(points) - 1, min(len(points), 60)).astype(int)]
    picture, half = reference.picture()
    turns = np.arange(-_TURN, _TURN + 1e-9, 0.05)
    steps = 2 * np.arange(-int(_SHIFT / (2 * CELL)), int(_SHIFT / (2 * CELL)) + 1)
    c, s = np.cos(turns)[:, None], np.sin(turns)[:, None]
    cells = np.stack([c * few[:, 0] - s * few[:, 1], s * few[:, 0] + c * few[:, 1]]) / CELL
    i, j = np.floor(cells[1] + 0.5).astype(np.int32) + half, np.floor(cells[0] + 0.5).astype(np.int32) + half
    shifts = (steps[:, None] * picture.shape[1] + steps).ravel().astype(np.int32)
    flat = (i * picture.shape[1] + j)[:, None, :] + shifts[:, None]
    score = picture.ravel()[flat].sum(-1, dtype=np.int32)
    best, at = score.max(1), score.argmax(1)
    poses = []
    for _ in range(2):
        k = int(best.argmax())
        di, dj = divmod(int(at[k]), len(steps))
        poses.append(np.array([steps[dj] * CELL, steps[di] * CELL, turns[k]]))
        best = np.where(np.abs(turns - turns[k]) < 0.2, -1, best)
    return poses


def _refine(reference: Reference, points: np.ndarray, start: np.ndarray, gates: tuple[float, ...] = (0.5, 0.3, 0.2)
           ) -> Match:  # fmt: skip
    """Point-to-line ICP from ``start`` (3,), with ever closer partners."""
    pose, information = start.copy(), np.zeros((3, 3))
    for gate in np.repeat(gates, 4):
        placed = transform(pose, points)
        distance, partner = reference.tree.query(placed, distance_upper_bound=gate)
        met = np.isfinite(distance)
        if met.sum() < 10:
            break
        normal, arm = reference.normals[partner[met]], placed[met] - pose[:2]
        error = (normal * (placed[met] - reference.points[partner[met]])).sum(1)
        rows = np.column_stack([normal, normal[:, 1] * arm[:, 0] - normal[:, 0] * arm[:, 1]])
        weight = 1 / np.maximum(np.abs(error) / 0.05, 1)
        information = rows.T @ (weight[:, None] * rows)
        step = np.linalg.solve(information + 1e-3 * np.eye(3), -rows.T @ (weight * error))
        pose = pose + step
        if np.abs(step).max() < 1e-4 and gate == gates[-1]:
            break
    pose[2] = se2.wrap(pose[2])
    placed = transform(pose, points)
    seen = reference.sees(placed)
    close = reference.tree.query(placed, distance_upper_bound=_CLOSE)[0] < np.inf
    return Match(pose, information, float((close & seen).sum() / max(seen.sum(), 20)))
