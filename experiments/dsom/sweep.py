"""Where learning wins: ``python experiments/dsom/sweep.py [--checkpoint DIR] [--worlds 8] [--scans 16]``.

One thing at a time is made worse than an exact likelihood expects, and the proposals are judged by single scans, all
by the same ones. Writes ``results/sweep.json`` and prints a table.
"""

from __future__ import annotations

import json
import subprocess
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from dsom_jax import checkpoint as networks
from dsom_jax.evaluate import narrowed
from dsom_jax.filters.methods import DRAWN, Settings, make_proposal
from dsom_jax.lidar import LidarConfig
from dsom_jax.occupancy import OccupancyGrid
from dsom_jax.simulate.obstacles import remove_structure
from dsom_jax.simulate.worlds import WorldConfig
from dsom_jax.training import quality
from dsom_jax.training.batches import PLAIN, ScanConfig, make_scans, procedural_source
from dsom_jax.types import Array, Key

HERE = Path(__file__).parent
PROPOSALS = ("dsom", "likelihood_grid", "hybrid")
SEED = 20210


@dataclass(frozen=True)
class Condition:
    """How world and scans differ from what the map and the lidar promise.

    Attributes:
        scan: noise, clutter and obstacles.
        bare: the map shows walls only.
        gone: pieces of mapped structure that are no longer there, per map.
        scale: factor on the ranges.
        fov: degrees.
        drawn: the likelihood grid is told that the map is a floor plan.
    """

    scan: ScanConfig = PLAIN
    bare: bool = False
    gone: int = 0
    scale: float = 1.0
    fov: float = 360.0
    drawn: bool = False


CONDITIONS: dict[str, Condition] = {
    "20 obstacles": Condition(),
    "60 obstacles": Condition(replace(PLAIN, obstacles=(60, 60))),
    "20 % of beams short": Condition(replace(PLAIN, short=0.4)),
    "40 % of beams short": Condition(replace(PLAIN, short=0.8)),
    "map shows walls only": Condition(bare=True),
    "walls only, grid for floor plans": Condition(bare=True, drawn=True),
    "80 pieces of structure gone": Condition(gone=80),
    "ranges 5 % long": Condition(scale=1.05),
    "ranges 10 % long": Condition(scale=1.1),
    "beams end 0.3 m inside walls": Condition(replace(PLAIN, deep=1.0, depth=(0.3, 0.3))),
    "fov 180": Condition(fov=180.0),
    "fov 90": Condition(fov=90.0),
    "5 m range": Condition(replace(PLAIN, limited=1.0, reach_min=4.9999, fov_min=6.2831, range_max=10.0)),
}


def main(checkpoint: Path = networks.SHIPPED, worlds: int = 8, scans: int = 16) -> None:
    """Measure, print and save."""
    network = networks.load(checkpoint)
    results = {}
    for name, condition in CONDITIONS.items():
        results[name] = judge(condition, network, worlds, scans)
        print(name.ljust(34), *(line(results[name][p]) for p in PROPOSALS), sep=" | ", flush=True)
    record = {"commit": commit(), "worlds": worlds, "scans": scans, "seed": SEED, "conditions": results}
    (HERE / "results").mkdir(exist_ok=True)
    (HERE / "results" / "sweep.json").write_text(json.dumps(record, indent=1) + "\n")


def judge(condition: Condition, network: Any, worlds: int, scans: int) -> dict[str, dict[str, float]]:
    """Quality of every proposal over all scans."""
    lidar = narrowed(PLAIN.lidar, condition.fov)
    settings = DRAWN if condition.drawn else Settings()
    parts: dict[str, list[quality.Quality]] = {name: [] for name in PROPOSALS}
    for key in jax.random.split(jax.random.key(SEED), worlds):
        grid, ranges, poses = scene(key, condition, lidar, scans)
        for name in PROPOSALS:
            proposal = make_proposal(name, grid, lidar, settings, checkpoint=network)
            parts[name].append(jax.tree.map(np.asarray, quality.judge(proposal, grid, ranges, poses)))
    joined = {name: jax.tree.map(lambda *leaves: np.concatenate(leaves), *part) for name, part in parts.items()}
    return {name: quality.summarise(part) for name, part in joined.items()}


@partial(jax.jit, static_argnames=("condition", "lidar", "scans"))
def scene(key: Key, condition: Condition, lidar: LidarConfig, scans: int) -> tuple[OccupancyGrid, Array, Array]:
    """The map shown, scans (S, B) of the beams of ``lidar``, and their map-frame poses (S, 3)."""
    k_world, k_gone, k_scans = jax.random.split(key, 3)
    shown, seen = procedural_source(WorldConfig(), float(condition.bare))(k_world)
    if condition.gone:
        removed = remove_structure(k_gone, seen, condition.gone)
        seen = replace(removed, free=seen.free)
    ranges, _, poses = make_scans(k_scans, seen, condition.scan, scans)
    ranges = ranges * condition.scale
    ranges = jnp.where(ranges < lidar.range_max, ranges, jnp.where(jnp.isnan(ranges), ranges, jnp.inf))
    first = (PLAIN.beams - lidar.beams + 1) // 2
    return shown, ranges[:, first : first + lidar.beams], shown.from_grid(poses)


def line(row: dict[str, float]) -> str:
    """Mass, share above 1 %, top-1."""
    return f"{100 * row['mass_median']:5.1f} {100 * row['mass_gt_1pct']:5.1f} {100 * row['top1']:5.1f}"


def commit() -> str:
    """Commit of the source."""
    command = ["git", "-C", str(HERE), "rev-parse", "HEAD"]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()


if __name__ == "__main__":
    tyro.cli(main)
