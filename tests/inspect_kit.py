"""A floor of rooms in plain NumPy, a robot that drives through it, and its scans, for the tests of ``inspect``."""

from __future__ import annotations

from functools import cache

import numpy as np

from dsom_jax.data import RawLog
from dsom_jax.lidar import LidarConfig
from dsom_jax.occupancy import OccupancyGrid, from_cells

RESOLUTION = 0.1
LIDAR = LidarConfig(beams=181, angle_min=-np.pi / 2, angle_increment=np.pi / 180, range_max=12.0)
WAY = ((1.5, 1.5), (4.0, 1.4), (4.6, 4.4), (8.2, 4.6), (8.8, 1.6), (12.4, 1.7), (13.2, 5.0), (10.6, 7.6), (7.4, 7.8),
       (7.0, 5.0), (3.0, 4.6), (2.0, 7.8))  # fmt: skip


@cache
def cells() -> np.ndarray:
    """(95, 150) bool: four rooms and a hall, no two alike, some furniture."""
    occupied = np.zeros((95, 150), bool)
    for x0, y0, x1, y1 in (
        (0, 0, 15, 0.1), (0, 9.4, 15, 9.5), (0, 0, 0.1, 9.5), (14.9, 0, 15, 9.5),
        (0, 3.4, 3.8, 3.5), (5.4, 3.4, 8.0, 3.5), (9.6, 3.4, 12.2, 3.5), (14.2, 3.4, 15, 3.5),
        (6.2, 0, 6.3, 3.5), (10.8, 0, 10.9, 0.9), (10.8, 2.4, 10.9, 3.5),
        (0, 6.2, 1.2, 6.3), (2.8, 6.2, 6.2, 6.3), (5.0, 6.2, 5.1, 9.5), (9.2, 6.0, 9.3, 7.0), (9.2, 8.4, 9.3, 9.5),
        (11.9, 6.2, 15, 6.3), (0.6, 0.3, 1.0, 0.8), (2.6, 2.4, 3.1, 3.1), (7.0, 0.3, 7.9, 0.7), (14.0, 0.4, 14.6, 1.3),
        (0.4, 4.2, 0.8, 5.4), (10.2, 4.3, 10.6, 4.7), (6.0, 8.7, 6.9, 9.2), (11.6, 8.6, 12.0, 9.0), 
        (3.6, 8.2, 4.2, 8.6),
    ):  # fmt: skip
        i0, j0, i1, j1 = (round(v / RESOLUTION) for v in (y0, x0, y1, x1))
        occupied[i0:i1, j0:j1] = True
    return occupied


def grid() -> OccupancyGrid:
    """The floor as a map, its frame off the corner."""
    return from_cells(cells(), resolution=RESOLUTION, origin=(-2.0, 1.0, 0.0))


@cache
def path(step: float = 0.35, turn: float = 0.35) -> np.ndarray:
    """(n, 3) poses on the floor: straight between the points of the way, turning on the spot at each."""
    poses = [np.array([*WAY[0], 0.0])]
    for goal in WAY[1:]:
        off = np.array(goal) - poses[-1][:2]
        heading = np.arctan2(off[1], off[0])
        about = (heading - poses[-1][2] + np.pi) % (2 * np.pi) - np.pi
        for part in np.linspace(0, about, int(abs(about) / turn) + 2)[1:]:
            poses.append(np.array([*poses[-1][:2], heading - about + part]))
        here = poses[-1][:2].copy()
        for part in np.linspace(0, 1, int(np.hypot(*off) / step) + 2)[1:]:
            poses.append(np.array([*(here + part * off), heading]))
    return np.array(poses)


def march(pose: np.ndarray, angles: np.ndarray, reach: float = 12.0) -> np.ndarray:
    """(b,) ranges from a pose on the floor, by steps of 2 cm: slow and obvious; inf where no wall is in reach."""
    far = np.arange(0, reach, 0.02)[:, None]
    j = np.floor((pose[0] + far * np.cos(pose[2] + angles)) / RESOLUTION).astype(int)
    i = np.floor((pose[1] + far * np.sin(pose[2] + angles)) / RESOLUTION).astype(int)
    inside = (i >= 0) & (j >= 0) & (i < cells().shape[0]) & (j < cells().shape[1])
    hit = inside & cells()[np.where(inside, i, 0), np.where(inside, j, 0)]
    return np.where(hit.any(0), far[hit.argmax(0), 0], np.inf)


@cache
def _scans() -> np.ndarray:
    noise = np.random.default_rng(1).normal(0, 0.01, (len(path()), LIDAR.beams))
    return np.array([march(pose, LIDAR.angles()) for pose in path()]) + noise


def drive() -> RawLog:
    """The whole way: 180 deg of noisy scans half a second apart, odometry off by 2 %, the truth as reference."""
    rng, truth = np.random.default_rng(0), path()
    moves = np.diff(truth, axis=0)
    turns = (moves[:, 2] + np.pi) % (2 * np.pi) - np.pi
    far = np.hypot(moves[:, 0], moves[:, 1]) * (1 + rng.normal(0, 0.02, len(moves)))
    heading = np.concatenate([[0.0], np.cumsum(turns * (1 + rng.normal(0, 0.02, len(moves))))])
    along = np.column_stack([far * np.cos(heading[:-1]), far * np.sin(heading[:-1])])
    odometry = np.column_stack([np.concatenate([np.zeros((1, 2)), np.cumsum(along, 0)]), heading])
    reference = truth + np.array([-2.0, 1.0, 0.0])
    stamps = 100.0 + 0.5 * np.arange(len(truth))
    return RawLog(_scans().astype(np.float32), odometry, stamps, LIDAR, reference)
