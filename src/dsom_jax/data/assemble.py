"""Scans and odometry of any source made into one log: angles, codes, clocks and the time between beams put right."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from dsom_jax.data import se2
from dsom_jax.data.clocks import Offset, find_offset
from dsom_jax.data.log import RawLog, Report, limit_ranges, tidy
from dsom_jax.data.log_options import LogOptions
from dsom_jax.data.odometry import Odometry, mended, report_uncovered
from dsom_jax.data.range_codes import reach_of, zero_is_no_return
from dsom_jax.data.scans import Beams, Scans, brought_together, deskewed, onto, with_right_steps
from dsom_jax.data.turns import middle_of, turns
from dsom_jax.errors import UserError
from dsom_jax.lidar import LidarConfig


@dataclass(frozen=True)
class Sensor:
    """What is known of a lidar beside its beams.

    Attributes:
        range_min, range_max: metres, as told; may be no number.
        scan_time: seconds of a scan as told, 0 where not.
        mount: (x, y, yaw) on the base, metres and radians.
        upside_down: it hangs head down.
    """

    range_min: float
    range_max: float
    scan_time: float = 0.0
    mount: tuple[float, float, float] = (0.0, 0.0, 0.0)
    upside_down: bool = False


def assemble(scans: Scans, rows: np.ndarray, sensor: Sensor, options: LogOptions, report: Report, path: Path) -> RawLog:
    """The log of ``scans`` with odometry rows (M, 4) = (stamp, x, y, theta) of the base, wherever these come from."""
    scans = replace(scans, stamps=scans.stamps + (options.seconds() or 0.0))
    odometry = mended(rows, report)
    reach = reach_of(scans.ranges, sensor.range_min, sensor.range_max, report)
    scans = with_right_steps(scans, odometry.at(scans.stamps)[:, 2], reach, report)
    scans, beams = brought_together(scans, report)
    lidar = _lidar(beams, sensor, reach, options, path)
    nothing = zero_is_no_return(scans.ranges, lidar.range_max, report)
    ranges = np.where(scans.ranges == 0, np.float32(np.inf), scans.ranges) if nothing else scans.ranges
    scans = replace(scans, ranges=limit_ranges(ranges, lidar.range_min, lidar.range_max))
    scans = _timed(scans, sensor, odometry, options, report)
    scans = _in_time(scans, beams, odometry, lidar, options, report)
    poses = odometry.at(scans.stamps)
    report_uncovered(odometry, scans.stamps, poses, report)
    seconds = scans.beam_time * (scans.counts - 1)
    motion = se2.relative(poses, odometry.at(scans.stamps + seconds))
    final = deskewed(scans, motion, beams, lidar) if options.deskew and seconds.any() else onto(scans, beams)
    broken = odometry.broken(scans.stamps)
    return tidy(RawLog(final, poses, scans.stamps, lidar, None, report, path, broken))


def _lidar(beams: Beams, sensor: Sensor, reach: float, options: LogOptions, path: Path) -> LidarConfig:
    """The geometry of the log."""
    try:
        return options.mounted(
            LidarConfig(
                beams=beams.count,
                angle_min=beams.start,
                angle_increment=beams.step,
                range_min=sensor.range_min if np.isfinite(sensor.range_min) and sensor.range_min > 0 else 0.0,
                range_max=reach,
                mount=sensor.mount,
                upside_down=sensor.upside_down,
            )
        )
    except ValueError as error:
        raise UserError(f"{path}: LaserScan: {error}; repair the driver's message") from None


def _timed(scans: Scans, sensor: Sensor, odometry: Odometry, options: LogOptions, report: Report) -> Scans:
    """The scans with a time from beam to beam that can be: ``--scan-time``, else as told if scans do not overlap."""
    gaps = np.maximum(scans.counts - 1, 1)
    if options.scan_time is not None:
        return replace(scans, beam_time=options.scan_time / gaps)
    beam_time = np.nan_to_num(scans.beam_time, posinf=0.0, neginf=0.0)
    steps = np.diff(scans.stamps)
    period = float(np.median(steps[steps > 0])) if (steps > 0).any() else 0.0
    wrong = np.abs(beam_time) * gaps > 1.2 * period if period else np.zeros(len(scans), bool)
    if wrong.any():
        told = f"{float(beam_time[wrong][0]):.3g} s from beam to beam, a scan each {period:.3g} s"
        kind = "scans whose time_increment is too long, not used; --scan-time says how long a scan takes"
        report.add(kind, told, int(wrong.sum()))
    elif not beam_time.any() and 0 < sensor.scan_time <= 1.2 * period and _turns_much(scans, odometry, sensor):
        kind = f"scans with a scan_time of {sensor.scan_time:.3g} s and no time_increment: taken at once"
        report.add(f"{kind}; if they are not, give --scan-time {sensor.scan_time:.3g}", count=len(scans))
    return replace(scans, beam_time=np.where(wrong, 0.0, beam_time))


def _turns_much(scans: Scans, odometry: Odometry, sensor: Sensor) -> bool:
    """Whether in a tenth of the scans the robot turns by two beams and more while one is taken."""
    rates = np.abs(se2.wrap(np.diff(odometry.rows[:, 3]))) / np.diff(odometry.rows[:, 0])
    return len(rates) > 0 and np.quantile(rates, 0.9) * sensor.scan_time > 2 * np.median(np.abs(scans.step))


def _in_time(
    scans: Scans, beams: Beams, odometry: Odometry, lidar: LidarConfig, options: LogOptions, report: Report
) -> Scans:
    """The scans on the clock of the odometry, if ``--clock-offset auto`` asks for it; else an offset is only said."""
    found = clock_offset(scans, beams, odometry, lidar)
    automatic = options.seconds() is None
    if found is None:
        if automatic:
            report.add("clock offset asked for and none found: the stamps are left as they are")
        return scans
    if automatic:
        report.add(f"clock offset corrected: {found.seconds:+.2f} s added to the stamps of the scans ({found.says})")
        return replace(scans, stamps=scans.stamps + found.seconds)
    seconds = found.seconds + (options.seconds() or 0.0)
    kind = f"clocks of lidar and odometry {abs(found.seconds):.2f} s apart, not corrected"
    report.add(f"{kind}; give --clock-offset {seconds:.2f}, or auto ({found.says})")
    return scans


def clock_offset(scans: Scans, beams: Beams, odometry: Odometry, lidar: LidarConfig) -> Offset | None:
    """The offset of the two clocks, from scans in the middle of the log; None if none shows."""
    part = scans.select(np.arange(len(scans))[middle_of(len(scans))])
    # A scan shows the robot as it was in the middle of it.
    stamps = part.stamps + part.beam_time * (part.counts - 1) / 2
    sense = -1.0 if lidar.upside_down else 1.0
    turned = turns(onto(part, beams), stamps, sense * beams.step, lidar.range_max)
    return find_offset(stamps, turned, odometry.rows)
