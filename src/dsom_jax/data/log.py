"""A drive as it was recorded, whatever the format: scans, odometry at their stamps, the lidar, and what was skipped."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field, replace
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from dsom_jax.data import se2
from dsom_jax.errors import UserError
from dsom_jax.lidar import LidarConfig, apply_limits


@dataclass
class Report:
    """What a reader skipped or found odd: counts by kind, and the first examples of each."""

    counts: Counter[str] = field(default_factory=Counter)
    examples: dict[str, list[str]] = field(default_factory=dict)

    def add(self, kind: str, example: str = "", count: int = 1) -> None:
        """Count ``kind``; the first three examples are kept."""
        self.counts[kind] += count
        kept = self.examples.setdefault(kind, [])
        if example and len(kept) < 3:
            kept.append(example)

    def lines(self) -> list[str]:
        """One readable line for each kind."""
        return [
            f"{count} {kind}" + (f" (first: {'; '.join(self.examples[kind])})" if self.examples[kind] else "")
            for kind, count in self.counts.items()
        ]


@dataclass(frozen=True)
class RawLog:
    """N scans of B beams in the order in which they were recorded.

    Attributes:
        ranges: (N, B) float32 metres, REP-117 (+inf no return, -inf too close, NaN invalid).
        odometry: (N, 3) float64 pose of the base in the odometry frame when the scan was taken. Drifts.
        stamps: (N,) float64 seconds in the clock of the log.
        lidar: geometry of the scans, as far as the log tells.
        reference: (N, 3) float64 pose of the base in the map frame, NaN where unknown; None without a reference.
        report: what was skipped on reading.
        path: where the log was read from.
        broken: (N,) bool, the odometry jumped or was reset since the scan before; its motion there is zero. None if
            nobody looked.
    """

    ranges: np.ndarray
    odometry: np.ndarray
    stamps: np.ndarray
    lidar: LidarConfig
    reference: np.ndarray | None = None
    report: Report = field(default_factory=Report)
    path: Path = Path("log")
    broken: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.stamps)


def travelled(poses: np.ndarray) -> float:
    """Length of the path through ``poses`` (N, 3), metres; unknown poses are left out."""
    known = poses[np.isfinite(poses).all(-1), :2]
    return float(np.linalg.norm(np.diff(known, axis=0), axis=-1).sum())


def majority_beams(scans: list[np.ndarray], report: Report, path: Path) -> np.ndarray:
    """(N,) bool: which scans have the most frequent number of beams. The others are reported."""
    sizes = np.array([len(scan) for scan in scans])
    beams = Counter(sizes.tolist()).most_common(1)[0][0]
    for size, count in Counter(sizes[sizes != beams].tolist()).items():
        report.add(f"scans of {size} beams dropped, the log's lidar has {beams}", count=count)
    if beams < 1:
        raise UserError(f"{path}: the scans hold no ranges; check the scan topic or the driver of the lidar")
    return sizes == beams


def report_stamps(stamps: np.ndarray, report: Report) -> None:
    """Note scans that share a stamp with, or are older than, the scan before them. They are kept, in log order."""
    steps = np.diff(stamps)
    for kind, odd in (("scans share the stamp of the scan before", steps == 0), ("stamps run backwards", steps < 0)):
        if odd.any():
            report.add(kind, f"at {stamps[1:][odd][0]:.6f} s", int(odd.sum()))


def repeated(ranges: np.ndarray, odometry: np.ndarray, stamps: np.ndarray, report: Report) -> np.ndarray:
    """(N,) bool: scans that repeat the message before them word for word, as merged logs do."""
    again = np.zeros(len(stamps), bool)
    same_pose = (odometry[1:] == odometry[:-1]).all(-1) & (stamps[1:] == stamps[:-1])
    again[1:] = same_pose & ((ranges[1:] == ranges[:-1]) | (np.isnan(ranges[1:]) & np.isnan(ranges[:-1]))).all(-1)
    if again.any():
        report.add("repeated messages dropped", f"at {stamps[again][0]:.6f} s", int(again.sum()))
    return again


def limit_ranges(ranges: np.ndarray, range_min: float, no_return: float) -> np.ndarray:
    """REP-117 float32: readings from ``no_return`` metres on +inf, below ``range_min`` -inf.

    Exact zeros and negative numbers are no distances; drivers mean errors by them: NaN.
    """
    with np.errstate(over="ignore"):  # FLT_MAX and more is infinite, as it is meant
        ranges = np.array(ranges, np.float32)
    wrong = (ranges <= 0) & ~np.isneginf(ranges)
    ranges[ranges < range_min] = -np.inf
    ranges[ranges >= np.float32(no_return)] = np.inf
    ranges[wrong] = np.nan
    return ranges


def limited(log: RawLog, range_max: float) -> RawLog:
    """The log with readings beyond ``range_max`` metres as no return."""
    if range_max <= log.lidar.range_min:
        raise UserError(f"--laser-max-range {range_max}: must exceed the lidar's range_min, {log.lidar.range_min} m")
    lidar = replace(log.lidar, range_max=min(log.lidar.range_max, range_max))
    ranges = np.asarray(apply_limits(jnp.asarray(log.ranges), lidar))
    if not np.isfinite(ranges).any():
        raise UserError(f"--laser-max-range {range_max}: no reading of {log.path} is shorter; give a greater one")
    return replace(log, lidar=lidar, ranges=ranges)


def select(log: RawLog, keep: np.ndarray) -> RawLog:
    """The scans ``keep`` (mask or indices) of a log."""
    reference = None if log.reference is None else log.reference[keep]
    broken = None if log.broken is None else log.broken[keep]
    kept = {name: getattr(log, name)[keep] for name in ("ranges", "odometry", "stamps")}
    return replace(log, **kept, reference=reference, broken=broken)


def tidy(log: RawLog) -> RawLog:
    """Drop scans without finite odometry or stamp and repeated messages; report odd stamps."""
    finite = np.isfinite(log.odometry).all(-1) & np.isfinite(log.stamps)
    if not finite.all():
        log.report.add("scans without finite odometry and stamp dropped", count=int((~finite).sum()))
    log = select(log, finite)
    log = select(log, ~repeated(log.ranges, log.odometry, log.stamps, log.report))
    report_stamps(log.stamps, log.report)
    return log


def report_still(log: RawLog) -> None:
    """Note odometry that does not move: wheels that do not report look like this, and so does a robot at rest."""
    if len(log) < 3 or not (np.ptp(log.odometry[:, :2], axis=0) < 0.01).all():
        return
    if np.abs(se2.wrap(log.odometry[:, 2] - log.odometry[0, 2])).max() < np.radians(0.5):
        log.report.add(f"{STILL}; --odom-topic or --odom-frame chooses another")


STILL = "odometry that never moves in the whole log"


def rigid_mount(odometry: np.ndarray, sensor: np.ndarray) -> np.ndarray | None:
    """Pose (3,) of the sensor in the base frame if it is the same all along (1 cm, 0.5 deg), else None.

    Logs give the pose of the laser beside that of the robot. Where one follows rigidly from the other, it says where
    the laser is mounted; where it does not, somebody has written a corrected trajectory into it.
    """
    offsets = se2.relative(odometry, sensor)
    # Around the first heading, so that a median over angles means something.
    offsets[:, 2] = offsets[0, 2] + se2.wrap(offsets[:, 2] - offsets[0, 2])
    middle = np.median(offsets, axis=0)
    rigid = (np.abs(offsets - middle) < [0.01, 0.01, np.radians(0.5)]).all()
    return np.array([middle[0], middle[1], se2.wrap(middle[2])]) if rigid else None


def check_lidar(log: RawLog, lidar: LidarConfig | None = None) -> None:
    """Stop with a clear error where no filter could work: no scans, wrong beam count, no usable range at all."""
    lidar = lidar or log.lidar
    if len(log) == 0:
        why = f" that can be used ({'; '.join(log.report.lines())})" if log.report.counts else ""
        raise UserError(f"{log.path}: holds no scan{why}; give a log with laser scans and odometry of one clock")
    if log.ranges.shape[1] != lidar.beams:
        raise UserError(
            f"{log.path}: wrong lidar for the log: its scans have {log.ranges.shape[1]} beams, "
            f"the configuration says beams = {lidar.beams}; set beams to match"
        )
    if np.isnan(log.ranges).all():
        raise UserError(f"{log.path}: every range of every scan is NaN or zero; check the scan topic or the driver")
    returns = np.isfinite(log.ranges)
    if not returns.any():
        raise UserError(f"{log.path}: no beam returns within {lidar.range_max:g} m; check range_max and the units")
    blind = np.isnan(log.ranges).all(-1)
    if blind.any():
        log.report.add("scans in which every range is NaN", f"at {log.stamps[blind][0]:.6f} s", int(blind.sum()))
