"""The exact filter on the grid, where particles fail: ``python experiments/robust/belief.py --network DIR``.

Grid localization has no particles to lose: what its most probable cell does not find is not for want of them. Each
variant judges a scan by the tempered likelihood, by PM of DSOM to a power, or by both, on the clips of the paper's
protocol with their kidnappings, or on ``--windows`` pieces of the log without any. Writes
``beliefs/MAP.PIECES.json`` and prints it.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from dsom_jax import checkpoint, pose_grid
from dsom_jax.data import RawLog, load_map
from dsom_jax.data.cut import to_episode
from dsom_jax.data.suite import Suite
from dsom_jax.episode import Episode
from dsom_jax.errors import UserError, run_cli
from dsom_jax.filters.methods import DRAWN, REAL, make_proposal
from dsom_jax.geometry import compose
from dsom_jax.judging import metrics
from dsom_jax.occupancy import OccupancyGrid
from dsom_jax.proposals.hybrid import Hybrid
from dsom_jax.proposals.markov_grid import MarkovGrid
from dsom_jax.protocol.clips import choose, windows
from dsom_jax.protocol.plan import Plan, map_file, read_logs, read_plan
from dsom_jax.report import output_folder, rounded, write_json
from dsom_jax.run_folder import commit
from dsom_jax.types import Array, Inputs

HERE = Path(__file__).parent
ROOT = HERE.parents[1]


@dataclass(frozen=True)
class Args:
    """Follow the belief and judge its most probable cell."""

    network: Path
    """Folder of the DSOM, as ``experiments/real/paper.py`` leaves it in runs/real/networks."""
    map: str = "walls-only"
    """Map of the protocol."""
    windows: int = 0
    """So many pieces of the log in place of the protocol's clips."""
    tempers: tuple[float, ...] = (0.05, 0.0, 0.0, 0.0, 0.01, 0.02)
    """Factor on the log-likelihood, of each variant."""
    powers: tuple[float, ...] = (0.0, 0.15, 0.3, 0.6, 0.15, 0.3)
    """Exponent of PM, of each variant."""
    kidnap: float = 1e-9
    """Probability of being carried away between two updates."""
    config: Path = HERE.parent / "real" / "paper.yaml"
    """The protocol."""
    data: Path = Path(os.environ.get("DSOM_DATA") or ROOT.parent / "shared" / "data")
    """Folder that holds a folder for each log."""
    out: Path = HERE / "beliefs"
    """Folder for MAP.PIECES.json."""
    work: Path = ROOT / "runs" / "real"
    """Folder for what is made on the way."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Judged(MarkovGrid):
    """Grid localization by a weighted sum of both logarithms; each scan is judged once and passed on as its ranges.

    Attributes:
        weights: (2,) of the log-likelihood (not tempered) and of log PM.
    """

    weights: Array = field(kw_only=True)

    def evidence(self, inputs: Inputs) -> Array:
        """(C, K) of the two layers (2, C, K) that stand in the place of the ranges."""
        return (self.weights[:, None, None] * inputs.ranges).sum(0)


@jax.jit
def judged_scans(pool: Hybrid, inputs: Inputs) -> Array:
    """(T, 2, C, K) log-likelihood and log PM of all scans."""
    temper = pool.likelihood.config.model.temper

    def both(scan: Inputs) -> Array:
        return jnp.stack([pool.likelihood.log_likelihood(scan.ranges) / temper, pool.log_network(scan)])

    return jax.lax.map(both, inputs)


@jax.jit
def follow(belief: Judged, inputs: Inputs) -> Array:
    """(T, 3) base poses at the most probable cell after each scan, of ``inputs`` with judged scans as ranges."""
    likelihood = belief.likelihood

    def update(before: Array, now: Inputs) -> tuple[Array, Array]:
        _, after = belief.prepare(before, now)
        cell, k = jnp.divmod(jnp.argmax(after), after.shape[1])
        i, j = jnp.divmod(likelihood.cells[cell], likelihood.pose_grid.width)
        sensor = pose_grid.cell_pose(likelihood.pose_grid, i, j, k)
        return after, compose(sensor, -jnp.array([*likelihood.lidar.mount[:2], 0.0]))

    return jax.lax.scan(update, belief.begin(), inputs)[1]


def pieces(plan: Plan, logs: list[RawLog], count: int, grid: OccupancyGrid, suite: Suite) -> list[Episode]:
    """The drives of the protocol, or ``count`` evenly spread pieces of the logs."""
    if not count:
        return [episode for _, _, episode in suite.episodes]
    found = [(log, rows) for log in logs for rows in windows(log, grid, plan)]
    chosen = np.linspace(0, len(found) - 1, count).round().astype(int)
    return [to_episode(log, rows) for log, rows in (found[n] for n in chosen)]


def judge(poses: Any, episode: Episode) -> dict[str, list[dict[str, Any]]]:
    """Steps, share of the later updates kept, and last error of each phase."""
    found: dict[str, list[dict[str, Any]]] = {}
    for phase, parts in metrics.phases(episode.kidnapped).items():
        for part in parts:
            runs = metrics.measure(np.asarray(poses)[None, part], np.asarray(episode.poses)[part])
            e_pos, e_theta = metrics.pose_error(poses[part], episode.poses[part])
            inside = (np.asarray(e_pos) < metrics.POSITION) & (np.asarray(e_theta) < metrics.ANGLE)
            one = {"steps": runs.steps[0], "kept": metrics.retention(runs), "inside": inside.mean()}
            found.setdefault(phase, []).append(one | {"e_pos_m": runs.e_pos[0]})
    return found


def show(row: dict[str, Any], phase: str) -> str:
    """A line: how many converged, what they kept, and each piece as steps/inside/last error."""
    parts = row["phases"][phase]
    there = [p for p in parts if p["steps"] >= 0]
    kept = [p["kept"] for p in there if np.isfinite(p["kept"])]
    inside = np.mean([p["inside"] for p in parts])
    each = "  ".join(f"{p['steps']}/{p['inside']:.2f}/{p['e_pos_m']:.1f}" for p in parts)
    head = f"temper {row['temper']:g}, power {row['power']:g}, {phase}: converged {len(there)} of {len(parts)}"
    return f"{head}, kept {np.mean(kept) if kept else np.nan:.2f}, inside {inside:.2f}  [{each}]"


def main(args: Args) -> None:
    """All variants on all pieces."""
    series = read_plan(args.config, {})
    if args.map not in series.maps:
        raise UserError(f"--map {args.map}: {args.config} has {', '.join(series.maps)}")
    if len(args.tempers) != len(args.powers):
        raise UserError("--tempers, --powers: give as many of one as of the other")
    plan, fields = series.on(args.map)
    grid = load_map(map_file(args.map, fields, args.data, args.work))
    logs = list(read_logs(plan, args.data))
    suite = choose(plan, logs, args.map, grid)
    settings = DRAWN if plan.map_kind == "drawn" else REAL
    network = checkpoint.load(args.network, suite.lidar, kind="dsom")
    pool: Any = make_proposal("hybrid", grid, suite.lidar, settings, network)
    motion = replace(settings.markov, kidnap=args.kidnap)
    rows: list[dict[str, Any]] = [
        {"temper": temper, "power": power, "kidnap": args.kidnap, "phases": {}}
        for temper, power in zip(args.tempers, args.powers, strict=True)
    ]
    for episode in pieces(plan, logs, args.windows, grid, suite):
        scans = episode.inputs._replace(ranges=judged_scans(pool, episode.inputs))
        for row in rows:
            weights = jnp.array([row["temper"], row["power"]])
            poses = follow(Judged(pool.likelihood, motion, weights=weights), scans)
            for phase, parts in judge(poses, episode).items():
                row["phases"].setdefault(phase, []).extend(parts)
    facts = {"map": args.map, "windows": args.windows, "commit": commit()[:7]}
    facts |= {"network": checkpoint.digest(args.network), "rows": rounded(rows)}
    name = f"{args.map}.{f'{args.windows}-windows' if args.windows else 'clips'}.json"
    write_json(output_folder(args.out) / name, facts)
    for row in rows:
        for phase in row["phases"]:
            print(show(row, phase))


if __name__ == "__main__":
    run_cli(lambda: main(tyro.cli(Args, description=__doc__)))
