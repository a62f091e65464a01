"""Real logs: ``python experiments/real/run.py [--data DIR] [--only intel ...] [--force]``.

Runs ``dsom_jax.localize`` on every log of the data folder (``DSOM_DATA``, or ``../shared/data`` beside the project),
each in a process of its own, and writes ``results/NAME.json`` and from all of them ``REPORT.md``. Results that exist
are kept, so an interrupted series continues where it was. Settings of the full series: 100 runs x 8 segments of 60
updates, 500 particles, no prior on the pose.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from dsom_jax.run_folder import commit

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
LOGS = {
    "intel": ("intel", "intel"),
    "freiburg-079": ("freiburg-079", "freiburg-079"),
    "walls-only": ("freiburg-079-walls-only", "freiburg-079"),
    "intel-half": ("intel-half", "intel-half"),
    "freiburg-079-half": ("freiburg-079-half", "freiburg-079-half"),
}
"""Name -> folders of the map and of the log. The floor plan ``walls-only`` has no log of its own."""
DRAWN = ("walls-only",)
"""Maps that are floor plans."""
METHODS = ("adam_robust", "adam_sharp")
ON_MAP = 0.85
"""A segment lies on mapped space if this share of its reference poses is on free cells."""
COLUMNS = ("log", "method", "runs", "converged %", "steps", "retention %", "strict %", "median error m",
           "false confident %", "ms/update")  # fmt: skip


@dataclass(frozen=True)
class Args:
    """Run the series and write the report."""

    data: Path = Path(os.environ.get("DSOM_DATA") or ROOT.parent / "shared" / "data")
    """Folder that holds a folder for each log."""
    out: Path = HERE
    """Folder for results/ and REPORT.md."""
    only: tuple[str, ...] = ()
    """Names of jobs, such as intel or intel-kidnap; default: all."""
    methods: tuple[str, ...] = METHODS
    """Filters."""
    runs: int = 100
    """Monte-Carlo runs of each segment."""
    segments: int = 8
    """Segments of each log."""
    particles: int = 500
    """Particles per run."""
    force: bool = False
    """Run jobs again whose results exist."""


@dataclass(frozen=True)
class Job:
    """One call of ``localize``."""

    name: str
    map: Path
    log: Path
    method: str
    kidnap: bool

    @property
    def stem(self) -> str:
        """Name of its result file."""
        return f"{self.name}.{self.method}"


def jobs(args: Args) -> list[Job]:
    """All that was asked for: every log plain, and the two whole ones with a spliced kidnapping."""
    listed = [(name, *folders, False) for name, folders in LOGS.items()]
    listed += [(f"{name}-kidnap", *LOGS[name], True) for name in ("intel", "freiburg-079")]
    return [
        Job(name, args.data / place / "map.yaml", args.data / log / "log.clf.gz", method, kidnap)
        for name, place, log, kidnap in listed
        if not args.only or name in args.only
        for method in args.methods
    ]


def run(job: Job, args: Args, result: Path) -> str | None:
    """Call ``localize`` and keep its summary; the last line of its complaint if it fails."""
    with tempfile.TemporaryDirectory() as folder:
        words = ["--map", job.map, "--log", job.log, "--method", job.method, "--out", folder, "--runs", args.runs]
        words += ["--map-kind", "drawn" if job.name in DRAWN else "scanned"]
        words += ["--segments", args.segments, "--particles", args.particles, *["--kidnap"] * job.kidnap]
        command = [sys.executable, "-m", "dsom_jax.localize", *map(str, words)]
        done = subprocess.run(command, capture_output=True, text=True)
        if done.returncode:
            return (done.stderr.strip().splitlines() or [f"exit code {done.returncode}"])[-1]
        summary = json.loads((Path(folder) / "summary.json").read_text())
    # Where the data lay on this machine is nobody's business.
    summary |= {"map": str(job.map.relative_to(args.data)), "log": str(job.log.relative_to(args.data))}
    summary |= {"name": job.name, "commit": commit()[:7], "load_average": os.getloadavg()[0]}
    draft = result.with_suffix(".new")
    draft.write_text(json.dumps(summary, indent=2) + "\n")
    draft.replace(result)
    return None


def report(folder: Path) -> str:
    """Markdown table of all results in ``folder``/results, in the order of the series."""
    order = [*LOGS, *(f"{name}-kidnap" for name in LOGS)]
    found = [json.loads(path.read_text()) for path in (folder / "results").glob("*.json")]
    found.sort(key=lambda r: (order.index(r["name"]), r["method"] != METHODS[0], r["method"]))
    rows = [row for result in found for row in result_rows(result)]
    table = ["| " + " | ".join(row) + " |" for row in (COLUMNS, ("---", "---", *["---:"] * 8), *rows)]
    made = sorted({(r["commit"], r["particles"], r["segments"], r["runs"], r["steps_per_segment"]) for r in found})
    notes = [f"- commit {c}: {p} particles, {s} segments x {n} runs, {t} updates each" for c, p, s, n, t in made]
    return "\n".join([HEAD, *table, "", "Made with", "", *notes]) + "\n"


HEAD = f"""\
# Real logs

Written by `python experiments/real/run.py`; do not edit. Every segment starts without any prior on the pose.

- converged: 5 updates in a row within 2 m and 10 deg [95 % interval by segment; where all runs of each agree, Wilson's
  with segments as trials]; steps: updates before, median
- retention: share of the later updates that stay within; strict: last estimate within 0.5 m and 5 deg
- median error: of the last estimate, over converged runs
- false confident: updates at which the filter claims to know (lost < 5 %) and is not within 2 m and 10 deg
- "after the kidnapping": the second part of two spliced segments, whose first part is the row above
- "on mapped space": segments with at least {ON_MAP:.0%} of their reference poses on free cells
"""


def result_rows(result: dict[str, Any]) -> list[tuple[str, ...]]:
    """Rows of one result: the start, the kidnapping if there is one, mapped segments where there are others."""
    name, method, ms = result["name"], result["method"], result["ms_per_update"]
    ms = "-" if ms is None else f"{ms:.0f}"  # one segment alone is compiled in its own time
    rows = [(name, method, *numbers(result), ms)]
    if "kidnap" in result:
        rows.append((f"{name}, after the kidnapping", method, *numbers(result["kidnap"]), ""))
    segments = result["by_segment"]
    mapped = [s for s in segments if (s["on_map"] or 0) >= ON_MAP]
    if mapped and len(mapped) < len(segments):
        cells = [percent(sum(s[key] for s in mapped) / len(mapped)) for key in ("converged", "strict_success")]
        runs = str(len(mapped) * result["runs"])
        rows.append((f"{name}, on mapped space", method, runs, cells[0], "", "", cells[1], "", "", ""))
    return rows


def numbers(part: dict[str, Any]) -> tuple[str, ...]:
    """Cells of one phase."""
    low, high = part["converged_ci95"]
    bounds = "" if low is None else f" [{percent(low)}-{percent(high)}]"
    return (
        str(part["experiments"]), percent(part["converged"]) + bounds,
        "-" if part["steps_median"] is None else f"{part['steps_median']:g}", percent(part["retention"], 2),
        percent(part["strict_success"]), "-" if part["e_pos_m_median"] is None else f"{part['e_pos_m_median']:.3f}",
        percent(part["false_confident"], 2),
    )  # fmt: skip


def percent(rate: float | None, digits: int = 1) -> str:
    """A rate, or a dash."""
    return "-" if rate is None else f"{100 * rate:.{digits}f}"


def main() -> int:
    """Run what is missing, write the report; the number of jobs that failed."""
    args = tyro.cli(Args, description=__doc__)
    (args.out / "results").mkdir(parents=True, exist_ok=True)
    failed = 0
    for job in jobs(args):
        result = args.out / "results" / f"{job.stem}.json"
        if result.exists() and not args.force:
            print(f"{job.stem}: kept")
            continue
        complaint = run(job, args, result)
        failed += complaint is not None
        print(f"{job.stem}: {complaint or 'done'}", flush=True)
        (args.out / "REPORT.md").write_text(report(args.out))
    (args.out / "REPORT.md").write_text(report(args.out))
    return failed


if __name__ == "__main__":
    raise SystemExit(min(main(), 1))
