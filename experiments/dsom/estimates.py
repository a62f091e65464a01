"""By what AdaM + DSOM averages: ``python experiments/dsom/estimates.py [--particles 200] [--runs 20] [--others]``.

A variant names what differs from weights drawn by the power of 8 and rays from the centres of cells; it is run on the
drives of synthetic-v1 or, with ``--others``, on six drives through three buildings that nothing else uses. Rows are
added to ``results/estimates.json`` (those that exist are kept), and all of them are printed.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
import tyro

from dsom_jax import bench, checkpoint
from dsom_jax.data.suite import Suite, load_suite
from dsom_jax.episode import Episode
from dsom_jax.errors import UserError, run_cli
from dsom_jax.filters.methods import Settings, make_filter, make_proposal
from dsom_jax.judging.run_table import RunTable
from dsom_jax.montecarlo import run_keys
from dsom_jax.occupancy import OccupancyGrid
from dsom_jax.proposals.dsom import DSOMProposal
from dsom_jax.raycast import RaycastConfig, make_tables
from dsom_jax.report import rounded, write_json
from dsom_jax.run_folder import commit
from dsom_jax.simulate.drive import DriveConfig, make_synthetic
from dsom_jax.simulate.worlds import WorldConfig, make_world
from dsom_jax.types import Filter

OUT = Path(__file__).parent / "results" / "estimates.json"
OTHER_BUILDINGS = (201, 202, 203)
CENTRES, FINE = RaycastConfig("table"), RaycastConfig("table", angles=180, viewpoints=2)


class Change(NamedTuple):
    """Fields of ``Settings`` and of ``FilterConfig``; beyond that rays from a table of cell centres, power 8."""

    settings: dict[str, Any]
    config: dict[str, Any]


def estimate(power: float, **settings: Any) -> Change:
    """Another power of the estimate."""
    return Change(settings, {"estimate_power": power})


VARIANTS: dict[str, Change] = {
    "8": estimate(8.0),
    "12": estimate(12.0),
    "16": estimate(16.0),
    "24": estimate(24.0),
    "32": estimate(32.0),
    "16, draws by 16": estimate(16.0, weight_power=16.0),
    "16, 120 beams": estimate(16.0, max_beams=120),
    "16, 360 beams": estimate(16.0, max_beams=360),
    "16, PM to the power of 5": estimate(16.0, sharpness=5.0),
    "16, predecessor by motion": Change({}, {"estimate_power": 16.0, "predecessor": "motion"}),
    "16, exact rays": estimate(16.0, raycast=RaycastConfig("exact")),
    "16, four viewpoints": estimate(16.0, raycast=FINE),
    "24, four viewpoints": estimate(24.0, raycast=FINE),
}


@dataclass(frozen=True)
class Args:
    """Run variants and print the table."""

    variants: tuple[str, ...] = ("16", "16, four viewpoints")
    """Names of variants."""
    particles: int = 200
    """Number of particles."""
    runs: int = 20
    """Monte-Carlo runs of each drive."""
    others: bool = False
    """Other buildings in place of synthetic-v1."""
    seed: int = 0
    """Seed of all randomness."""


def other_buildings() -> Suite:
    """Two drives through each of three buildings, made as those of the frozen suite."""
    drive, entries = DriveConfig(), []
    for seed in OTHER_BUILDINGS:
        grid = jax.jit(make_world, static_argnums=1)(jax.random.key(seed), WorldConfig(cells=128))
        entries += [(f"building-{seed}", grid, make_synthetic(100 * seed + n, grid, drive)[1]) for n in (1, 2)]
    return Suite("others", drive.lidar, (), tuple(entries))


def measure(change: Change, suite: Suite, network: Any, args: Args) -> RunTable:
    """All runs of one variant."""
    base = Settings(particles=args.particles, seed=args.seed, raycast=CENTRES)
    settings = replace(base, **change.settings)

    @cache
    def proposal(where: str) -> DSOMProposal:
        grid = next(grid for name, grid, _ in suite.episodes if name == where)
        made = make_proposal("dsom", grid, suite.lidar, settings, network)
        assert isinstance(made, DSOMProposal)
        return made

    def build(_: str, where: str, grid: OccupancyGrid, __: Episode) -> Filter:
        filter: Any = make_filter("adam", proposal(where), grid, suite.lidar, settings)
        tables = make_tables(grid, settings.raycast, suite.lidar.range_max)
        config = replace(filter.config, **change.config)
        return jax.block_until_ready(replace(filter, world=replace(filter.world, tables=tables), config=config))

    keys = [run_keys(args.seed, number, args.runs) for number in range(len(suite.episodes))]
    return bench.run_method("adam_dsom", suite, keys, build).table


def summary(table: RunTable) -> dict[str, Any]:
    """Errors, also of each drive, and how soon and how well it is found, by phase."""
    found = {}
    for phase in ("global", "kidnap"):
        rows = table.rows(table.phase == phase)
        drives = [rows.e_pos_m[rows.sequence == n].mean() for n in np.unique(rows.sequence)]
        soon = (rows.steps >= 0) & (rows.steps <= 20)
        found[phase] = {
            "e_pos_m": rows.e_pos_m.mean(), "e_theta_rad": rows.e_theta_rad.mean(), "e_pos_m_of_drives": drives,
            "within_20": soon.mean(), "retention": np.nanmean(rows.retention),
        }  # fmt: skip
    return found


def show(row: dict[str, Any]) -> str:
    """A row as a line: global / after the kidnapping."""
    sides = [row["result"][phase] for phase in ("global", "kidnap")]
    cells = [f"{row['variant']:36}", row["suite"], f"{row['particles']:5d} particles, {row['runs']:3d} runs"]
    for key in ("e_pos_m", "within_20", "retention"):
        cells.append(" / ".join("-" if side[key] is None else f"{side[key]:.3f}" for side in sides))
    return " | ".join(cells)


def main(args: Args) -> None:
    """Run what is missing, save, print."""
    if unknown := set(args.variants) - set(VARIANTS):
        raise UserError(f"--variants: unknown {'; '.join(sorted(unknown))}; choose from {'; '.join(VARIANTS)}")
    folder = checkpoint.shipped("dsom")
    if folder is None:
        raise UserError("checkpoints/dsom: not there; run this from the repository")
    suite = other_buildings() if args.others else load_suite("synthetic-v1")
    network, made_of = checkpoint.load(folder, suite.lidar, kind="dsom"), checkpoint.digest(folder)
    rows: list[dict[str, Any]] = json.loads(OUT.read_text()) if OUT.is_file() else []
    for name in args.variants:
        row = {"variant": name, "suite": suite.name, "particles": args.particles, "runs": args.runs}
        row |= {"seed": args.seed, "network": made_of}
        if not any(row.items() <= old.items() for old in rows):
            result = summary(measure(VARIANTS[name], suite, network, args))
            rows.append(row | {"commit": commit()[:7], "result": rounded(result)})
            write_json(OUT, rows)
    for row in rows:
        print(show(row))


if __name__ == "__main__":
    run_cli(lambda: main(tyro.cli(Args, description=__doc__)))
