"""Bags as strangers bring them, each beside its clean twin, in a made building.

python experiments/strangers/run.py --out DIR writes REPORT.md and results.json; rows that exist are retained, so an
interrupted series goes on. Rates are to be within 2 points of the twins'.
"""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass, replace
from pathlib import Path

from dsom_jax import localize, localize_args, report
from dsom_jax.cli import parse
from dsom_jax.data import load_log, load_map
from dsom_jax.data.log import limited
from dsom_jax.errors import run_cli
from dsom_jax.judging.scores import answered

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tests"))

from fixtures import strangers
from fixtures.make_bag import write_bag

RATES = ("converged", "retention", "strict_success")


@dataclass(frozen=True)
class Args:
    """Localize in every made bag and in its clean twin."""

    out: Path
    """Folder for the bags, REPORT.md and results.json."""
    runs: int = 25
    """Runs of each segment."""
    segments: int = 4
    """Pieces of each drive."""
    steps: int = 30
    """Updates of a segment."""
    particles: int = 300
    """Particles per run."""
    only: str = ""
    """Cases whose name holds this."""


def main() -> None:
    """Command line."""
    args = parse(Args, "python experiments/strangers/run.py")
    folder = report.output_folder(args.out)
    drive, spinning = strangers.way(), strangers.way(spin=1.0)
    cells = [(strangers.START, "/map", "grid", (strangers.cells(), strangers.RESOLUTION, -0.05, -0.05))]
    (folder / "map").mkdir(exist_ok=True)
    if not (folder / "map" / "made").is_dir():
        write_bag(folder / "map", "db3", cells)
    rows = folder / "results.json"
    results, twins = json.loads(rows.read_text()) if rows.exists() else {}, {}
    for name, (case, twin) in strangers.cases(drive, spinning).items():
        if args.only not in name or name in results:
            continue
        truth = strangers.truth(spinning if "turning" in name else drive, folder / name)
        if id(twin) not in twins:
            twins[id(twin)] = judged(twin, truth, folder / name / "twin", args)
        found = judged(case, truth, folder / name / "bag", args)
        results[name] = {"bag": found, "twin": twins[id(twin)]}
        print(name, *(f"{r} {found[r]:.3f} / {twins[id(twin)][r]:.3f}" for r in RATES), found["notes"], flush=True)
        report.write_json(rows, results)
        (folder / "REPORT.md").write_text(table(results, args))


def judged(case: strangers.Case, truth: Path, folder: Path, args: Args) -> dict:
    """Rates of one bag, and what the reader had to say."""
    path = folder / "made" if (folder / "made").is_dir() else case.write(folder)
    grid = load_map(folder.parents[1] / "map" / "made")
    log = load_log(path, case.options, reference=None if case.own_reference else truth)
    settings = localize_args.LocalizeArgs(
        path, path, folder, runs=args.runs, segments=args.segments, particles=args.particles
    )
    settings = replace(settings, steps_per_segment=args.steps)
    log = limited(log, settings.laser_max_range)
    filter = localize_args.build(settings, grid, log.lidar)
    outcomes = localize.localize(filter, localize.segments_of(log, settings), args.runs, settings.seed)
    given = answered(outcomes, settings.method)
    summary = json.loads(json.dumps(localize.summary_of(outcomes, given, grid, settings)))
    return {rate: summary[rate] for rate in (*RATES, "e_pos_m_median")} | {
        "scans": len(log),
        "notes": log.report.lines(),
    }


def table(results: dict, args: Args) -> str:
    """REPORT.md."""
    head = f"""# Bags of strangers beside their clean twins

`python experiments/strangers/run.py --runs {args.runs} --segments {args.segments} --steps {args.steps} --particles \
{args.particles}`: a made building of 16 m x 10 m, one drive of 53 m, adam_robust from no prior. Bag / twin in percent.

| bag | converged | retention | strict | median error m | worst difference |
| --- | ---: | ---: | ---: | ---: | ---: |
"""
    rows = []
    for name, both in results.items():
        bag, twin = both["bag"], both["twin"]
        rates = [f"{100 * bag[r]:.1f} / {100 * twin[r]:.1f}" for r in RATES]
        error = f"{bag['e_pos_m_median']:.3f} / {twin['e_pos_m_median']:.3f}"
        worst = max(100 * (twin[r] - bag[r]) for r in RATES)
        rows.append(f"| {name} | {' | '.join(rates)} | {error} | {worst:.1f} |")
    return head + "\n".join(rows) + "\n"


if __name__ == "__main__":
    run_cli(main)
