"""Recorded drives through a :class:`.localizer.Localizer`, update by update as on a robot."""

from __future__ import annotations

import time
from typing import Any

import jax
import numpy as np

from dsom_jax.belief.watched import Watched
from dsom_jax.judging.scores import Drive, Outcome
from dsom_jax.lidar import LidarConfig
from dsom_jax.live.localizer import Localizer
from dsom_jax.montecarlo import Result, run_keys
from dsom_jax.occupancy import OccupancyGrid
from dsom_jax.types import Key


class Live:
    """One robot that drives the segments one after another."""

    def __init__(self, filter: Watched, grid: OccupancyGrid, lidar: LidarConfig) -> None:
        self._begun = time.perf_counter()
        self._robot = Localizer(grid, lidar, filter=filter)
        self._first, self._seconds = 0.0, list[float]()

    def localize(self, drives: Any, seed: int) -> list[Outcome]:
        """Every drive once, with the luck of run 0."""
        return [self._drive(drive, run_keys(seed, number, 1)) for number, drive in enumerate(drives)]

    def _drive(self, drive: Drive, keys: Key) -> Outcome:
        infos, states, seconds = [], [], []
        self._robot.relocalize(keys)
        ranges, odometry = np.asarray(drive.episode.ranges), np.asarray(drive.episode.odometry)
        for scan, motion, stamp in zip(ranges, odometry, drive.stamps, strict=True):
            seconds.append(self._robot.advance(scan, motion, float(stamp)).seconds)
            self._first = self._first or time.perf_counter() - self._begun
            infos.append(self._robot.info)
            states.append(self._robot.state())
        info, kept = (jax.tree.map(lambda *leaves: np.stack(leaves), *rows) for rows in (infos, states))
        self._seconds += seconds
        last = jax.tree.map(lambda leaf: leaf[None], states[-1])
        return Outcome(drive, Result(jax.tree.map(lambda leaf: leaf[None], info), last, kept), sum(seconds))

    def latency_ms(self) -> dict[str, float]:
        """Milliseconds of the updates; ``first`` is from making the Localizer to its first answer."""
        ms = 1e3 * np.array(self._seconds)
        summary = {"median": np.median(ms), "p99": np.percentile(ms, 99), "max": ms.max(), "first": 1e3 * self._first}
        return {name: float(value) for name, value in summary.items()}
