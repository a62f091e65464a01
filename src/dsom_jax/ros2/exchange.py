"""What the node and its engine hand each other, and what the engine retains from scan to scan."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from dsom_jax.live import Answer
from dsom_jax.occupancy import OccupancyGrid


class Output(NamedTuple):
    """What one scan led to.

    Attributes:
        answer: where the robot is.
        map_to_odom: (3,) pose of the odometry frame in the map, or None while there is none to be trusted.
        beams: valid ranges of the scan.
        latency: seconds from the arrival of the scan to the answer.
    """

    answer: Answer
    map_to_odom: np.ndarray | None
    beams: int
    latency: float


@dataclass
class Counts:
    """What became of the scans so far, and the latencies (s) of the last hundred answers."""

    received: int = 0
    answered: int = 0
    updated: int = 0
    dropped: int = 0
    latencies: deque[float] = field(default_factory=lambda: deque(maxlen=100))


class Told(NamedTuple):
    """An initial pose (3,) and its covariance (3, 3).

    Attributes:
        stamp: when the robot was there; 0 means now.
        odometry: (3,) pose of the odometry then, if that was known when the pose came.
    """

    pose: np.ndarray
    covariance: np.ndarray
    stamp: float
    odometry: np.ndarray | None = None


class Trusted(NamedTuple):
    """Where the odometry frame lies in the map (3,), right whatever the robot drives, and the pose's covariance."""

    map_to_odom: np.ndarray
    covariance: np.ndarray


def same(a: OccupancyGrid, b: OccupancyGrid) -> bool:
    """Whether two maps are equal, cell by cell: a map server sends its map again when it is activated again."""
    if (a.shape, a.resolution) != (b.shape, b.resolution):
        return False
    return all(np.array_equal(getattr(a, name), getattr(b, name)) for name in ("origin", "occupied", "free"))
