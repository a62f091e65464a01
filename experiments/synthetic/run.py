"""The synthetic report: ``python experiments/synthetic/run.py [--only comparison ...] [--runs 100] [--force]``.

From the networks in ``checkpoints``, on two cores in three quarters of an hour; ``--runs 20`` is a look at all of it in
less. What is timed has the machine for itself; after it, ``--workers`` processes share the rest. Every job writes
``results/PIECE.JOB.json``; what exists is kept, so that an interrupted run continues where it was, and a job that fails
does not keep the others from being run. Figures and ``experiments/REPORT.md`` are made from these files
at the end.
"""

from __future__ import annotations

import os
import traceback
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from dataclasses import asdict, dataclass
from functools import cache
from multiprocessing import get_context
from pathlib import Path

import comparison
import cost
import multimodal
import odometry
import one_scan
import particles
import printed
import retention
import write_report
from lab import Lab, Piece, measured, read, result_path, scaled, write

from dsom_jax import report
from dsom_jax.cli import parse
from dsom_jax.errors import UserError, run_cli

HERE = Path(__file__).resolve().parent
PIECES: tuple[Piece, ...] = tuple(
    module.PIECE for module in (multimodal, comparison, printed, retention, particles, odometry, one_scan, cost)
)

Work = tuple[str, str, int, int, Path]
"""A job for a process: piece, job, seed, runs, folder of the results."""


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
    workers: int = 2
    """Processes that share the jobs whose times are not shown; 1 takes one job after the other."""


def main() -> None:
    """Run what is missing, write the report."""
    args = parse(Args, "python experiments/synthetic/run.py")
    check(args)
    out = report.output_folder(args.out or HERE)
    (out / "results").mkdir(exist_ok=True)
    failed = run_pieces(PIECES, lab_of(args.seed), args, out / "results")
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
    if not 1 <= args.workers <= 64:
        raise UserError(f"--workers {args.workers}: give at least 1 and at most 64")
    if not 0 <= args.seed < 2**31:
        raise UserError(f"--seed {args.seed}: give 0 or more, and less than 2^31")


@cache
def lab_of(seed: int) -> Lab:
    """The lab of this process, in which all of its jobs run."""
    return Lab(seed)


def run_pieces(pieces: Sequence[Piece], lab: Lab, args: Args, folder: Path) -> list[str]:
    """Run what is asked for and missing; the names of the jobs that failed."""
    missing = [(piece, name) for piece in pieces for name in wanted(piece, lab, args, folder)]
    alone = [job for job in missing if args.workers == 1 or job[0].timed]
    failed = [f"{piece.name}.{name}" for piece, name in alone if not run_job(piece, name, lab, args.runs, folder)]
    lab.enter("")
    lab.sources.clear()
    rest = [(piece.name, name, lab.seed, args.runs, folder) for piece, name in missing if (piece, name) not in alone]
    return failed + shared(rest, args.workers)


def wanted(piece: Piece, lab: Lab, args: Args, folder: Path) -> Iterator[str]:
    """The jobs of a piece to be run; says of the others that they are kept."""
    config = scaled(piece.config, args.runs)
    for name in piece.jobs(config):
        full, path = f"{piece.name}.{name}", result_path(folder, piece.name, name)
        if args.only and not {piece.name, full} & set(args.only):
            continue
        if args.force or not path.exists():
            yield name
            continue
        made = read(path)["made"]
        now = report.plain(asdict(config)), lab.seed, lab.origins
        same = (made["config"], made["seed"], made.get("networks")) == now
        print(f"{full}: kept" + ("" if same else ", made with other settings or networks (--force)"), flush=True)


def shared(jobs: Sequence[Work], workers: int) -> list[str]:
    """Run jobs in processes of their own, which give the numbers of one process; the names of those that failed.

    Not in threads: beside another computation in one process, some runs with DSOM and hybrid came out otherwise.
    """
    worked = together(jobs, workers)
    for job in [job for job in jobs if worked[job] is None]:
        # Whichever it was that had its process killed, the others are not concerned.
        worked |= together([job], 1)
    for job in [job for job in jobs if worked[job] is None]:
        print(f"{job[0]}.{job[1]}: failed: its process was killed; is there enough memory?", flush=True)
    return [f"{job[0]}.{job[1]}" for job in jobs if not worked[job]]


def together(jobs: Sequence[Work], workers: int) -> dict[Work, bool | None]:
    """Whether each job worked; None for those that were under way or waiting when a process was killed."""
    worked: dict[Work, bool | None] = dict.fromkeys(jobs)
    with ProcessPoolExecutor(max(1, min(workers, len(jobs))), get_context("spawn")) as pool:
        try:
            futures = {}
            for job in jobs:
                with suppress(BrokenProcessPool):
                    futures[pool.submit(in_worker, *job)] = job
            for done in as_completed(futures):
                with suppress(BrokenProcessPool):
                    worked[futures[done]] = done.result()
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    return worked


def in_worker(piece: str, job: str, seed: int, runs: int, folder: Path) -> bool:
    """:func:`run_job` by name."""
    (found,) = (p for p in PIECES if p.name == piece)
    try:
        return run_job(found, job, lab_of(seed), runs, folder)
    except KeyboardInterrupt:
        os._exit(130)  # An exception would be handed back, and the next job begun.


def run_job(piece: Piece, name: str, lab: Lab, runs: int, folder: Path) -> bool:
    """Run one job and keep its numbers; False, and why on the terminal, if it failed."""
    lab.enter(piece.name)
    full, config = f"{piece.name}.{name}", scaled(piece.config, runs)
    job = piece.jobs(config)[name]
    print(f"{full}: ...", flush=True)
    try:
        data = measured(job, lab, config)
        write(result_path(folder, piece.name, name), data)
    except UserError as error:
        print(f"{full}: failed: {error}", flush=True)
        return False
    except Exception:  # Whatever it is, the jobs after it are not concerned.
        traceback.print_exc()
        print(f"{full}: failed", flush=True)
        return False
    made = data["made"]
    print(f"{full}: {made['wall_s']:.0f} s, {made['processor_s']:.0f} s of processor time", flush=True)
    return True


if __name__ == "__main__":
    run_cli(main)
