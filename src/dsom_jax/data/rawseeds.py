"""Logs of the Rawseeds project (Bicocca, indoor): SICK, odometry and ground truth as CSV files of one session.

Fields of a line, separated by commas (SESSION is for instance ``Bicocca_2009-02-25b``; .bz2 and .gz are read, too):

    SESSION-SICK_FRONT.csv, -SICK_REAR.csv   stamp, number of ranges, angular offset, r1 .. r181
    SESSION-ODOMETRY_XYT.csv                 stamp, rolling counter, ticks right, ticks left, x, y, theta
    SESSION-GROUNDTRUTH.csv                  stamp, x, y, theta, nine entries of a covariance
    SESSION-GT-extended.csv                  stamp, x, y, theta

Seconds, metres and radians; the angular offset is in quarters of a degree, scans are padded with zeros to 181 ranges.
Sources: the project's description of the laser and odometry files as A. Censi quotes it in ``procgraph_rawseeds`` and
``dataset_rawseeds`` (GitHub), the converters of ``doge-of-the-day/rawseds_ros`` for all of them, and the README of the
project's own toolkit of metrics (``rawseeds_evaluation``), which says that GROUNDTRUTH comes from cameras and lasers in
the building and covers a part of the path, and GT-extended all of it, from scans matched by hand. The first lines of a
published GROUNDTRUTH file and single quoted lines of the others agree with this. No whole log was at hand, so it could
*not* be verified: whether the ground truth is that of the base (it is taken to be), and how it lies to the drawings.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from dsom_jax.data import se2
from dsom_jax.data.carmen_lidar import LaserConfig, guess_config, lidar_of
from dsom_jax.data.files import read_lines
from dsom_jax.data.log import RawLog, Report, limit_ranges, majority_beams, tidy
from dsom_jax.data.log_options import AS_TOLD, LogOptions
from dsom_jax.data.odometry import odometry_at
from dsom_jax.data.trajectory import Trajectory, associate
from dsom_jax.errors import UserError

MOUNTS = {"FRONT": (0.08, 0.0, 0.0), "REAR": (-0.463, 0.001, math.pi)}
"""Poses of the two lasers on the base: "Calibration 04" in launch/transforms_biccoca.launch of ``rawseds_ros``."""
_NO_RETURN = 81.825
"""Metres: a SICK that counts centimetres writes 81.83 to 81.91 where it has seen nothing."""
_SUFFIXES = (".csv", ".csv.bz2", ".csv.gz")
_ODOMETRY, GROUND_TRUTH = "-ODOMETRY_XYT", ("-GT-extended", "-GROUNDTRUTH")
_MAX_GAP = 2.0
"""Seconds between poses of the ground truth that are bridged: GT-extended has one for each half metre."""


def is_rawseeds(path: str | Path) -> bool:
    """Whether a path looks like a SICK file of Rawseeds, or a folder that holds one."""
    path = Path(path)
    return any(_scan_files(path)) if path.is_dir() else path.name.lower().endswith(_SUFFIXES)


def load_rawseeds(path: str | Path, options: LogOptions = AS_TOLD, range_max: float | None = None) -> RawLog:
    """Scans of one laser of a session, with the odometry and, where there is one, the ground truth beside it.

    ``path`` is a SICK file, or the folder of the session, of which the front laser is read. Without
    ``options.mount`` the laser sits as on the project's robot; ``meta.yaml`` beside the files overrides that,
    and angles and limits as for CARMEN logs. Readings from ``range_max`` metres on are no returns.
    """
    path, report = _scan_file(Path(path)), Report()
    stamps, ranges, config = _scans(path, report)
    session, laser = path.name.rsplit("-SICK_", 1)
    pose = np.array(MOUNTS[laser.split(".")[0].upper()], float)
    lidar = options.mounted(lidar_of(path, ranges, config, {}, pose, range_max))
    odometry = _rows(_sibling(path, session, _ODOMETRY), 7, (0, 4, 5, 6), report)
    poses, broken = odometry_at(facing_forward(odometry, report), stamps, report)
    reference = _reference(path, session, stamps, report)
    ranges = limit_ranges(ranges, lidar.range_min, lidar.range_max)
    return tidy(RawLog(ranges, poses, stamps, lidar, reference, report, path, broken))


def _scan_files(folder: Path) -> Iterator[Path]:
    """The SICK files of a folder, those of the front laser first."""
    for laser in MOUNTS:
        yield from sorted(p for s in _SUFFIXES for p in folder.glob(f"*-SICK_{laser}{s}"))


def _scan_file(path: Path) -> Path:
    """The one SICK file that is meant."""
    if path.is_dir():
        found = list(_scan_files(path))
        if not found:
            raise UserError(f"{path}: holds no *-SICK_FRONT.csv nor *-SICK_REAR.csv; give the folder of a session")
        sessions = {p.name.split("-SICK_")[0] for p in found}
        if len(sessions) > 1:
            raise UserError(f"{path}: holds several sessions ({', '.join(sorted(sessions))}); name a SICK file")
        return found[0]
    if not any(f"-SICK_{laser}." in path.name for laser in MOUNTS):
        raise UserError(f"{path}: name a file SESSION-SICK_FRONT.csv or SESSION-SICK_REAR.csv, or their folder")
    return path


def _sibling(path: Path, session: str, kind: str) -> Path:
    """Another file of the session."""
    for suffix in _SUFFIXES:
        if (other := path.with_name(f"{session}{kind}{suffix}")).is_file():
            return other
    raise UserError(f"{path}: needs {session}{kind}.csv beside it; put the session's files into one folder")


def _numbers(path: Path, report: Report) -> Iterator[tuple[int, np.ndarray]]:
    """Number and values of each line that is not empty; what is not a list of numbers is reported."""
    for number, line in enumerate(read_lines(path, "Rawseeds file"), start=1):
        words = line.replace(",", " ").split()
        if not words or words[0].startswith("#"):
            continue
        try:
            yield number, np.array(words, float)
        except ValueError:
            _skip(path, number, line, report)


def _skip(path: Path, number: int, line: str, report: Report) -> None:
    """Count a line that cannot be used."""
    report.add(f"unreadable lines of {path.name} skipped", f"line {number}: '{line.strip()[:40]}'")


def _scans(path: Path, report: Report) -> tuple[np.ndarray, np.ndarray, LaserConfig]:
    """Stamps (N,), ranges (N, B) as written, and the angles of the laser."""
    stamps, scans, offsets = [], [], []
    for number, row in _numbers(path, report):
        count = int(row[1]) if len(row) > 3 and np.isfinite(row[:3]).all() else 0
        # Fewer ranges than announced: the line was cut; more: zeros to fill it up.
        if not 0 < count <= len(row) - 3 or row[3 + count :].any():
            _skip(path, number, " ".join(f"{v:g}" for v in row[:6]), report)
            continue
        stamps.append(row[0])
        offsets.append(row[2])
        scans.append(row[3 : 3 + count])
    if not scans:
        lines = "; ".join(report.lines()[:1])
        raise UserError(f"{path}: holds no scan 'stamp, count, offset, r1, r2, ...'" + f"; {lines}" * bool(lines))
    keep = majority_beams(scans, report, path) & _usual(np.array(offsets), report)
    ranges = np.stack([scan for scan, kept in zip(scans, keep, strict=True) if kept])
    guess = guess_config(ranges.shape[1])
    start = guess.start_angle + math.radians(np.array(offsets)[keep][0] / 4)
    return np.array(stamps)[keep], ranges, LaserConfig(start, guess.resolution, _NO_RETURN)


def _usual(offsets: np.ndarray, report: Report) -> np.ndarray:
    """(N,) bool: which scans have the most frequent angular offset. The others are reported."""
    values, counts = np.unique(offsets, return_counts=True)
    usual = offsets == values[counts.argmax()]
    if not usual.all():
        report.add("scans with another angular offset dropped", count=int((~usual).sum()))
    return usual


def _rows(path: Path, least: int, columns: tuple[int, ...], report: Report) -> np.ndarray:
    """(M, 4) rows (stamp, x, y, theta) of a file whose lines have at least ``least`` values."""
    rows = []
    for number, row in _numbers(path, report):
        if len(row) >= least and np.isfinite(row[list(columns)]).all():
            rows.append(row[list(columns)])
        else:
            _skip(path, number, " ".join(f"{v:g}" for v in row[:6]), report)
    if len(rows) < 2:
        raise UserError(f"{path}: holds no trajectory; each line needs {least} numbers with stamp, x, y and theta")
    table = np.array(rows)
    return table[np.argsort(table[:, 0], kind="stable")]


def facing_forward(rows: np.ndarray, report: Report) -> np.ndarray:
    """Rows (M, 4) of odometry with theta as the direction in which the robot drives.

    The project's description lets the robot's y axis point forward and x to the right, while the lines of ODOMETRY_XYT
    that are quoted in public start by growing along x at theta = 0. So the log itself decides: if the path
    leaves the poses on the whole to their left, a quarter turn is added, and reported.
    """
    steps = se2.relative(rows[:-1, 1:], rows[1:, 1:])[:, :2].sum(axis=0)
    direction = math.atan2(steps[1], steps[0])
    if abs(direction) < math.pi / 4 or not steps.any():
        return rows
    if abs(direction - math.pi / 2) > math.pi / 4:
        report.add(f"odometry whose theta is {math.degrees(direction):.0f} deg off the way driven: left as it is")
        return rows
    report.add("odometry whose y axis points forward: a quarter turn was added to its theta")
    return np.column_stack([rows[:, :3], se2.wrap(rows[:, 3] + math.pi / 2)])


def _reference(path: Path, session: str, stamps: np.ndarray, report: Report) -> np.ndarray | None:
    """Poses (N, 3) of the ground truth at the scans, NaN where it does not tell; None without such a file."""
    for kind in GROUND_TRUTH:
        try:
            file = _sibling(path, session, kind)
        except UserError:
            continue
        rows = _rows(file, 4, (0, 1, 2, 3), report)
        poses = associate(Trajectory(rows[:, 0], rows[:, 1:]), stamps, max_gap=_MAX_GAP)
        if missing := int(np.isnan(poses).any(-1).sum()):
            report.add(f"scans without a pose in {file.name}", count=missing)
        return poses
    report.add(f"session without ground truth ({' or '.join(f'{session}{k}.csv' for k in GROUND_TRUTH)})")
    return None
