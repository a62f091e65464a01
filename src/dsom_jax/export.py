"""``python -m dsom_jax.export``: a suite as ROS 2 bags, maps and reference trajectories, for other localizers."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dsom_jax import report
from dsom_jax.cli import parse
from dsom_jax.data import RawLog, save_ros_map, save_tum, se2
from dsom_jax.data.bag_writer import write_bag
from dsom_jax.data.suite import Suite, load_suite
from dsom_jax.episode import Episode
from dsom_jax.errors import run_cli
from dsom_jax.judging.foreign import stamps_of


@dataclass(frozen=True)
class ExportArgs:
    """Write a suite so that other localizers can be run on it: maps, and of each drive a bag and a reference."""

    out: Path
    """Folder for maps/NAME.yaml, sequence-N/ (a bag), sequence-N.reference.tum and suite.json."""
    suite: str = "synthetic-v1"
    """Name of a suite, or a TOML file that describes one."""


def log_of(episode: Episode, suite: Suite) -> RawLog:
    """A drive as it would have been recorded: odometry from 0, which does not notice a kidnapping."""
    poses = [np.zeros(3)]
    for step in np.asarray(episode.odometry, np.float64)[1:]:
        poses.append(se2.compose(poses[-1], step))
    return RawLog(np.asarray(episode.ranges), np.array(poses), stamps_of(episode), suite.lidar)


def write_suite(suite: Suite, folder: Path) -> None:
    """All files of a suite."""
    (folder / "maps").mkdir(exist_ok=True)
    listed = []
    for number, (name, grid, episode) in enumerate(suite.episodes, start=1):
        save_ros_map(grid, folder / "maps" / f"{name}.yaml")
        write_bag(folder / f"sequence-{number}", log_of(episode, suite), moving_frames=True)
        stamps, poses = stamps_of(episode), np.asarray(episode.poses)
        known = np.isfinite(poses).all(-1)
        save_tum(folder / f"sequence-{number}.reference.tum", stamps[known], poses[known])
        moved = stamps[np.asarray(episode.kidnapped, bool)].tolist()
        listed.append({"bag": f"sequence-{number}", "map": f"maps/{name}.yaml", "kidnapped_at": moved,
                       "reference": f"sequence-{number}.reference.tum"})  # fmt: skip
    report.write_json(folder / "suite.json", {"suite": suite.name, "sequences": listed})


def main() -> None:
    """Command line."""
    args = parse(ExportArgs, "python -m dsom_jax.export")
    suite = load_suite(args.suite)
    write_suite(suite, report.output_folder(args.out))
    print(
        f"{args.out}: {len(suite.episodes)} drives of {suite.name}; docs/compare.md says how to judge other localizers"
    )


if __name__ == "__main__":
    run_cli(main)
