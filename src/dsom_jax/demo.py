"""``python -m dsom_jax.demo``: a made building, a made bag, a kidnapping, and the page that shows what comes of it."""

from __future__ import annotations

import json
import sys
import webbrowser
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from dsom_jax import localize, localize_args, report
from dsom_jax.cli import parse, stage
from dsom_jax.data import RawLog, save_ros_map, save_tum, se2
from dsom_jax.data.bag_writer import write_bag
from dsom_jax.errors import UserError, run_cli
from dsom_jax.lidar import LidarConfig, LidarNoise
from dsom_jax.simulate.drive import DriveConfig, make_synthetic
from dsom_jax.simulate.worlds import WorldConfig, make_world
from dsom_jax.summary_table import print_summary

_START = 1_700_000_000.0
"""Stamp of the first scan: a clock as robots have it."""
BUILDING = WorldConfig(cells=160, resolution=0.2, rotated=0.0, furniture=0.5)
LIDAR = LidarConfig(beams=180, angle_min=-0.75 * np.pi, angle_increment=1.5 * np.pi / 179, range_min=0.1,
                    range_max=12.0, mount=(0.2, 0.0, 0.0))  # fmt: skip
DRIVE = DriveConfig(updates=(40, 40), update_min_d=0.45, obstacles=12, removed=2, lidar=LIDAR,
                    lidar_noise=LidarNoise(sigma=0.02, dropout=0.01, short=0.02))  # fmt: skip


@dataclass(frozen=True)
class DemoArgs:
    """Make a building and a drive through it, carry the robot away unnoticed, find it, and open the page."""

    out: Path = Path("dsom-demo")
    """Folder for the map, the bag, the reference and everything that `localize` writes."""
    open: bool = True
    """Open the page in a browser."""
    json: bool = False
    """Print summary.json instead of a table."""
    seed: int = 4
    """Another number makes another building and another drive."""
    runs: int = 10
    """Runs of the filter; the page shows the first."""


class DemoFiles(NamedTuple):
    """Files of a made drive, and the stamps at which the robot was carried away."""

    map: Path
    log: Path
    reference: Path
    carried: tuple[float, ...]


def main() -> None:
    """Command line."""
    args = parse(DemoArgs, "python -m dsom_jax.demo")
    if not 0 <= args.seed < 2**32:
        raise UserError(f"--seed {args.seed}: give 0 or more, and less than 2^32")
    folder = report.output_folder(args.out)
    with stage("making a building and a drive"):
        scene = make(folder, args.seed)
    words = localize_args.LocalizeArgs(
        scene.map, scene.log, folder, reference=scene.reference, runs=args.runs, segments=1, steps_per_segment=0,
        laser_max_range=LIDAR.range_max, seed=args.seed, json=args.json,
    )  # fmt: skip
    localize_args.check(words)
    summary = localize.answer(words, scene.carried)
    if args.json:
        print(json.dumps(report.plain(summary), indent=2))
    else:
        print_summary(summary, folder)
    if args.open and webbrowser.open((folder / "report.html").resolve().as_uri()):
        print("the page is open in your browser", file=sys.stderr if args.json else sys.stdout)


def make(folder: Path, seed: int, building: WorldConfig = BUILDING, drive: DriveConfig = DRIVE) -> DemoFiles:
    """Map, bag and reference in ``folder``; the robot meets things that the map does not show."""
    grid = jax.jit(make_world, static_argnums=1)(jax.random.key(seed), building)
    _, episode = make_synthetic(seed, grid, drive)
    stamps = _START + np.asarray(episode.stamps, float)
    odometry = [np.zeros(3)]
    for increment in np.asarray(episode.odometry, float)[1:]:
        odometry.append(se2.compose(odometry[-1], increment))
    log = RawLog(np.asarray(episode.ranges), np.stack(odometry), stamps, drive.lidar)
    scene = DemoFiles(folder / "building.yaml", folder / "drive", folder / "truth.tum",
                      tuple(stamps[np.asarray(jnp.flatnonzero(episode.kidnapped))].tolist()))  # fmt: skip
    save_ros_map(grid, scene.map)
    write_bag(scene.log, log)
    save_tum(scene.reference, stamps, np.asarray(episode.poses))
    return scene


if __name__ == "__main__":
    run_cli(main)
