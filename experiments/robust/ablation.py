"""What each idea of AdaM robust is worth: ``python experiments/robust/ablation.py [--logs intel] [--variants base]``.

One choice is changed at a time from what ``localize`` uses, on real logs without any prior on the pose, with a
kidnapping spliced into every segment: the price of a choice often shows only in one of the two. Writes
``results/LOG.VARIANT.json`` (those that exist are kept) and ``REPORT.md``.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import jax
import tyro

from dsom_jax import localize
from dsom_jax.data import load_log, load_ros_map
from dsom_jax.filters.methods import REAL, Settings, make_filter, make_proposal
from dsom_jax.motion import OdometryMotion

HERE = Path(__file__).parent


def robust(**changes: Any) -> Callable[[Settings], Settings]:
    """Settings with other fields of RobustConfig."""
    return lambda s: replace(s, robust=replace(s.robust, **changes))


def model(**changes: Any) -> Callable[[Settings], Settings]:
    """Settings with another sensor model of AdaM robust."""
    return lambda s: replace(s, robust=replace(s.robust, model=replace(s.robust.model, **changes)))


def memoryless(**changes: Any) -> Callable[[Settings], Settings]:
    """Settings without memory, with other fields of RobustConfig: there eps is the filter's own."""
    return lambda s: replace(robust(**changes)(s), memory=False)


def markov(**changes: Any) -> Callable[[Settings], Settings]:
    """Settings with another motion of the memory."""
    return lambda s: replace(s, markov=replace(s.markov, **changes))


def slip(value: float) -> Callable[[Settings], Settings]:
    """Settings with other slip of the wheels."""
    return lambda s: replace(s, robust_motion=replace(cast(OdometryMotion, s.robust_motion), slip=value))


def surface(value: float) -> Callable[[Settings], Settings]:
    """Settings with beams returned from elsewhere in occupied cells, by proposal and filter."""

    def change(s: Settings) -> Settings:
        grid = replace(s.grid, raycast=replace(s.grid.raycast, surface=value))
        return replace(s, grid=grid, robust_raycast=replace(s.robust_raycast, surface=value))

    return change


VARIANTS: dict[str, Callable[[Settings], Settings]] = {
    "base": lambda s: s,
    "no-memory": memoryless(),
    "no-memory-eps-1e-3": memoryless(kidnap=1e-3),
    "no-memory-eps-1e-7": memoryless(kidnap=1e-7),
    "memory-eps-1e-4": markov(kidnap=1e-4),
    "memory-eps-1e-6": markov(kidnap=1e-6),
    "memory-slip-0": markov(slip=0.0),
    "memory-share-0.5": lambda s: replace(s, memory_share=(0.5, 0.5)),
    "memory-temper-0.5": lambda s: replace(s, memory_temper=0.5),
    "flatten-0": robust(flatten=0.0),
    "flatten-0.3": robust(flatten=0.3),
    "slip-0": slip(0.0),
    "slip-0.1": slip(0.1),
    "surface-0": surface(0.0),
    "surface-0.5": surface(0.5),
    "low-min-0.02": robust(low_min=0.02),
    "low-min-0.1": robust(low_min=0.1),
    "temper-1/6": model(temper=1 / 6),
    "temper-1/3": model(temper=1 / 3),
    "temper-1/2": model(temper=1 / 2),
    "sigma-0.1": model(sigma_hit=0.1),
    "sigma-0.15": model(sigma_hit=0.15),
    "sigma-0.3": model(sigma_hit=0.3),
}
"""Each changes one thing; one that changes nothing is the base again and is not run."""
COLUMNS = ("variant", "converged %", "steps", "retention %", "strict %", "median error m", "false confident %",
           "recovered %", "steps", "retention %", "strict %")  # fmt: skip


@dataclass(frozen=True)
class Args:
    """Run the variants and write the report."""

    data: Path = Path(os.environ.get("DSOM_DATA") or HERE.parents[2] / "shared" / "data")
    """Folder that holds a folder for each log."""
    out: Path = HERE
    """Folder for results/ and REPORT.md."""
    logs: tuple[str, ...] = ("intel", "freiburg-079")
    """Logs."""
    variants: tuple[str, ...] = ()
    """Names of variants; default: all."""
    runs: int = 50
    """Monte-Carlo runs of each segment."""
    segments: int = 8
    """Segments of each log, each joined to the one half the log away."""
    steps: int = 60
    """Updates in a segment."""
    force: bool = False
    """Run variants again whose results exist."""


def chosen(args: Args) -> dict[str, Settings]:
    """Settings of the variants asked for, without repetitions of the base."""
    unknown = set(args.variants) - set(VARIANTS)
    if unknown:
        raise SystemExit(f"--variants: unknown {', '.join(sorted(unknown))}; choose from {', '.join(VARIANTS)}")
    names = args.variants or tuple(VARIANTS)
    made = {name: VARIANTS[name](REAL) for name in names}
    return {name: settings for name, settings in made.items() if name == "base" or settings != REAL}


class Bed:
    """One log, cut up once, for all variants."""

    def __init__(self, name: str, args: Args) -> None:
        folder = args.data / name
        self.args = localize.Args(
            map=folder / "map.yaml", log=folder / "log.clf.gz", out=args.out, runs=args.runs, segments=args.segments,
            steps_per_segment=args.steps, kidnap=True,
        )  # fmt: skip
        self.grid = load_ros_map(self.args.map)
        self.log = localize.limited(load_log(self.args.log), self.args.laser_max_range)
        self.drives = localize.cut(self.log, self.args)

    def run(self, settings: Settings) -> dict[str, Any]:
        """Summary of one variant."""
        proposal = make_proposal("likelihood_grid", self.grid, self.log.lidar, settings)
        filter = make_filter("adam_robust", proposal, self.grid, self.log.lidar, settings)
        outcomes = localize.localize(filter, self.drives, self.args.runs, self.args.seed)
        # Every variant compiles anew; without this an hour of variants fills the memory.
        jax.clear_caches()
        summary = localize.summarize(outcomes, self.grid, self.args)
        return {key: value for key, value in summary.items() if key not in ("map", "log", "by_segment")}


def report(folder: Path) -> str:
    """Markdown tables of all results in ``folder``/results."""
    order = list(VARIANTS)
    blocks = [HEAD]
    results = [json.loads(path.read_text()) for path in (folder / "results").glob("*.json")]
    for log in sorted({r["name"] for r in results}, reverse=True):
        mine = sorted((r for r in results if r["name"] == log), key=lambda r: order.index(r["variant"]))
        rows = [(r["variant"], *cells(r), *cells(r["kidnap"])[:4]) for r in mine]
        lines = ["| " + " | ".join(row) + " |" for row in (COLUMNS, ("---", *["---:"] * 10), *rows)]
        size = f"{mine[0]['segments']} segments x {mine[0]['runs']} runs, {mine[0]['particles']} particles"
        blocks.append(f"## {log}: {size}\n\n" + "\n".join(lines))
    return "\n\n".join(blocks) + "\n"


HEAD = f"""\
# What each idea of AdaM robust is worth

Written by `python experiments/robust/ablation.py`; do not edit. One choice is changed at a time; base: memory with eps
{REAL.markov.kidnap:g}, slip {REAL.markov.slip:g} and temper {REAL.memory_temper:g},
flatten {REAL.robust.flatten:g}, low_min {REAL.robust.low_min:g},
temper {REAL.robust.model.temper:.3g}, sigma_hit {REAL.robust.model.sigma_hit:g} m, surface
{REAL.robust_raycast.surface:g}.
The first numbers are for the start without prior, the last four for the kidnapping that follows. Terms as in
[the real logs](../real/REPORT.md)."""


def cells(part: dict[str, Any]) -> tuple[str, ...]:
    """Cells of one phase."""

    def shown(key: str, scale: float, digits: int) -> str:
        return "-" if part[key] is None else f"{scale * part[key]:.{digits}f}"

    rates = (shown("converged", 100, 1), shown("steps_median", 1, 0), shown("retention", 100, 2))
    return *rates, shown("strict_success", 100, 1), shown("e_pos_m_median", 1, 3), shown("false_confident", 100, 2)


def main() -> None:
    """Run what is missing, write the report."""
    from dsom_jax.report import write_json, write_text

    args = tyro.cli(Args, description=__doc__)
    (args.out / "results").mkdir(parents=True, exist_ok=True)
    for log in args.logs:
        bed = None
        for name, settings in chosen(args).items():
            path = args.out / "results" / f"{log}.{name.replace('/', '_')}.json"
            if path.exists() and not args.force:
                continue
            bed = bed or Bed(log, args)
            summary = {"name": log, "variant": name, **bed.run(settings)}
            write_json(path, summary)
            print(f"{log} {name}: {' '.join(cells(json.loads(path.read_text())))}", flush=True)
    write_text(args.out / "REPORT.md", report(args.out))


if __name__ == "__main__":
    main()
