"""Logs of CARMEN: FLASER (the robot-laser message of 2002-2005), ROBOTLASER1 (from 2006), RAWLASER1 or LASER with ODOM.

One message a line, fields separated by blanks (CARMEN's readlog.c):

    FLASER n r1..rn  laser_x laser_y laser_theta  odom_x odom_y odom_theta  stamp host logger_stamp
    ROBOTLASER1 type start_angle fov resolution max_range accuracy remission_mode  n r1..rn  m e1..em
        laser_x laser_y laser_theta  odom_x odom_y odom_theta  tv rv forward side turn  stamp host logger_stamp
    RAWLASER1 type start_angle fov resolution max_range accuracy remission_mode  n r1..rn  m e1..em
        stamp host logger_stamp
    LASER n r1..rn  stamp host logger_stamp
    ODOM x y theta tv rv accel  stamp host logger_stamp
    PARAM name value ...

The rear laser (RLASER, ROBOTLASER2, RAWLASER2) and other messages are left out. A line that cannot be read is counted.
Only the odometry reaches a filter: the laser triple says where the laser is mounted if it follows the odometry rigidly,
and is the reference trajectory, as SLAM programs write it, if it does not.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TypeVar

import numpy as np

from dsom_jax.data import se2
from dsom_jax.data.carmen_lidar import LaserConfig, guess_config, lidar_of
from dsom_jax.data.files import read_lines
from dsom_jax.data.log import RawLog, Report, limit_ranges, majority_beams, rigid_mount, tidy
from dsom_jax.data.log_options import AS_TOLD, LogOptions
from dsom_jax.data.odometry import mended, odometry_at
from dsom_jax.data.scans import TURN, brought_together, differing, onto, table
from dsom_jax.errors import UserError

WITH_POSE = ("FLASER", "ROBOTLASER1")
WITHOUT_POSE = ("RAWLASER1", "LASER")
ALIKE = 0.2
"""Scans of one lidar differ by at most this share in number and angles of their beams; others are of another lidar."""
FINEST = 1e-4
"""Radians between beams; no lidar has less."""
_T = TypeVar("_T")


@dataclass
class CarmenMessages:
    """What the lines of a log say: one entry for each scan in ``ranges``, ``poses`` (laser, then odometry: (6,)) and
    ``stamps``; ``odometry`` rows are (stamp, x, y, theta)."""

    ranges: list[np.ndarray] = field(default_factory=list)
    poses: list[np.ndarray] = field(default_factory=list)
    stamps: list[float] = field(default_factory=list)
    configs: list[LaserConfig] = field(default_factory=list)
    odometry: list[np.ndarray] = field(default_factory=list)
    params: dict[str, str] = field(default_factory=dict)
    report: Report = field(default_factory=Report)


def load_carmen(path: str | Path, options: LogOptions = AS_TOLD, range_max: float | None = None) -> RawLog:
    """Scans, odometry and, where the log holds one, the reference of a ``.log``, ``.clf`` or ``.gz`` file.

    Readings from ``range_max`` metres on are no returns. Without it the value comes from ``meta.yaml`` beside the log,
    from the log's own messages, or is detected (see :func:`dsom_jax.data.range_codes.detect_no_return`).
    """
    path = Path(path)
    messages = _parse(read_lines(path, "log"))
    if not messages.stamps:
        raise UserError(
            f"{path}: holds no FLASER, ROBOTLASER1 or RAWLASER1 line, so it is not a CARMEN log of a front laser"
            + "".join(f"; {line}" for line in messages.report.lines()[:2])
        )
    keep, ranges, config = _of_one_lidar(messages, path)
    stamps = np.array(messages.stamps)[keep]
    odometry, broken, mount, reference = _poses(messages, keep, stamps, path)
    lidar = options.mounted(lidar_of(path, ranges, config, messages.params, mount, range_max))
    if reference is not None:
        reference = se2.compose(reference, se2.inverse(np.array(lidar.mount)))
    ranges = limit_ranges(ranges, lidar.range_min, lidar.range_max)
    return tidy(RawLog(ranges, odometry, stamps, lidar, reference, messages.report, path, broken))


def _parse(lines: list[str]) -> CarmenMessages:
    """Messages of a log; what cannot be read is counted in the report."""
    messages = CarmenMessages()
    # Logs may hold the same scan raw and with the robot's pose: the one with the pose is enough.
    present = {line.split(None, 1)[0] for line in lines if not line.isspace() and line}
    wanted = next((kind for kind in WITH_POSE + WITHOUT_POSE if kind in present), None)
    for number, line in enumerate(lines, start=1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        try:
            _message(messages, words, wanted)
        except (ValueError, IndexError):
            messages.report.add("unreadable lines skipped", f"line {number}: '{' '.join(words)[:40]}'")
    return messages


def _message(messages: CarmenMessages, words: list[str], wanted: str | None) -> None:
    """Enter one line; ValueError or IndexError if it is malformed."""
    kind = words[0]
    if kind == wanted:
        _scan(messages, words)
    elif kind == "ODOM":
        x, y, theta, *_, stamp = (float(w) for w in words[1:8])
        if not np.isfinite([x, y, theta, stamp]).all() or len(words) < 8:
            raise ValueError("odometry")
        messages.odometry.append(np.array([stamp, x, y, theta]))
    elif kind == "PARAM":
        messages.params[words[1]] = words[2]
    elif re.fullmatch("[A-Z][A-Z0-9_]*", kind):
        messages.report.add(f"{kind} messages not used")
    else:
        raise ValueError("not a message")


def _scan(messages: CarmenMessages, words: list[str]) -> None:
    """Enter a laser message of any of the four forms."""
    kind = words[0]
    config, rest = (None, words[1:]) if kind in ("FLASER", "LASER") else (_config(words), words[8:])
    count = int(rest[0])
    if not 0 < count < len(rest):
        raise ValueError("number of readings")
    ranges, rest = np.array([float(w) for w in rest[1 : count + 1]]), rest[count + 1 :]
    if config is not None:
        rest = rest[int(rest[0]) + 1 :]
    poses = np.array(rest[:6] if kind in WITH_POSE else [np.nan] * 6, float)
    skip = {"FLASER": 6, "ROBOTLASER1": 11}.get(kind, 0)
    stamp = float(rest[skip])
    if len(rest) > skip + 3:
        raise ValueError("more fields than readings and poses account for")
    if (kind in WITH_POSE and not np.isfinite(poses).all()) or not np.isfinite(stamp):
        raise ValueError("poses and stamp")
    messages.ranges.append(ranges)
    messages.poses.append(poses)
    messages.stamps.append(stamp)
    messages.configs.append(config or guess_config(count))


def _config(words: list[str]) -> LaserConfig:
    """Geometry that a message of 2006 and later carries."""
    start, _, resolution, maximum = (float(w) for w in words[2:6])
    if not np.isfinite([start, resolution]).all():
        raise ValueError("angles")
    return LaserConfig(start, resolution, maximum)


def _of_one_lidar(messages: CarmenMessages, path: Path) -> tuple[np.ndarray, np.ndarray, LaserConfig]:
    """Which scans (M,) bool are of the lidar, their ranges (N, B) on the same beams, and the geometry of these."""
    counts = np.array([len(scan) for scan in messages.ranges])
    start, step = (np.array([getattr(c, name) for c in messages.configs]) for name in ("start_angle", "resolution"))
    sound = (np.abs(start) <= TURN) & (np.abs(step) >= FINEST) & (np.abs(step) <= TURN)
    if not sound.all():  # angles that cannot be tell nothing; meta.yaml may know better
        keep = majority_beams(messages.ranges, messages.report, path)
        return keep, np.stack(_chosen(messages.ranges, keep)), _chosen(messages.configs, keep)[0]
    keep = _alike(counts, start, step, messages.report)
    chosen, still = _chosen(messages.ranges, keep), np.zeros(int(keep.sum()))
    last = start + step * (counts - 1)
    scans = table(chosen, stamps=still, start=start[keep], end=last[keep], step=step[keep], beam_time=still)
    scans, beams = brought_together(scans, messages.report)
    ranges = onto(scans, beams).astype(float)
    for n in np.flatnonzero(~differing(scans, beams)):
        ranges[n] = chosen[n]  # as they are, not in single precision
    return keep, ranges, replace(_chosen(messages.configs, keep)[0], start_angle=beams.start, resolution=beams.step)


def _chosen(rows: Sequence[_T], keep: np.ndarray) -> list[_T]:
    """The rows that are kept."""
    return [row for row, kept in zip(rows, keep, strict=True) if kept]


def _alike(counts: np.ndarray, start: np.ndarray, step: np.ndarray, report: Report) -> np.ndarray:
    """(M,) bool: scans with about the number of beams and the angles (start and step, radians) of most."""
    usual = counts[np.argmin(np.abs(counts - np.median(counts)))]
    near = np.abs(counts - usual) <= ALIKE * usual
    middle, first = np.median(step[near]), np.median(start[near])
    turned = np.abs(start - first) > ALIKE * usual * abs(middle)
    same = near & (np.abs(step - middle) <= ALIKE * abs(middle)) & ~turned
    if not same.any():
        same = (counts == counts[near][0]) & (start == start[near][0]) & (step == step[near][0])
    if not near.all():
        low, high = counts[~near].min(), counts[~near].max()
        told = f"{low}" if low == high else f"{low} to {high}"
        report.add(f"scans of {told} beams dropped, the log's lidar has {usual}", count=int((~near).sum()))
    if (near & ~same).any():
        report.add("scans of other angles than most dropped", count=int((near & ~same).sum()))
    return same


def _poses(
    messages: CarmenMessages, keep: np.ndarray, stamps: np.ndarray, path: Path
) -> tuple[np.ndarray, np.ndarray, np.ndarray | None, np.ndarray | None]:
    """Odometry (N, 3) at the scans and where it jumped (N,), the mount (3,) if the log tells it, and the corrected
    poses of the laser (N, 3)."""
    poses = np.array(messages.poses)[keep]
    if np.isfinite(poses).all():
        laser, odometry = poses[:, :3], poses[:, 3:]
        if (laser == odometry).all() and len(poses) > 20:
            kind = "scans whose pose of the laser is that of the odometry, word for word"
            messages.report.add(f"{kind}: if a SLAM program wrote the log, the odometry is corrected", count=len(poses))
        mount = rigid_mount(odometry, laser)
        return *_without_jumps(odometry, stamps, messages.report), mount, laser if mount is None else None
    if len(messages.odometry) < 2:
        fix = "record FLASER or ODOM lines too, or make odometry from the scans"
        raise UserError(f"{path}: neither its laser messages nor ODOM lines give odometry; {fix}")
    return *odometry_at(np.array(messages.odometry), stamps, messages.report), None, None


def _without_jumps(odometry: np.ndarray, stamps: np.ndarray, report: Report) -> tuple[np.ndarray, np.ndarray]:
    """Odometry (N, 3) of the scans as it is, or if it jumps, with no motion across the jumps; and where (N,) it did."""
    rows = mended(np.column_stack([stamps, odometry]), report)
    if not len(rows.breaks) and len(rows.rows) == len(np.unique(stamps)):
        return odometry, np.zeros(len(stamps), bool)
    return se2.interpolate(rows.rows[:, 0], rows.rows[:, 1:], stamps), rows.broken(stamps)
