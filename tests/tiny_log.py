"""The room of :mod:`tiny_world` as files: a ROS map, and a CARMEN log of a robot that turns round in it."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from dsom_jax.data import save_tum, se2
from dsom_jax.data.ros_map import save_ros_map
from dsom_jax.filters.settings import REAL
from dsom_jax.raycast import RaycastConfig, make_tables
from tiny_world import LIDAR, cast, grid

UPDATES, START, NO_RETURN = 44, 1000.0, 81.83
ODOMETRY = np.array([0.15, 0.0, 0.25])
"""Every scan is an update, as the robot turns by more than ``update_min_a`` between two."""
META = f"""\
beams: {LIDAR.beams}
angle_min: {LIDAR.angle_min}
angle_increment: {LIDAR.angle_increment}
range_no_return: {LIDAR.range_max}
"""


class Recording(NamedTuple):
    """Paths of a map, a log (``meta.yaml`` beside it) and the true trajectory; scans (T, B) as written."""

    map: Path
    log: Path
    reference: Path
    ranges: np.ndarray


def record(folder: Path) -> Recording:
    """Write map, log and reference into ``folder``; the odometry starts elsewhere, as odometry does."""
    save_ros_map(grid(), folder / "room.yaml")
    truth = path(np.asarray(grid().from_grid(jnp.array([3.1, 2.3, 0.3]))))
    # The walls of maps made from scans do not begin at the near edge of their cells.
    tables = make_tables(grid(), RaycastConfig("exact", surface=REAL.robust_raycast.surface), LIDAR.range_max)
    ranges = np.asarray(cast(tables, jnp.asarray(truth, jnp.float32), LIDAR))
    write_log(folder, ranges)
    save_tum(folder / "truth.tum", START + np.arange(UPDATES), truth)
    return Recording(folder / "room.yaml", folder / "drive.log", folder / "truth.tum", ranges)


def path(start: np.ndarray) -> np.ndarray:
    """(T, 3) circle of 0.6 m radius that begins at ``start``."""
    poses = [np.asarray(start, float)]
    for _ in range(UPDATES - 1):
        poses.append(se2.compose(poses[-1], ODOMETRY))
    return np.stack(poses)


def write_log(folder: Path, ranges: np.ndarray, meta: str = META) -> Path:
    """``drive.log`` with scans (T, B) and ``meta.yaml``; the laser sits where the robot is."""
    odometry = path(np.array([7.0, -3.0, 2.0]))
    lines = []
    for number, (scan, pose) in enumerate(zip(np.minimum(ranges, NO_RETURN), odometry, strict=True)):
        place = " ".join(f"{v:.6f}" for v in pose)
        scan_words = " ".join(f"{r:.3f}" for r in scan)
        lines.append(f"FLASER {len(scan)} {scan_words} {place} {place} {START + number:.6f} robot {number:.6f}")
    (folder / "drive.log").write_text("\n".join(lines) + "\n")
    (folder / "meta.yaml").write_text(meta)
    return folder / "drive.log"
