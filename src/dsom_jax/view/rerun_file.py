"""The answers of ``localize`` for the Rerun viewer (``--rerun``), through the optional package ``rerun-sdk``."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dsom_jax.atomic import sync
from dsom_jax.data.ros2_messages import BASE, LASER, MAP, percentages, quaternion
from dsom_jax.errors import UserError
from dsom_jax.lidar import LidarConfig
from dsom_jax.occupancy import OccupancyGrid
from dsom_jax.view.recording import Update, answer_json, draft_of, updates
from dsom_jax.view.story import DriveStory

TIMELINE = "stamp"
ROBOT = f"{MAP}/{BASE}"
ANSWER, PARTICLE, REFERENCE, RETURN = (230, 120, 0), (90, 90, 200), (0, 150, 60), (200, 0, 0)
"""Colours, red, green and blue."""


def load_rerun() -> Any:
    """The package; UserError without it."""
    try:
        import rerun
    except ImportError:
        raise UserError("--rerun: needs rerun-sdk; run pip install 'dsom-jax[rerun]'") from None
    return rerun


def write_rerun(path: Path, grid: OccupancyGrid, lidar: LidarConfig, drives: Sequence[DriveStory]) -> None:
    """Write ``path`` (.rrd) whole or not at all; an older one is replaced.

    Under ``map`` are the ``cells``, ``particles``, the ``answer`` with its ellipse of two standard deviations, the
    ``reference`` and the robot, ``base_link/laser/scan``; beside it are ``p_lost`` and ``verdict``.
    """
    rr, draft = load_rerun(), draft_of(path)
    try:
        with rr.RecordingStream("dsom_jax") as out:
            out.save(draft)
            # The clock of the log is the only one of interest.
            out.set_log_time_enabled(False)
            out.set_log_tick_enabled(False)
            _tell_fixed(rr, out, grid, lidar)
            for update in updates(drives):
                out.set_time(TIMELINE, timestamp=np.datetime64(round(update.stamp * 1e9), "ns"))
                _tell(rr, out, update, lidar)
            out.flush()
            out.disconnect()
        sync(draft)
        draft.replace(path)
        sync(path.parent)
    except OSError as error:
        raise UserError(f"--rerun {path}: cannot be written ({error.strerror}); name another file") from None
    finally:
        draft.unlink(missing_ok=True)


def _tell_fixed(rr: Any, out: Any, grid: OccupancyGrid, lidar: LidarConfig) -> None:
    """What stays: the map, and the lidar on the robot."""
    x, y, yaw = np.asarray(grid.origin, float).tolist()
    height, width = grid.shape
    form = rr.components.ImageFormat(width=width, height=height, color_model="L", channel_datatype="U8")
    out.log(MAP, rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    # Rerun takes the cells for a picture, whose first row is at the top, and places its lower-left corner.
    cells = rr.GridMap(
        data=percentages(grid)[::-1].tobytes(), format=form, cell_size=grid.resolution, translation=[x, y, 0.0],
        quaternion=quaternion(yaw), colormap=rr.components.Colormap.RvizMap,
    )  # fmt: skip
    out.log(f"{MAP}/cells", cells, static=True)
    out.log(f"{ROBOT}/front", _arrows(rr, np.zeros((1, 3)), ANSWER, 0.6), static=True)
    mount = rr.Transform3D(
        translation=[*lidar.mount[:2], 0.0], quaternion=quaternion(lidar.mount[2], lidar.upside_down)
    )
    out.log(f"{ROBOT}/{LASER}", mount, static=True)


def _tell(rr: Any, out: Any, update: Update, lidar: LidarConfig) -> None:
    """What one update changes."""
    x, y, yaw = map(float, update.pose)
    out.log(ROBOT, rr.Transform3D(translation=[x, y, 0.0], quaternion=quaternion(yaw)))
    out.log(f"{ROBOT}/{LASER}/scan", rr.Points3D(returns(update.ranges, lidar), colors=RETURN, radii=0.03))
    out.log(f"{MAP}/particles", _arrows(rr, update.particles, PARTICLE, 0.25))
    out.log(f"{MAP}/answer", _ellipse(rr, update))
    # Without a reference none is shown, not the last one.
    out.log(f"{MAP}/reference", _arrows(rr, update.reference[None][: int(update.known)], REFERENCE, 0.6))
    out.log("p_lost", rr.Scalars(update.p_lost))
    out.log("verdict", rr.TextDocument(answer_json(update)))


def returns(ranges: np.ndarray, lidar: LidarConfig) -> np.ndarray:
    """(K, 3) points in the frame of the lidar, metres, where beams (B,) ended on something."""
    bearings = lidar.angle_min + lidar.angle_increment * np.arange(lidar.beams)
    hit = np.isfinite(ranges)
    reach, bearings = np.asarray(ranges, float)[hit], bearings[hit]
    return np.stack([reach * np.cos(bearings), reach * np.sin(bearings), np.zeros(len(reach))], -1)


def _arrows(rr: Any, poses: np.ndarray, colour: tuple[int, int, int], length: float) -> Any:
    """Poses (P, 3) as arrows of ``length`` metres."""
    x, y, yaw = np.asarray(poses, float).T
    level = np.zeros(len(x))
    vectors = length * np.stack([np.cos(yaw), np.sin(yaw), level], -1)
    return rr.Arrows3D(vectors=vectors, origins=np.stack([x, y, level], -1), colors=colour, radii=length / 20)


def _ellipse(rr: Any, update: Update) -> Any:
    """Two standard deviations of the place around the answer, flat."""
    shares, axes = np.linalg.eigh(update.covariance[:2, :2])
    half = 2 * np.sqrt(np.maximum(shares, 1e-6))
    turn = quaternion(float(np.arctan2(axes[1, 0], axes[0, 0])))
    centre = [*map(float, update.pose[:2]), 0.0]
    return rr.Ellipsoids3D(centers=[centre], half_sizes=[[*half, 1e-3]], quaternions=[turn], colors=ANSWER)
