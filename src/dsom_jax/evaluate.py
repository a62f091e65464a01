"""``python -m dsom_jax.evaluate``: what the proposals say of single scans, without any filter."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from rich.progress import Progress
from rich.table import Table

from dsom_jax import checkpoint, plotting, report
from dsom_jax.cli import parse
from dsom_jax.data.open_map import load_maps
from dsom_jax.errors import UserError, run_cli
from dsom_jax.filters.methods import make_proposal
from dsom_jax.filters.settings import Settings
from dsom_jax.geometry import transform_points
from dsom_jax.judging import quality
from dsom_jax.lidar import LidarConfig, scan_points
from dsom_jax.nn import DSOM
from dsom_jax.occupancy import OccupancyGrid
from dsom_jax.simulate.worlds import WorldConfig, make_world
from dsom_jax.training.batches import PLAIN, ScanConfig, make_scans
from dsom_jax.types import Array, Key, Proposal

PROPOSALS = ("uniform", "dual_features", "dsom", "likelihood_grid", "hybrid")
WORST = 5
KEPT = 16
"""Scenes whose proposals are kept in memory."""
_UNSEEN = 0x5EE0
"""Folded into the seed, so that these worlds are none of those that training draws."""


@dataclass(frozen=True)
class EvaluateArgs:
    """Judge proposals by single scans: how much of their probability lies where the robot is."""

    checkpoint: Path
    """Folder of a trained DSOM."""
    out: Path
    """Folder for evaluate.json and figures."""
    maps: tuple[Path, ...] = ()
    """map.yaml files, resampled to the network's scale; default: procedural buildings that training did not see."""
    worlds: int = 12
    """Procedural buildings of 43 m x 43 m."""
    scans: int = 64
    """Scans in each building or map."""
    obstacles: int = 20
    """Things in each 43 m x 43 m that the map does not show."""
    fov: float = 360.0
    """Field of view of the lidar, degrees; one beam per degree."""
    seed: int = 0
    """Seed of buildings, obstacles, poses and noise."""


class Scene(NamedTuple):
    """A map with scans (S, B) taken at map-frame poses (S, 3)."""

    grid: OccupancyGrid
    ranges: Array
    poses: Array


Sources = Callable[[int], dict[str, Proposal]]


def main() -> None:
    """Command line."""
    args = parse(EvaluateArgs, "python -m dsom_jax.evaluate")
    _check(args)
    scan = replace(PLAIN, obstacles=(args.obstacles, args.obstacles))
    lidar = narrowed(scan.lidar, args.fov)
    network = checkpoint.load(args.checkpoint, lidar)
    given = given_maps(args, network) if args.maps else None
    folder = report.output_folder(args.out)
    grids = given or new_worlds(args, network)
    scenes = [_simulate(key, grid, scan, lidar, args) for key, grid in grids]
    sources = proposals(scenes, lidar, network)
    with Progress(console=report.terminal(stderr=True)) as progress:
        track = partial(progress.track, description="scenes")
        judged = judge_all(track(scenes), sources)
    results = {name: quality.totals(part) | {"ms_per_scan": ms} for name, (part, ms) in judged.items()}
    report.write_json(folder / "evaluate.json", results)
    _draw(folder, scenes, lidar, sources, {name: part for name, (part, _) in judged.items()})
    print_table(results)


def _check(args: EvaluateArgs) -> None:
    """UserError for settings that mean nothing."""
    for name in ("worlds", "scans"):
        if not 1 <= getattr(args, name) <= 100_000:
            raise UserError(f"--{name} {getattr(args, name)}: give at least 1 and at most 100000")
    for name, most in (("obstacles", 10_000), ("seed", 2**32 - 1)):
        if not 0 <= getattr(args, name) <= most:
            raise UserError(f"--{name} {getattr(args, name)}: must not be negative, nor more than {most}")
    if not 1 <= args.fov <= 360:
        raise UserError(f"--fov {args.fov}: give degrees between 1 and 360")


def narrowed(lidar: LidarConfig, fov: float) -> LidarConfig:
    """The middle beams of a full-turn lidar, ``fov`` degrees of them."""
    beams = round(lidar.beams * fov / 360)
    if beams == lidar.beams:
        return lidar
    skipped = -(-(lidar.beams - beams) // 2)
    return replace(lidar, beams=beams, angle_min=lidar.angle_min + skipped * lidar.angle_increment)


def new_worlds(args: EvaluateArgs, network: DSOM) -> list[tuple[Key, OccupancyGrid]]:
    """Buildings at the network's scale and the keys of their scans."""
    root = jax.random.fold_in(jax.random.key(args.seed), _UNSEEN)
    draw_world = jax.jit(partial(make_world, config=WorldConfig(resolution=network.config.resolution)))
    pairs = [jax.random.split(key) for key in jax.random.split(root, args.worlds)]
    return [(k_scans, draw_world(k_world)) for k_world, k_scans in pairs]


def given_maps(args: EvaluateArgs, network: DSOM) -> list[tuple[Key, OccupancyGrid]]:
    """Maps at the network's scale and the keys of their scans."""
    grids = load_maps(args.maps, network.config.resolution)
    root = jax.random.fold_in(jax.random.key(args.seed), _UNSEEN)
    return list(zip(jax.random.split(root, len(grids)), grids, strict=True))


@partial(jax.jit, static_argnames=("scan", "count"))
def _scans(key: Key, grid: OccupancyGrid, scan: ScanConfig, count: int) -> tuple[Array, Array]:
    ranges, _, poses = make_scans(key, grid, scan, count)
    return ranges, grid.from_grid(poses)


def _simulate(key: Key, grid: OccupancyGrid, scan: ScanConfig, lidar: LidarConfig, args: EvaluateArgs) -> Scene:
    """Scans with unknown obstacles; of a full turn, the beams that ``lidar`` has."""
    ranges, poses = _scans(key, grid, scan, args.scans)
    first = round((lidar.angle_min + math.pi) / lidar.angle_increment)
    return Scene(grid, ranges[:, first : first + lidar.beams], poses)


def proposals(scenes: Sequence[Scene], lidar: LidarConfig, network: DSOM) -> Sources:
    """The proposals of a scene by its number; the last few are kept, as pictures ask for them again."""

    @lru_cache(maxsize=KEPT)
    def build(number: int) -> dict[str, Proposal]:
        made: dict[str, Proposal] = {}
        for name in PROPOSALS:
            # As the benchmark uses them, but for DSOM's PM, which is not sharpened: the network is judged.
            settings = Settings(sharpness=1.0)
            made[name] = make_proposal(name, scenes[number].grid, lidar, settings, checkpoint=network, made=made)
        return made

    return build


def judge_all(scenes: Iterable[Scene], sources: Sources) -> dict[str, tuple[quality.Quality, float]]:
    """Quality of every scan, in the order of the scenes, and milliseconds per scan, by proposal."""
    parts: dict[str, list[quality.Quality]] = {name: [] for name in PROPOSALS}
    times: dict[str, list[float]] = {name: [] for name in PROPOSALS}
    for number, scene in enumerate(scenes):
        for name, proposal in sources(number).items():
            part = quality.of_scans(proposal, scene.grid, scene.ranges, scene.poses)
            parts[name].append(jax.tree.map(np.asarray, part))
            times[name] += timed(partial(quality.prepare, proposal), scene.ranges[:3])
    joined = {name: jax.tree.map(lambda *leaves: np.concatenate(leaves), *part) for name, part in parts.items()}
    return {name: (joined[name], 1e3 * float(np.median(times[name]))) for name in PROPOSALS}


def timed(function: Callable[[Array], Any], scans: Array) -> list[float]:
    """Seconds for each of a few scans, after one more that compiles."""
    jax.block_until_ready(function(scans[0]))
    seconds = []
    for scan in scans:
        start = time.perf_counter()
        jax.block_until_ready(function(scan))
        seconds.append(time.perf_counter() - start)
    return seconds


def _draw(
    folder: Path, scenes: list[Scene], lidar: LidarConfig, sources: Sources, parts: dict[str, quality.Quality]
) -> None:
    """Calibration of all proposals; for the two that are worth it, the worst scans and the first ones."""
    curves = {name: quality.calibration(np.asarray(part.level)) for name, part in parts.items()}
    plotting.save_figure(plotting.calibration_curves(curves), folder / "calibration.png")
    for name in ("dsom", "likelihood_grid", "hybrid"):
        worst = np.argsort(parts[name].mass, kind="stable")[:WORST]
        for title, chosen in (("worst", worst), ("first", np.arange(min(WORST, len(parts[name].mass))))):
            views = [view(name, scenes, int(n), lidar, sources) for n in chosen]
            titles = [f"mass {100 * parts[name].mass[n]:.2g} %" for n in chosen]
            plotting.save_figure(plotting.map_views(views, titles), folder / f"{title}_{name}.png")


def view(name: str, scenes: list[Scene], number: int, lidar: LidarConfig, sources: Sources) -> dict[str, Any]:
    """One scan, its true pose and the PM of proposal ``name``, for a picture."""
    which, n = divmod(number, len(scenes[0].poses))
    scene = scenes[which]
    pm = quality.prepare(sources(which)[name], scene.ranges[n])
    ends, hit = scan_points(scene.ranges[n], lidar)
    shown = {"pm": pm.mass, "pm_origin": pm.pose_grid.origin, "pm_resolution": pm.pose_grid.resolution}
    points = np.asarray(transform_points(scene.poses[n], ends))[np.asarray(hit)]
    return {"grid": scene.grid, "truth": np.asarray(scene.poses[n]), "points": points, **shown}


def print_table(results: dict[str, dict[str, float]]) -> None:
    """One row per proposal."""
    table = Table(title="One scan, no filter", title_justify="left")
    heads = {"mass_median": "mass %", "mass_gt_1pct": "> 1 %", "mass_gt_10pct": "> 10 %", "top1": "top-1 %"}
    for column in ("proposal", *heads.values(), "KLD", "peaks", "ms/scan"):
        table.add_column(column, justify="left" if column == "proposal" else "right")
    for name, row in results.items():
        shares = [f"{100 * row[key]:.1f}" for key in heads]
        table.add_row(name, *shares, f"{row['kld']:.2f}", f"{row['peaks_mean']:.1f}", f"{row['ms_per_scan']:.1f}")
    report.terminal().print(table)


if __name__ == "__main__":
    run_cli(main)
