"""``python -m dsom_jax.certify``: where in this building is a robot with this lidar ambiguous, and for how long?"""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dsom_jax import plotting, report
from dsom_jax.ambiguity import AmbiguityConfig, Tried, log_odds, look_alikes, try_out
from dsom_jax.cli import each, parse, stage
from dsom_jax.data import load_log, load_map
from dsom_jax.errors import UserError, run_cli
from dsom_jax.judging.statistics import rate_interval
from dsom_jax.lidar import LidarConfig
from dsom_jax.occupancy import OccupancyGrid
from dsom_jax.view.certified import certificate, map_figure
from dsom_jax.view.page import write_page
from dsom_jax.view.story import Lookalike

DISTANCES = (0, 2, 5, 10)
"""Metres at which it is said how many robots have been found."""


@dataclass(frozen=True)
class CertifyArgs:
    """Try a building before a robot is in it: how far must it drive until it is found, and which places look alike?"""

    map: Path
    """ROS map_server YAML, a DXF drawing, or a YAML with `drawing: FILE.dxf` and how to read it."""
    out: Path
    """Folder for certify.json, certify.png and report.html."""
    log: Path | None = None
    """A log or bag whose lidar is taken, in place of the three numbers below."""
    fov: float = 270.0
    """Degrees that the lidar sees."""
    range: float = 12.0
    """Metres that it sees."""
    beams: int = 360
    """Beams of a scan."""
    drives: int = 64
    """Random drives of about 12 m, from places spread over the building."""
    seed: int = 0
    """Seed of all randomness."""
    json: bool = False
    """Print certify.json instead of a table."""


def main() -> None:
    """Command line."""
    args = parse(CertifyArgs, "python -m dsom_jax.certify")
    lidar = lidar_from_args(args)
    grid = load_map(args.map)
    folder = report.output_folder(args.out)
    config = AmbiguityConfig(drives=args.drives)
    try:
        tried = try_out(grid, lidar, config, args.seed, lambda batches: each(batches, "drives"))
    except UserError as error:
        raise UserError(f"{args.map}: {error}") from None
    result, pairs = certify(tried, grid)
    with stage("writing the page"):
        report.write_json(folder / "certify.json", result)
        plotting.save_figure(map_figure(grid, tried, pairs), folder / "certify.png")
        write_page(folder / "report.html", certificate(args.map, grid, lidar, tried, result, pairs, asdict(args)))
    if args.json:
        print(json.dumps(report.plain(result), indent=2))
    else:
        print_result(result, folder)


def lidar_from_args(args: CertifyArgs) -> LidarConfig:
    """The lidar that the arguments describe; UserError for one that cannot be."""
    for name, most in (("fov", 360.0), ("range", 1000.0), ("beams", 100_000), ("drives", 100_000)):
        if not 0 < getattr(args, name) <= most:
            raise UserError(f"--{name} {getattr(args, name)}: give a number above 0, at most {most:g}")
    if not 0 <= args.seed < 2**32:
        raise UserError(f"--seed {args.seed}: give 0 or more, and less than 2^32")
    if args.log:
        return load_log(args.log).lidar
    fov = math.radians(args.fov)
    step = fov / (args.beams if args.fov == 360 else max(args.beams - 1, 1))
    return LidarConfig(args.beams, -fov / 2, step, range_max=args.range)


def certify(tried: Tried, grid: OccupancyGrid) -> tuple[dict[str, Any], list[Lookalike]]:
    """``certify.json``, and its pairs of places."""
    metres = tried.metres_until_found()
    # What still looks alike after a drive is worse than what does so at first sight.
    after, chosen = next(((d, found) for d in (5.0, 2.0, 0.0) if (found := look_alikes(tried, d))), (0.0, []))
    pairs = [Lookalike(tried.poses[d, t], tried.other_pose[d, t], log_odds(tried, d, t)) for d, t in chosen]
    shares = {str(distance): float((metres <= distance).mean()) for distance in DISTANCES}
    return {
        "found_after_m": shares,
        "found_after_m_ci95": {
            str(distance): rate_interval(metres <= distance, np.arange(len(metres))) for distance in DISTANCES
        },
        "metres_median": float(np.median(metres)),
        "look_alikes": [{"a": p.a, "b": p.b, "log_odds": p.log_odds} for p in pairs],
        "look_alikes_after_m": after,
        "area_m2": float(np.asarray(grid.free).sum() * grid.resolution**2),
        "drives": len(metres),
    }, pairs


def print_result(result: dict[str, Any], folder: Path) -> None:
    """A few lines for a person."""
    console = report.terminal()
    console.print(f"{result['area_m2']:.0f} m2 of free space, {result['drives']} drives")
    for name, share in result["found_after_m"].items():
        low, high = result["found_after_m_ci95"][name]
        console.print(f"  found after {name:>2} m: {share:6.1%}  [{low:.0%} to {high:.0%}]", highlight=False)
    count = len(result["look_alikes"])
    console.print(f"{count} pairs of places look alike after {result['look_alikes_after_m']:g} m" if count else
                  "no two places look alike")  # fmt: skip
    console.print(f"look at {folder / 'report.html'}", soft_wrap=True, highlight=False)


if __name__ == "__main__":
    run_cli(main)
