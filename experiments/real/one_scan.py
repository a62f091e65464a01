"""One real scan on its map: ``python experiments/real/one_scan.py [--only intel] [--checkpoint DIR]``.

Every fourth scan of eight segments of a log, at its reference pose: how much of each proposal's probability lies within
1 m and 15 deg of it. ``dsom, resampled`` is the network on a map that was resampled to its scale before anything else:
there views are cast among walls that have grown. PM is not sharpened. Writes ``one_scan/NAME.json``.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from run import LOGS, commit
from run import Args as Series

from dsom_jax import checkpoint, localize, localize_args, report
from dsom_jax.data import RawLog, load_log, load_ros_map
from dsom_jax.data.log import limited
from dsom_jax.errors import UserError, run_cli
from dsom_jax.filters.methods import make_proposal
from dsom_jax.filters.settings import DRAWN, REAL
from dsom_jax.judging import quality
from dsom_jax.occupancy import OccupancyGrid, resample
from dsom_jax.proposals.dsom import dsom
from dsom_jax.types import Array, Proposal

NAMES = ("intel", "freiburg-079", "walls-only")
EVERY = 4
SHOWN = ("mass_median", "mass_gt_1pct", "mass_gt_10pct", "top1")


@dataclass(frozen=True)
class Args:
    """Judge proposals on real scans."""

    data: Path = Series().data
    """Folder that holds a folder for each log."""
    out: Path = Series().out
    """Folder for one_scan/."""
    only: tuple[str, ...] = NAMES
    """Names of logs."""
    checkpoint: Path | None = None
    """Network; default: the one in the repository."""


def scans(args: localize_args.LocalizeArgs, log: RawLog) -> tuple[Array, Array]:
    """Ranges (N, B) and reference poses (N, 3)."""
    drives = localize.segments_of(log, args)
    ranges, poses = (jnp.concatenate([getattr(d.episode, key) for d in drives])[::EVERY] for key in ("ranges", "poses"))
    known = np.isfinite(poses).all(-1)
    return ranges[known], poses[known]


def proposals(name: str, grid: OccupancyGrid, log: RawLog, folder: Path) -> Iterator[tuple[str, Proposal]]:
    """What is compared, by name."""
    settings, network = DRAWN if name == "walls-only" else REAL, checkpoint.load(folder, log.lidar)
    yield "dsom", dsom(network, grid, log.lidar, 1.0, settings.raycast.surface)
    yield "dsom, resampled", dsom(network, resample(grid, network.config.resolution), log.lidar)
    for other in ("likelihood_grid", "hybrid"):
        yield other, make_proposal(other, grid, log.lidar, settings, network)


def judge(name: str, args: Args, folder: Path) -> dict[str, dict[str, float]]:
    """Quality of every proposal on one log, printed as it comes."""
    place, kept = LOGS[name]
    options = localize_args.LocalizeArgs(
        map=args.data / place / "map.yaml", log=args.data / kept / "log.clf.gz", out=args.out
    )
    grid, log = load_ros_map(options.map), limited(load_log(options.log), options.laser_max_range)
    ranges, poses = scans(options, log)
    found = {}
    for label, proposal in proposals(name, grid, log, folder):
        parts = jax.tree.map(np.asarray, quality.of_scans(proposal, grid, ranges, poses))
        found[label] = quality.totals(parts) | {"scans": len(poses)}
        print(f"{name}, {label}: " + ", ".join(f"{key} {100 * found[label][key]:.1f} %" for key in SHOWN), flush=True)
    return found


def main() -> None:
    """All logs that were asked for."""
    args = tyro.cli(Args, description=__doc__)
    folder = args.checkpoint or checkpoint.shipped()
    if folder is None:
        raise UserError("--checkpoint: no network is shipped; name the folder of one")
    for name in args.only:
        found = judge(name, args, folder)
        made = {"commit": commit(), "network": checkpoint.load_provenance(folder).get("commit")}
        report.write_json(report.output_folder(args.out / "one_scan") / f"{name}.json", made | found)


if __name__ == "__main__":
    run_cli(main)
