"""``python -m dsom_jax.localize``: does global localization work with this map and this log?"""

from __future__ import annotations

import json
import math
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from typing import Any, NamedTuple

import jax
import numpy as np

from dsom_jax import report
from dsom_jax.belief.watched import Watched
from dsom_jax.cli import each, parse, stage
from dsom_jax.data import RawLog, Report, load_log, load_map
from dsom_jax.data.log import limited
from dsom_jax.diagnosis.findings import Finding
from dsom_jax.diagnosis.symptoms import cheap_findings
from dsom_jax.errors import one_line, run_cli
from dsom_jax.judging import drives as pieces
from dsom_jax.judging.drives import carried_over, marked
from dsom_jax.judging.foreign import named, replies_of
from dsom_jax.judging.rooms import rooms_of
from dsom_jax.judging.scores import (
    Drive,
    Outcome,
    Replies,
    answered,
    reference_shift,
    save_estimate,
    scores,
    verdicts,
)  # fmt: skip
from dsom_jax.lidar import LidarConfig
from dsom_jax.live.replay import Live
from dsom_jax.localize_args import LocalizeArgs, build, check, drawn_from, load_network, remembers
from dsom_jax.montecarlo import run, run_keys
from dsom_jax.occupancy import OccupancyGrid
from dsom_jax.summary_table import print_summary, reference_notes
from dsom_jax.view.localized import write_view
from dsom_jax.view.recording import ready, write_mcap
from dsom_jax.view.rerun_file import write_rerun
from dsom_jax.view.story import DriveStory


def main() -> None:
    """Command line."""
    args = parse(LocalizeArgs, "python -m dsom_jax.localize")
    check(args)
    summary = answer(args)
    if args.json:
        print(json.dumps(report.plain(summary), indent=2))
    else:
        print_summary(summary, args.out)


def answer(args: LocalizeArgs, carried: Sequence[float] = ()) -> dict[str, Any]:
    """Read, localize, judge and write everything; what ``summary.json`` holds.

    ``carried`` are stamps at which the robot is known to have been carried away, which no log tells.
    """
    if args.live:
        args = replace(args, runs=1)
    grid, log, notes, findings = read(args)
    lines = [*notes, *(finding.line() for finding in findings)]
    _tell(lines, args)
    drives = [marked(drive, carried) for drive in segments_of(log, args)]
    later = few(drives, args)
    _tell(later, args)
    others = {name: replies_of(path, drives) for name, path in named(args.external, "FILE.tum").items()}
    on_plan = carried_over(drives, args.reference_on_plan)
    network = load_network(args, log.lidar)
    folder = report.output_folder(args.out)
    ready(args.mcap, args.rerun, drives)
    with stage("expected ranges from every place of the map"):
        filter = jax.block_until_ready(build(args, grid, log.lidar, network))
    outcomes, latency = driven(filter, grid, log.lidar, drives, args)
    given = answered(outcomes, args.method)
    summary = summary_of(outcomes, given, grid, args, on_plan, others) | latency
    found = reference_notes(summary, reference_shift(drives, given))
    _tell(found, args)
    later += found
    summary |= {"notes": lines + later, "findings": [asdict(finding) for finding in findings]}
    with stage("writing the page"):
        report.write_json(folder / "summary.json", summary)
        save_estimate(folder / "estimate.tum", drives, given)
        shown = write_view(folder, outcomes, grid, log.lidar, summary, findings, notes + later, args)
    record(shown, grid, log.lidar, args)
    return summary


def record(shown: Sequence[DriveStory], grid: OccupancyGrid, lidar: LidarConfig, args: LocalizeArgs) -> None:
    """Write the drives that the page shows as the recordings that are asked for."""
    if args.mcap:
        with stage("writing the recording for Foxglove and ROS 2"):
            write_mcap(args.mcap, grid, lidar, shown)
    if args.rerun:
        with stage("writing the recording for Rerun"):
            write_rerun(args.rerun, grid, lidar, shown)


class Read(NamedTuple):
    """What is in the files, what their readers had to say, and what is odd about them at first sight."""

    grid: OccupancyGrid
    log: RawLog
    notes: list[str]
    findings: list[Finding]


def read(args: LocalizeArgs) -> Read:
    """Map and log, readings beyond ``--laser-max-range`` as no return."""
    left_out = Report()
    grid = load_map(args.map, left_out)
    log = load_log(args.log, args.reading, reference=args.reference)
    findings = cheap_findings(log, grid)
    reports = ((args.map, left_out), (args.log, log.report))
    notes = [f"{file.name}: {line}" for file, report_of in reports for line in report_of.lines()]
    return Read(grid, limited(log, args.laser_max_range), notes, findings)


def _tell(notes: list[str], args: LocalizeArgs) -> None:
    """Print notes, one a line, where they do not get into the JSON."""
    for note in notes:
        print(one_line(note), file=sys.stderr if args.json else sys.stdout)


def segments_of(log: RawLog, args: LocalizeArgs) -> list[Drive]:
    """Segments of the log; with ``--kidnap`` each is followed by the one half the log further."""
    steps = args.steps_per_segment or None
    return pieces.cut(log, args.segments, steps, args.update_min_d, args.update_min_a, args.kidnap)


def few(drives: list[Drive], args: LocalizeArgs) -> list[str]:
    """A note if a short log holds fewer different segments than were asked for."""
    if len(drives) == args.segments:
        return []
    updates = len(drives[0].stamps) // (2 if args.kidnap else 1)
    return [f"{args.log.name}: has only {len(drives)} different segments of {updates} updates, not {args.segments}"]


def driven(
    filter: Watched, grid: OccupancyGrid, lidar: LidarConfig, drives: list[Drive], args: LocalizeArgs
) -> tuple[list[Outcome], dict[str, Any]]:
    """Outcomes of all drives; with ``--live`` also ``latency_ms``."""
    tracked = each(drives, "segments")
    if not args.live:
        return localize(filter, tracked, args.runs, args.seed), {}
    robot = Live(filter, grid, lidar)
    return robot.localize(tracked, args.seed), {"latency_ms": robot.latency_ms()}


def localize(filter: Watched, drives: Any, runs: int, seed: int) -> list[Outcome]:
    """``runs`` Monte-Carlo repetitions of every drive, each drive in one call; the first is compiled in its own."""
    outcomes: list[Outcome] = []
    for number, drive in enumerate(drives):
        keys = run_keys(seed, number, runs)
        start = time.perf_counter()
        keep = range(len(drive.stamps))
        result = jax.block_until_ready(run(filter, drive.episode, keys, keep))
        seconds = time.perf_counter() - start if outcomes else math.nan
        result = result._replace(state=result.state.state, kept=result.kept.state)
        outcomes.append(Outcome(drive, result, seconds))
    return outcomes


def summary_of(
    outcomes: list[Outcome],
    given: list[Replies],
    grid: OccupancyGrid,
    args: LocalizeArgs,
    on_plan: list[Drive] | None = None,
    others: Mapping[str, list[Replies]] | None = None,
) -> dict[str, Any]:
    """``summary.json``: what was asked for, :func:`.scores.scores` of what was ``given``, the same ``on_plan`` and of
    ``external`` ones."""
    head = {
        "map": str(args.map), "log": str(args.log), "map_kind": args.map_kind,
        "method": args.method, "proposal": drawn_from(args), "memory": remembers(args),
        "particles": args.particles, "segments": len(outcomes), "runs": args.runs,
        "updates": sum(len(o.drive.stamps) for o in outcomes),
        "steps_per_segment": len(outcomes[0].drive.stamps), "seed": args.seed,
        "ms_per_update": ms_per_update(outcomes),
    }  # fmt: skip
    head |= verdicts([o.result.info for o in outcomes])
    head["confident"] = head["certain"]
    drives, rooms = [o.drive for o in outcomes], rooms_of(grid)

    def judged(given: list[Replies]) -> dict[str, Any]:
        found = scores(drives, given, grid, args.seed, rooms)
        return found | ({"on_plan": scores(on_plan, given, grid, args.seed, rooms)} if on_plan else {})

    external = {name: judged(theirs) for name, theirs in (others or {}).items()}
    return head | judged(given) | ({"external": external} if external else {})


def ms_per_update(outcomes: list[Outcome]) -> float | None:
    """Median over the drives that did not have to be compiled; None if there is none."""
    times = [o.seconds / len(o.drive.stamps) for o in outcomes if math.isfinite(o.seconds)]
    return 1e3 * float(np.median(times)) if times else None


if __name__ == "__main__":
    run_cli(main)
