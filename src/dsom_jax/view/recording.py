"""The answers of ``localize`` as a recording to play: for Foxglove and ROS 2 (``--mcap``), or Rerun (``--rerun``).

It holds the updates of ``answers.csv``, at their stamps.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from dsom_jax import report
from dsom_jax.atomic import sync
from dsom_jax.data.bag_map import GRID
from dsom_jax.data.bag_writer import Say, new_bag
from dsom_jax.data.ros2_messages import BASE, MAP, SCAN, TF, MessageMaker
from dsom_jax.errors import UserError
from dsom_jax.judging.scores import Drive
from dsom_jax.lidar import LidarConfig
from dsom_jax.occupancy import OccupancyGrid
from dsom_jax.view.answers import covariances
from dsom_jax.view.story import DriveStory, fewer_particles

MOST = 500
"""Particles of an update that are written."""
TOPICS = {
    "/map": GRID, "/tf_static": TF, "/tf": TF, "/scan": SCAN,
    "/amcl_pose": "geometry_msgs/msg/PoseWithCovarianceStamped", "/particle_cloud": "geometry_msgs/msg/PoseArray",
    "/reference": "geometry_msgs/msg/PoseStamped", "/verdict": "std_msgs/msg/String",
}  # fmt: skip
LASTING = ("/map", "/tf_static")
LATEST = 2**31
"""Seconds from which on a stamp of ROS 2 does not reach."""


class Update(NamedTuple):
    """One answer, and what it was given for.

    Attributes:
        stamp: seconds in the clock of the log.
        segment: number of the drive, from 1.
        kidnapped: the robot was carried away just before.
        ranges: (B,) metres, REP-117.
        pose: (3,) the answer, in the map frame; covariance: (3, 3) of the particles around it.
        particles: (P, 3), P at most :data:`MOST`.
        reference: (3,) true pose, NaN where unknown.
        p_lost: probability that the answer is wrong.
        verdict: its name.
        places: (H, 4) weight and pose of each place that holds the mass.
    """

    stamp: float
    segment: int
    kidnapped: bool
    ranges: np.ndarray
    pose: np.ndarray
    covariance: np.ndarray
    particles: np.ndarray
    reference: np.ndarray
    p_lost: float
    verdict: str
    places: np.ndarray

    @property
    def known(self) -> bool:
        """Whether there is a reference."""
        return bool(np.isfinite(self.reference).all())


def updates(drives: Sequence[DriveStory]) -> list[Update]:
    """Those of all drives by their stamps; of overlapping drives the earlier one counts, as in ``answers.csv``."""
    found: dict[float, Update] = {}
    for segment, drive in enumerate(drives, 1):
        spread = covariances(np.asarray(drive.estimates, float), drive.particles, drive.particle_weights)
        particles, _ = fewer_particles(drive, MOST)
        for t, stamp in enumerate(map(float, drive.stamps)):
            weights = drive.hypotheses.weights[t]
            places = np.column_stack([weights, drive.hypotheses.means[t]])[weights > 0]
            found.setdefault(stamp, Update(
                stamp, segment, bool(drive.kidnapped[t]), drive.ranges[t], drive.estimates[t], spread[t],
                particles[t], drive.truth[t], float(drive.p_lost[t]), drive.verdicts[t], places,
            ))  # fmt: skip
    return [found[stamp] for stamp in sorted(found)]


def ready(mcap: Path | None, rerun: Path | None, drives: Sequence[Drive]) -> None:
    """Make the folders of the recordings that are asked for; UserError if one cannot be written. Call it before work.

    ROS 2 counts seconds from 0, and not very far.
    """
    for option, path in (("--mcap", mcap), ("--rerun", rerun)):
        if path is not None:
            report.output_folder(path.parent, option)
    stamps = np.concatenate([drive.stamps for drive in drives])
    odd = stamps[~((stamps >= 0) & (stamps < LATEST))]
    if mcap is not None and len(odd):
        raise UserError(
            f"--mcap {mcap}: the log has the stamp {odd[0]:.3f} s, and ROS 2 counts from 0 to {LATEST}; "
            "leave --mcap out, or record the log with another clock"
        )


def draft_of(path: Path) -> Path:
    """Where a recording grows, on the same disk."""
    return path.with_name(f".{path.name}.{os.getpid()}")


def write_mcap(path: Path, grid: OccupancyGrid, lidar: LidarConfig, drives: Sequence[DriveStory]) -> None:
    """Write ``path``, one file with the :data:`TOPICS`, whole or not at all; an older one is replaced."""
    draft = draft_of(path)
    try:
        with new_bag(draft, TOPICS, LASTING) as (make, say):
            moments = updates(drives)
            say("/map", moments[0].stamp, make.grid(moments[0].stamp, grid))
            say("/tf_static", moments[0].stamp, make.mount(moments[0].stamp, lidar))
            for update in moments:
                _tell(update, make, say, lidar)
        # What ROS 2 and Foxglove read is all in the file; the description beside it would only repeat it.
        (file,) = draft.glob("*.mcap")
        sync(file)
        file.replace(path)
        sync(path.parent)
    except OSError as error:
        raise UserError(f"--mcap {path}: cannot be written ({error.strerror}); name another file") from None
    finally:
        shutil.rmtree(draft, ignore_errors=True)


def _tell(update: Update, make: MessageMaker, say: Say, lidar: LidarConfig) -> None:
    """The messages of one update, the transform first: what is seen by the laser is drawn by it."""
    stamp = update.stamp
    say("/tf", stamp, make.frame(stamp, MAP, BASE, update.pose))
    say("/scan", stamp, make.scan(stamp, update.ranges, lidar))
    say("/amcl_pose", stamp, make.answer(stamp, update.pose, update.covariance))
    say("/particle_cloud", stamp, make.poses(stamp, update.particles))
    if update.known:
        say("/reference", stamp, make.pose(stamp, update.reference))
    say("/verdict", stamp, make.text(answer_json(update)))


def answer_json(update: Update) -> str:
    """What there is to know of an answer beside its pose, as JSON."""
    places = [{"weight": w, "x": x, "y": y, "theta": theta} for w, x, y, theta in update.places.tolist()]
    told = {"verdict": update.verdict, "p_lost": update.p_lost, "segment": update.segment,
            "kidnapped": update.kidnapped, "hypotheses": places}  # fmt: skip
    return json.dumps(report.plain(told), allow_nan=False)
