"""The synthetic report: ``python experiments/synthetic/run.py [--only comparison ...] [--runs 100] [--force]``.

From the networks in ``checkpoints``, on two cores in about an hour; ``--runs 20`` is a look at all of it in less.
Every job writes ``results/PIECE.JOB.json``; what exists is kept, so that an interrupted run continues where it was, and
a job that fails does not keep the others from being run. Figures (PNG and PDF) and ``experiments/REPORT.md`` are made
from these files at the end.
"""

from __future__ import annotations

import os
import traceback
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import comparison
import cost
import jax
import multimodal
import odometry
import one_scan
import particles
import printed
import retention
import write_report
from lab import Job, Lab, Piece, measured, read, result_path, scaled, write

from dsom_jax import report
from dsom_jax.cli import parse
from dsom_jax.errors import UserError, run_cli

HERE = Path(__file__).resolve().parent
PIECES: tuple[Piece, ...] = tuple(
    module.PIECE for module in (multimodal, comparison, printed, retention, particles, odometry, one_scan, cost)
)


@dataclass(frozen=True)
class Args:
    """Run the synthetic experiments and write their report."""

    only: tuple[str, ...] = ()
    """Pieces to run, or jobs as PIECE.JOB; default: all. The report is written from all results there are."""
    runs: int = 100
    """Monte-Carlo runs of each method on each sequence; runs, buildings, repeats of other pieces in proportion."""
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
    failed = []
    for piece in PIECES:
        failed += run_piece(piece, lab, args, out / "results")
        jax.clear_caches()  # Every filter compiles anew, and what is compiled takes memory.
    page = out / "REPORT.md" if args.out else HERE.parent / "REPORT.md"
    write_report.write(PIECES, out / "results", out / "figures", page)
    print(f"{os.path.relpath(page)}: written")
    if failed:
        raise UserError(f"{', '.join(failed)}: failed, see above; the same command tries again what is missing")


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
    if not 0 <= args.seed < 2**31:
        raise UserError(f"--seed {args.seed}: give 0 or more, and less than 2^31")


def run_piece(piece: Piece, lab: Lab, args: Args, folder: Path) -> list[str]:
    """Run the jobs of one piece that are asked for and missing; the names of those that failed."""
    config, failed = scaled(piece.config, args.runs), []
    for name, job in piece.jobs(config).items():
        full, path = f"{piece.name}.{name}", result_path(folder, piece.name, name)
        if args.only and not {piece.name, full} & set(args.only):
            continue
        if path.exists() and not args.force:
            made = read(path)["made"]
            wanted = report.plain(asdict(config)), lab.seed, lab.origins
            same = (made["config"], made["seed"], made.get("networks")) == wanted
            print(f"{full}: kept" + ("" if same else ", made with other settings or networks (--force)"), flush=True)
        elif not run_job(full, path, job, lab, config):
            failed.append(full)
    return failed


def run_job(full: str, path: Path, job: Job, lab: Lab, config: Any) -> bool:
    """Run one job and keep its numbers; False, and why on the terminal, if it failed."""
    print(f"{full}: ...", flush=True)
    try:
        data = measured(job, lab, config)
    except UserError as error:
        print(f"{full}: failed: {error}", flush=True)
        return False
    except Exception:  # Whatever it is, the jobs after it are not concerned.
        traceback.print_exc()
        print(f"{full}: failed", flush=True)
        return False
    write(path, data)
    made = data["made"]
    print(f"{full}: {made['wall_s']:.0f} s, {made['processor_s']:.0f} s of processor time", flush=True)
    return True


if __name__ == "__main__":
    run_cli(main)
