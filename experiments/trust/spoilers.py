"""What can be wrong with a log, done to one that is sound."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from dsom_jax.data import RawLog, se2

Spoiler = Callable[[RawLog], RawLog]


def turned(degrees: float) -> Spoiler:
    """The log says that the lidar is turned by so much less than it is."""

    def spoil(log: RawLog) -> RawLog:
        x, y, yaw = log.lidar.mount
        return replace(log, lidar=replace(log.lidar, mount=(x, y, yaw - np.radians(degrees))))

    return spoil


def mirrored(log: RawLog) -> RawLog:
    """The driver counts its beams the other way round."""
    return replace(log, ranges=log.ranges[:, ::-1].copy())


def upside_down(log: RawLog) -> RawLog:
    """The log says that the lidar hangs head down, and it does not; or the other way round."""
    return replace(log, lidar=replace(log.lidar, upside_down=not log.lidar.upside_down))


def ranges_times(factor: float) -> Spoiler:
    """Readings in the wrong unit, and the reach with them."""

    def spoil(log: RawLog) -> RawLog:
        lidar = replace(log.lidar, range_max=log.lidar.range_max * factor)
        return replace(log, ranges=log.ranges * np.float32(factor), lidar=lidar)

    return spoil


def increment_times(factor: float) -> Spoiler:
    """An angle between beams that is wrong; the first beam is right."""
    return lambda log: replace(log, lidar=replace(log.lidar, angle_increment=log.lidar.angle_increment * factor))


def other_way(log: RawLog) -> RawLog:
    """Odometry that turns the wrong way, and goes on from there."""
    poses = [log.odometry[0]]
    for step in se2.relative(log.odometry[:-1], log.odometry[1:]) * (1, 1, -1):
        poses.append(se2.compose(poses[-1], step))
    return replace(log, odometry=np.array(poses))


def crowd(share: float) -> Spoiler:
    """Somebody at 0.5 to 3 m before this share of the beams, 15 degrees each, other ones at every scan."""

    def people(rng: np.random.Generator, ranges: np.ndarray, number: np.ndarray) -> np.ndarray:
        before = 0.5 + 2.5 * number + rng.normal(0, 0.05, ranges.shape)
        return np.minimum(np.where(np.isnan(ranges), np.inf, ranges), before)

    return _hidden(share, 0.26, people)


def glass(share: float) -> Spoiler:
    """Panes of 5 degrees before this share of the beams: half of these return from behind it, half not at all."""

    def panes(rng: np.random.Generator, ranges: np.ndarray, number: np.ndarray) -> np.ndarray:
        return np.where(rng.random(ranges.shape) < 0.5, np.inf, ranges + 3 * number)

    return _hidden(share, 0.09, panes)


def _hidden(share: float, width: float, fill: Callable[..., np.ndarray]) -> Spoiler:
    """Sectors of ``width`` radians, ``share`` of all, in which ``fill(rng, ranges, number)`` is read."""

    def spoil(log: RawLog) -> RawLog:
        rng = np.random.default_rng(0)
        shape, beams = log.ranges.shape, max(1, round(width / abs(log.lidar.angle_increment)))
        count = -(-shape[1] // beams)
        drawn = np.where(rng.random((shape[0], count)) < share, rng.uniform(0.01, 1, (shape[0], count)), 0.0)
        drawn = np.repeat(drawn, beams, 1)[:, : shape[1]]
        return replace(log, ranges=np.where(drawn > 0, fill(rng, log.ranges, drawn), log.ranges).astype(np.float32))

    return spoil
