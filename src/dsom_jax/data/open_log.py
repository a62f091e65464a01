"""One entry for every format of log."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from dsom_jax.data.bag import load_bag
from dsom_jax.data.bag_file import SUFFIXES, is_bag
from dsom_jax.data.carmen import load_carmen
from dsom_jax.data.files import check_path
from dsom_jax.data.log import RawLog, check_lidar, report_still
from dsom_jax.data.log_options import AS_TOLD, LogOptions, apart_from_bags
from dsom_jax.data.rawseeds import is_rawseeds, load_rawseeds
from dsom_jax.data.trajectory import with_reference
from dsom_jax.errors import UserError

CARMEN_SUFFIXES = (".log", ".clf", ".gz")


def load_log(
    path: str | Path,
    options: LogOptions = AS_TOLD,
    *,
    reference: str | Path | None = None,
    range_max: float | None = None,
) -> RawLog:
    """Log of any readable format, checked; ``reference`` is a TUM file in the log's clock and replaces the log's own.

    Readings from ``range_max`` metres on count as no return; by default the log tells.
    """
    path = Path(path)
    check_path(path, "log")
    if range_max is not None and not 0 < range_max < float("inf"):
        raise UserError(f"range_max = {range_max}: must be a positive number of metres")
    log = _load(path, options, range_max)
    log = _narrowed(log, options)
    check_lidar(log)
    report_still(log)
    return log if reference is None else with_reference(log, reference)


def _load(path: Path, options: LogOptions, range_max: float | None) -> RawLog:
    """The log by the reader for its kind."""
    rawseeds = is_rawseeds(path)
    if path.is_dir() and not rawseeds and not is_bag(path):
        raise UserError(
            f"{path}: a folder without metadata.yaml is no rosbag2, without *-SICK_FRONT.csv no session of Rawseeds; "
            "give the folder of the bag or session, or a file"
        )
    if is_bag(path) and not rawseeds:
        return load_bag(path, options, range_max)
    apart_from_bags(options, path)
    if rawseeds:
        return load_rawseeds(path, options, range_max)
    if path.suffix.lower() in CARMEN_SUFFIXES:
        return load_carmen(path, options, range_max)
    raise UserError(
        f"{path}: unknown kind of log '{path.suffix}'; readable are CARMEN ({', '.join(CARMEN_SUFFIXES)}), "
        f"bags ({', '.join(SUFFIXES)}), folders of rosbag2, and Rawseeds (*-SICK_FRONT.csv, or its folder)"
    )


def _narrowed(log: RawLog, options: LogOptions) -> RawLog:
    """The log without the beams of ``--laser-mask`` and the readings below ``--laser-min-range``."""
    lidar, ranges = log.lidar, log.ranges
    if options.laser_min_range > lidar.range_min:
        if options.laser_min_range >= lidar.range_max:
            reach = f"must be less than the lidar's reach, {lidar.range_max:g} m"
            raise UserError(f"--laser-min-range {options.laser_min_range}: {reach}")
        lidar = replace(lidar, range_min=options.laser_min_range)
        ranges = np.where(ranges < lidar.range_min, np.float32(-np.inf), ranges)
    hidden = options.masked(lidar.angle_min + lidar.angle_increment * np.arange(lidar.beams))
    if hidden.all():
        raise UserError(f"--laser-mask {' '.join(options.laser_mask)}: covers every beam; give a smaller one")
    if options.laser_mask:
        log.report.add(f"beams of {lidar.beams} masked", count=int(hidden.sum()))
        ranges = np.where(hidden, np.float32(np.nan), ranges)
    return replace(log, lidar=lidar, ranges=ranges)
