"""The synthetic report: ``python experiments/synthetic/run.py [--only comparison ...] [--runs 100] [--force]``.

From the networks in ``checkpoints``, on two cores in about 40 minutes. Every job writes
``results/PIECE.JOB.json``; what exists is kept, so that an interrupted run continues where it was. Figures (PNG and
PDF) and ``experiments/REPORT.md`` are made from these files at the end.
"""

from __future__ import annotations

import os
from dataclasses import asdict, dataclass
from pathlib import Path

import comparison
import cost
import jax
import multimodal
import odometry
import one_scan
import particles
import retention
import write_report
from lab import Lab, Piece, measured, read, scaled, write

from dsom_jax import report
from dsom_jax.cli import parse
from dsom_jax.errors import UserError, run_cli

HERE = Path(__file__).resolve().parent
PIECES: tuple[Piece, ...] = tuple(
    module.PIECE for module in (multimodal, comparison, retention, particles, odometry, one_scan, cost)
)


@dataclass(frozen=True)
class Args:
    """Run the synthetic experiments and write their report."""

    only: tuple[str, ...] = ()
    """Pieces to run, or jobs as PIECE.JOB; default: all. The report is written from all results there are."""
    runs: int = 100
    """Monte-Carlo runs of each method on each sequence; other pieces and their numbers of scans in proportion."""
    seed: int = 0
    """Seed of all randomness."""
    out: Path | None = None
    """Folder for results, figures and REPORT.md; default: this folder, and REPORT.md one above."""
    force: bool = False
    """Run again what exists."""


def main() -> None:
    """Run what is missing, write the report."""
    args = parse(Args, "python experiments/synthetic/run.py")
    check(args)
    out = report.output_folder(args.out or HERE)
    (out / "results").mkdir(exist_ok=True)
    lab = Lab(args.seed)
    for piece in PIECES:
        run_piece(piece, lab, args, out / "results")
        jax.clear_caches()  # Every filter compiles anew, and what is compiled takes memory.
    page = out / "REPORT.md" if args.out else HERE.parent / "REPORT.md"
    write_report.write(PIECES, out / "results", out / "figures", page)
    print(f"{os.path.relpath(page)}: written")


def check(args: Args) -> None:
    """UserError for what cannot be run."""
    names = {
        name for piece in PIECES for name in (piece.name, *(f"{piece.name}.{job}" for job in piece.jobs(piece.config)))
    }
    unknown = [name for name in args.only if name not in names]
    if unknown:
        raise UserError(f"--only {unknown[0]}: no such piece; choose from {', '.join(p.name for p in PIECES)}")
    if not 1 <= args.runs <= 10_000:
        raise UserError(f"--runs {args.runs}: give at least 1 and at most 10000")


def run_piece(piece: Piece, lab: Lab, args: Args, folder: Path) -> None:
    """The jobs of one piece that are asked for and missing."""
    config = scaled(piece.config, args.runs)
    for name, job in piece.jobs(config).items():
        full, path = f"{piece.name}.{name}", folder / f"{piece.name}.{name.replace(' ', '_')}.json"
        if args.only and not {piece.name, full} & set(args.only):
            continue
        if path.exists() and not args.force:
            same = read(path)["made"]["config"] == report.plain(asdict(config))
            print(f"{full}: kept" + ("" if same else ", made with other settings (--force)"), flush=True)
            continue
        data = measured(job, lab, config)
        write(path, data)
        made = read(path)["made"]
        print(f"{full}: {made['wall_s']:.0f} s, {made['processor_s']:.0f} s of processor time", flush=True)


if __name__ == "__main__":
    run_cli(main)
