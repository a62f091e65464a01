"""What a user may have to say about a log because the log does not, or says it wrongly."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from dsom_jax.errors import UserError
from dsom_jax.lidar import LidarConfig

UPSIDE_DOWN = "upside-down"
BAGS_ONLY = (
    "scan_topic", "scan_frame", "odom_topic", "odom_frame", "base_frame", "scan_time", "clock_offset",
    "reference_topic", "reference_tf",
)  # fmt: skip
"""Options that say nothing about logs in which each scan has its odometry beside it."""


@dataclass(frozen=True)
class LogOptions:
    """What the log does not say, or says wrongly; topics and frames are those of bags."""

    scan_topic: str | None = None
    """LaserScan of a bag that has several."""
    scan_frame: str | None = None
    """frame_id of the scans to use, where several lidars share one topic."""
    odom_topic: str | None = None
    """Odometry of a bag that has several."""
    odom_frame: str | None = None
    """Take the odometry from /tf: the frame that the base moves in."""
    base_frame: str | None = None
    """Frame of the robot whose pose is wanted; default: the one that the odometry moves."""
    mount: str | None = None
    """x,y,yaw[,upside-down] of the lidar on the base, in place of what the log says: metres and radians, or 180deg."""
    laser_min_range: float = 0.0
    """Metres; shorter readings are too close to mean anything."""
    laser_mask: tuple[str, ...] = ()
    """FROM:TO bearings in the lidar's own frame whose beams see the robot: radians, or 80deg:100deg."""
    deskew: bool = True
    """Move the beams of a scan to its stamp, as the odometry tells where each was taken."""
    scan_time: float | None = None
    """Seconds from the first beam of a scan to the last, where time_increment does not say or is wrong."""
    clock_offset: str = "0"
    """Seconds added to the stamps of the scans; auto: what fits the turns in the scans to those of the odometry."""
    reference_topic: str | None = None
    """Topic of a bag with the true pose in the map: Odometry, PoseStamped (also with covariance), TransformStamped."""
    reference_tf: str | None = None
    """Take the reference from /tf: the frame of the map."""

    def __post_init__(self) -> None:
        if not 0 <= self.laser_min_range < math.inf:
            raise UserError(f"--laser-min-range {self.laser_min_range}: give metres, 0 or more")
        if self.scan_time is not None and not 0 <= self.scan_time < 60:
            raise UserError(f"--scan-time {self.scan_time}: give seconds, 0 where all beams are taken at once")
        if self.reference_topic and self.reference_tf:
            raise UserError(f"--reference-tf {self.reference_tf}: leave it out, or --reference-topic")
        if self.odom_topic and self.odom_frame:
            raise UserError(f"--odom-frame {self.odom_frame}: leave it out, or --odom-topic")
        self.lidar_pose(), self.masked(np.zeros(0)), self.seconds()

    def lidar_pose(self) -> tuple[tuple[float, float, float], bool] | None:
        """((x, y, yaw), upside down) as ``mount`` says; None without."""
        if self.mount is None:
            return None
        words = [word.strip() for word in self.mount.split(",")]
        hangs = words[3:] == [UPSIDE_DOWN]
        try:
            x, y, yaw = float(words[0]), float(words[1]), angle(words[2])
            if len(words) != 3 + hangs or not max(abs(x), abs(y)) < 100:
                raise ValueError
        except (ValueError, IndexError):
            fix = f"give x,y,yaw or x,y,yaw,{UPSIDE_DOWN}: metres, and radians or degrees as in 0.2,0,180deg"
            raise UserError(f"--mount {self.mount}: {fix}") from None
        return (x, y, yaw), hangs

    def mounted(self, lidar: LidarConfig) -> LidarConfig:
        """The lidar where ``mount`` puts it, or where it is."""
        told = self.lidar_pose()
        return lidar if told is None else replace(lidar, mount=told[0], upside_down=told[1])

    def masked(self, bearings: np.ndarray) -> np.ndarray:
        """(B,) bool: which ``bearings`` (B,) in the frame of the lidar, radians, lie in a mask."""
        inside = np.zeros(bearings.shape, bool)
        for mask in self.laser_mask:
            try:
                start, end = (angle(word) for word in mask.split(":"))
            except ValueError:
                fix = "give FROM:TO, radians or degrees as in 80deg:100deg"
                raise UserError(f"--laser-mask {mask}: {fix}") from None
            # Counter-clockwise from the first to the second, also over pi; bearings are told in single precision.
            width = end - start if end >= start else (end - start) % (2 * np.pi)
            inside |= (bearings - start + 1e-4) % (2 * np.pi) <= width + 2e-4
        return inside

    def seconds(self) -> float | None:
        """``clock_offset`` as a number; None for auto."""
        if self.clock_offset == "auto":
            return None
        try:
            seconds = float(self.clock_offset)
            if not math.isfinite(seconds):
                raise ValueError
        except ValueError:
            raise UserError(f"--clock-offset {self.clock_offset}: give seconds, or auto") from None
        return seconds


AS_TOLD = LogOptions()
"""Nothing to add to what the log says."""


def option(name: str) -> str:
    """The word of the command line for a field."""
    return "--" + name.replace("_", "-")


def angle(word: str) -> float:
    """Radians of '0.5' or '28.6deg'; ValueError for anything else, and for what can only be degrees."""
    value = math.radians(float(word.removesuffix("deg"))) if word.endswith("deg") else float(word)
    if not abs(value) <= 2 * math.pi + 1e-3:
        raise ValueError("Did you pass degrees instead of radians?")
    return value


def apart_from_bags(options: LogOptions, path: Path) -> None:
    """UserError for an option that means nothing for a log that is no bag."""
    for name in BAGS_ONLY:
        if getattr(options, name) != getattr(AS_TOLD, name):
            value = getattr(options, name)
            raise UserError(f"{path}: {option(name)} {value}: has no use, the log is no bag; leave it out")
