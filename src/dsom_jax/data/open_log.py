"""One entry for every format of log."""

from __future__ import annotations

from pathlib import Path

from dsom_jax.data.bag import load_bag
from dsom_jax.data.carmen import load_carmen
from dsom_jax.data.log import RawLog, check_lidar
from dsom_jax.data.rawseeds import is_rawseeds, load_rawseeds
from dsom_jax.data.trajectory import with_reference
from dsom_jax.errors import UserError

CARMEN_SUFFIXES = (".log", ".clf", ".gz")
BAG_SUFFIXES = (".bag", ".db3", ".mcap")


def load_log(
    path: str | Path,
    *,
    reference: str | Path | None = None,
    range_max: float | None = None,
    scan_topic: str | None = None,
    odom_topic: str | None = None,
) -> RawLog:
    """Log of any readable format, checked; ``reference`` is a TUM file in the log's clock and replaces the log's own.

    Readings from ``range_max`` metres on count as no return; by default the log tells. The topics concern bags only.
    """
    path = Path(path)
    if range_max is not None and not 0 < range_max < float("inf"):
        raise UserError(f"range_max = {range_max}: must be a positive number of metres")
    rawseeds = is_rawseeds(path)
    if path.is_dir() and not rawseeds and not (path / "metadata.yaml").is_file():
        raise UserError(
            f"{path}: a folder without metadata.yaml is no rosbag2, without *-SICK_FRONT.csv no session of Rawseeds; "
            "give the folder of the bag or session, or a file"
        )
    if rawseeds:
        log = load_rawseeds(path, range_max)
    elif path.is_dir() or path.suffix.lower() in BAG_SUFFIXES:
        log = load_bag(path, scan_topic, odom_topic, range_max)
    elif path.suffix.lower() in CARMEN_SUFFIXES:
        log = load_carmen(path, range_max)
    else:
        raise UserError(
            f"{path}: unknown kind of log '{path.suffix}'; readable are CARMEN ({', '.join(CARMEN_SUFFIXES)}), "
            f"bags ({', '.join(BAG_SUFFIXES)}), folders of rosbag2, and Rawseeds (*-SICK_FRONT.csv, or its folder)"
        )
    check_lidar(log)
    return log if reference is None else with_reference(log, reference)
