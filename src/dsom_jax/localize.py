"""``python -m dsom_jax.localize``: does global localization work with this map and this log?"""

from __future__ import annotations

import json
import math
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from rich import box
from rich.table import Table

from dsom_jax import checkpoint, report
from dsom_jax.belief.watched import Watched
from dsom_jax.cli import each, parse, stage
from dsom_jax.data import LogOptions, RawLog, Report, load_log, load_map
from dsom_jax.data.cut import segment_indices, splice, to_episode, without_repeats
from dsom_jax.data.log import STILL, limited
from dsom_jax.diagnosis.symptoms import cheap_findings
from dsom_jax.errors import UserError, one_line, run_cli
from dsom_jax.filters.methods import make_filter, make_proposal, watch
from dsom_jax.filters.settings import DRAWN, REAL, sharp_powers, with_motion, with_sensor
from dsom_jax.judging import metrics
from dsom_jax.judging.foreign import named, replies_of
from dsom_jax.judging.rooms import rooms_of
from dsom_jax.judging.scores import (
    Drive,
    Outcome,
    Replies,
    judged_by,
    reference_shift,
    replies,
    save_estimate,
    scores,
    verdicts,
)  # fmt: skip
from dsom_jax.lidar import LidarConfig
from dsom_jax.live import Localizer
from dsom_jax.montecarlo import Result, run, run_keys
from dsom_jax.occupancy import OccupancyGrid
from dsom_jax.types import Key
from dsom_jax.view.localized import write_view


@dataclass(frozen=True)
class Args:
    """Cut a log into segments, start each without any prior, and tell how often the robot is found."""

    map: Path
    """ROS map_server YAML, a bag with /map, a DXF drawing, or a YAML with `drawing: FILE.dxf` and how to read it."""
    log: Path
    """CARMEN (.log, .clf, .gz), rosbag1, rosbag2, mcap, or Rawseeds (*-SICK_FRONT.csv, or its folder)."""
    out: Path
    """Folder for report.html, trajectory.png, summary.json, answers.csv and estimate.tum."""
    reference_on_plan: Path | None = None
    """TUM trajectory carried over to a floor plan that is locally wrong; judged besides, as on_plan in summary.json."""
    external: tuple[str, ...] = ()
    """NAME=FILE.tum: another localizer's trajectory, judged alike, as external in summary.json."""
    reference: Path | None = None
    """TUM trajectory of the base in the map frame; default: the log's own, where it has one."""
    reading: Annotated[LogOptions, tyro.conf.arg(name="")] = LogOptions()
    """What the log does not say, or says wrongly; topics and frames are those of bags."""
    method: Literal["adam_robust", "adam", "adam_sharp", "mcl", "mcl_sharp", "mixture_mcl", "mixture_mcl_sharp"] = (
        "adam_robust"
    )
    """Particle filter; `adam`, `mcl`, `mixture_mcl` weigh as the paper prints, `_sharp` by powers of Eq 15."""
    proposal: Literal["likelihood_grid", "dsom", "hybrid", "uniform", "dual_features"] = "likelihood_grid"
    """Where redrawn particles come from; `mcl` always draws uniformly."""
    checkpoint: Path | None = None
    """Folder of a trained network, for dsom and hybrid; default: the one in the repository."""
    map_kind: Literal["scanned", "drawn"] = "scanned"
    """A map made from scans, or a floor plan that shows walls only."""
    particles: int = 500
    """Particles per run."""
    runs: int = 100
    """Monte-Carlo runs of each segment."""
    segments: int = 8
    """Pieces of the log, each started anew."""
    steps_per_segment: int = 60
    """Updates in a segment; 0 cuts the log into contiguous pieces without rest."""
    update_min_d: float = 0.25
    """Metres driven between updates."""
    update_min_a: float = 0.2
    """Radians turned between updates."""
    sensor_model: Literal["beam", "likelihood_field", "score"] | None = None
    """What a scan says of a pose; default: `beam` for adam_robust, `score`, Eq 15 of the paper, for the others."""
    motion_model: Literal["differential", "omni"] = "differential"
    """Drive of the robot: `omni` also moves sideways (nav2's robot_model_type)."""
    memory: bool = True
    """Let adam_robust remember earlier scans on the likelihood grid; --no-memory judges every scan on its own."""
    live: bool = False
    """One run of each segment through a Localizer, update by update as on a robot; tells latencies."""
    kidnap: bool = False
    """Join each segment to the one half the log away, as an unnoticed kidnapping."""
    t_cut: float = 0.6
    """T_cut of Alg 1."""
    laser_max_range: float = 25.0
    """Metres; longer readings count as no return."""
    max_beams: int = 60
    """Beams used for weighing."""
    seed: int = 0
    """Seed of all randomness."""
    json: bool = False
    """Print summary.json instead of a table."""


MANY = 1_000_000


def main() -> None:
    """Command line."""
    args = parse(Args, "python -m dsom_jax.localize")
    check(args)
    summary = answer(args)
    if args.json:
        print(json.dumps(report.plain(summary), indent=2))
    else:
        print_summary(summary, args.out)


def answer(args: Args, carried: Sequence[float] = ()) -> dict[str, Any]:
    """Read, localize, judge and write everything; what ``summary.json`` holds.

    ``carried`` are stamps at which the robot is known to have been carried away, which no log tells.
    """
    if args.live:
        args = replace(args, runs=1)
    left_out = Report()
    grid = load_map(args.map, left_out)
    log = load_log(args.log, args.reading, reference=args.reference)
    findings = cheap_findings(log, grid)
    log = limited(log, args.laser_max_range)
    reports = ((args.map, left_out), (args.log, log.report))
    notes = [f"{file.name}: {line}" for file, report_of in reports for line in report_of.lines()]
    notes += [finding.line() for finding in findings]
    tell(notes, args)
    drives = [marked(drive, carried) for drive in cut(log, args)]
    others = {name: replies_of(path, drives) for name, path in named(args.external, "FILE.tum").items()}
    on_plan = carried_over(drives, args.reference_on_plan)
    network = load_network(args, log.lidar)
    folder = report.output_folder(args.out)
    with stage("expected ranges from every place of the map"):
        filter = jax.block_until_ready(build(args, grid, log.lidar, network))
    tracked = each(drives, "segments")
    robot = Live(filter, grid, log.lidar) if args.live else None
    outcomes = robot.localize(tracked, args.seed) if robot else localize(filter, tracked, args.runs, args.seed)
    summary = summary_of(outcomes, grid, args, on_plan, others)
    if robot:
        summary["latency_ms"] = robot.latency_ms()
    given = [replies(outcome.result.info, judged_by(args.method)) for outcome in outcomes]
    found = reference_notes(summary, reference_shift(drives, given))
    tell(found, args)
    notes += found
    summary["notes"] = notes
    summary |= {"findings": [asdict(finding) for finding in findings]}
    with stage("writing the page"):
        report.write_json(folder / "summary.json", summary)
        save_estimate(folder / "estimate.tum", outcomes)
        write_view(folder, outcomes, grid, log.lidar, summary, notes, args)
    return summary


def tell(notes: list[str], args: Args) -> None:
    """Print notes, one a line, where they do not get into the JSON."""
    for note in notes:
        print(one_line(note), file=sys.stderr if args.json else sys.stdout)


def marked(drive: Drive, carried: Sequence[float]) -> Drive:
    """The drive with the first update from each of the stamps ``carried`` on marked as after a kidnapping."""
    first = np.searchsorted(drive.stamps, np.asarray(carried, float) - 1e-6)
    flags = np.asarray(drive.episode.kidnapped).copy()
    flags[first[(first > 0) & (first < len(flags))]] = True
    return drive._replace(episode=drive.episode._replace(kidnapped=jnp.asarray(flags))) if len(carried) else drive


def check(args: Args) -> None:
    """UserError for settings that mean nothing."""
    for name in ("particles", "runs", "segments", "max_beams", "laser_max_range"):
        if not getattr(args, name) > 0:
            raise UserError(f"--{name.replace('_', '-')} {getattr(args, name)}: give a positive number")
    for name, most in (("particles", MANY), ("runs", MANY), ("segments", MANY), ("seed", 2**32 - 1)):
        if getattr(args, name) > most:
            raise UserError(f"--{name} {getattr(args, name)}: give at most {most}")
    for name in ("update_min_d", "update_min_a", "seed"):
        if not getattr(args, name) >= 0:
            raise UserError(f"--{name.replace('_', '-')} {getattr(args, name)}: must not be negative")
    if args.steps_per_segment and args.steps_per_segment < 6:
        raise UserError(f"--steps-per-segment {args.steps_per_segment}: give at least 6, or 0 for the whole log")
    if not 0 < args.t_cut < 1:
        raise UserError(f"--t-cut {args.t_cut}: give a number between 0 and 1 (the paper uses 0.6)")
    check_network(args)
    if args.kidnap and args.segments < 2:
        raise UserError(f"--segments {args.segments}: --kidnap joins two segments, give at least 2")


def check_network(args: Args) -> None:
    """UserError if a network is needed and none there, or one is named and nothing draws from it."""
    if needs_network(args) and network_folder(args) is None:
        raise UserError(f"--proposal {args.proposal}: give --checkpoint, the folder of a trained network")
    if args.checkpoint and not needs_network(args):
        chosen = f"--method {args.method}" if args.method.startswith("mcl") else f"--proposal {args.proposal}"
        fix = "leave it out, or give --proposal dsom or hybrid and a --method other than mcl"
        raise UserError(f"--checkpoint {args.checkpoint}: has no use with {chosen}; {fix}")


def cut(log: RawLog, args: Args) -> list[Drive]:
    """Segments of the log; with ``--kidnap`` each is followed by the one half the log further."""
    rows = segment_indices(log, args.segments, args.steps_per_segment or None, args.update_min_d, args.update_min_a)
    if rows.shape[1] < metrics.HOLD + 1:
        if still := next((line for line in log.report.lines() if STILL in line), None):
            raise UserError(f"{log.path}: no updates to judge: {still}, or give a log of a drive")
        raise UserError(
            f"{log.path}: segments of {rows.shape[1]} updates are too short to judge, need {metrics.HOLD + 1}; "
            "give a longer log, fewer --segments or smaller --update-min-d and --update-min-a"
        )
    rows = distinct(log, rows, args)
    pieces = [Drive(to_episode(log, row), log.stamps[row]) for row in rows]
    if not args.kidnap:
        return pieces
    others = pieces[len(pieces) // 2 :] + pieces[: len(pieces) // 2]
    return [
        Drive(splice(a.episode, b.episode), np.concatenate([a.stamps, b.stamps]))
        for a, b in zip(pieces, others, strict=True)
    ]


def distinct(log: RawLog, rows: np.ndarray, args: Args) -> np.ndarray:
    """The segments (S, T) without repetitions; says so if a short log holds fewer than were asked for."""
    kept = without_repeats(rows)
    if len(kept) < len(rows):
        print(f"{log.path.name}: has only {len(kept)} different segments of {rows.shape[1]} updates, not {len(rows)}")
    if args.kidnap and len(kept) < 2:
        raise UserError(f"{log.path}: --kidnap joins two segments; give a longer log or a smaller --steps-per-segment")
    return kept


def drawn_from(args: Args) -> str:
    """Name of the proposal that the filter draws from, whatever the arguments name: MCL's is uniform."""
    return "uniform" if args.method.startswith("mcl") else args.proposal


def remembers(args: Args) -> bool:
    """Whether the filter remembers earlier scans on the likelihood grid."""
    return args.memory and args.method == "adam_robust" and args.proposal == "likelihood_grid"


def needs_network(args: Args) -> bool:
    """Whether the filter draws from a trained network."""
    return drawn_from(args) in ("dsom", "hybrid")


def network_folder(args: Args) -> Path | None:
    """The checkpoint that is named, else the one that comes with the repository."""
    return args.checkpoint or checkpoint.shipped()


def load_network(args: Args, lidar: LidarConfig) -> Any:
    """The trained network that the arguments ask for, None if nothing draws from one."""
    folder = network_folder(args) if needs_network(args) else None
    return None if folder is None else checkpoint.load(folder, lidar=lidar)


def build(args: Args, grid: OccupancyGrid, lidar: LidarConfig, network: Any = None) -> Watched:
    """The filter that the arguments ask for, with a verdict on its answers."""
    kind = DRAWN if args.map_kind == "drawn" else REAL
    own = ("particles", "t_cut", "max_beams", "seed", "memory")
    settings = replace(kind, **{name: getattr(args, name) for name in own}, powers=sharp_powers(drawn_from(args)))
    if args.sensor_model:
        settings = with_sensor(settings, args.sensor_model)
    settings = with_motion(settings, args.motion_model)
    proposal = make_proposal(drawn_from(args), grid, lidar, settings, network)
    filter = make_filter(args.method, proposal, grid, lidar, settings)
    return watch(filter, grid, lidar, settings, judged_by(args.method))


def localize(filter: Watched, drives: Any, runs: int, seed: int) -> list[Outcome]:
    """``runs`` Monte-Carlo repetitions of every drive, each drive in one call."""
    outcomes: list[Outcome] = []
    for number, drive in enumerate(drives):
        keys = run_keys(seed, number, runs)
        start = time.perf_counter()
        keep = range(len(drive.stamps))
        result = jax.block_until_ready(run(filter, drive.episode, keys, keep))
        result = result._replace(state=result.state.state, kept=result.kept.state)
        outcomes.append(Outcome(drive, result, time.perf_counter() - start))
    if len(outcomes) == 1:
        start = time.perf_counter()
        jax.block_until_ready(run(filter, outcomes[0].drive.episode, run_keys(seed, 0, runs), keep))
        return [outcomes[0]._replace(seconds=time.perf_counter() - start)]
    return outcomes


class Live:
    """One robot that drives the segments one after another."""

    def __init__(self, filter: Watched, grid: OccupancyGrid, lidar: LidarConfig) -> None:
        self._begun = time.perf_counter()
        self._robot = Localizer(grid, lidar, filter=filter)
        self._first, self._seconds = 0.0, list[float]()

    def localize(self, drives: Any, seed: int) -> list[Outcome]:
        """Every drive once, with the luck of run 0."""
        return [self._drive(drive, run_keys(seed, number, 1)) for number, drive in enumerate(drives)]

    def _drive(self, drive: Drive, keys: Key) -> Outcome:
        infos, states, seconds = [], [], []
        self._robot.relocalize(keys)
        ranges, odometry = np.asarray(drive.episode.ranges), np.asarray(drive.episode.odometry)
        for scan, motion, stamp in zip(ranges, odometry, drive.stamps, strict=True):
            seconds.append(self._robot.advance(scan, motion, float(stamp)).seconds)
            self._first = self._first or time.perf_counter() - self._begun
            infos.append(self._robot.info)
            states.append(self._robot.state())
        info, kept = (jax.tree.map(lambda *leaves: np.stack(leaves), *rows) for rows in (infos, states))
        self._seconds += seconds
        last = jax.tree.map(lambda leaf: leaf[None], states[-1])
        return Outcome(drive, Result(jax.tree.map(lambda leaf: leaf[None], info), last, kept), sum(seconds))

    def latency_ms(self) -> dict[str, float]:
        """Milliseconds of the updates; ``first`` is from making the Localizer to its first answer."""
        ms = 1e3 * np.array(self._seconds)
        summary = {"median": np.median(ms), "p99": np.percentile(ms, 99), "max": ms.max(), "first": 1e3 * self._first}
        return {name: float(value) for name, value in summary.items()}


def carried_over(drives: list[Drive], reference: Path | None) -> list[Drive] | None:
    """The drives with another reference, if there is one."""
    if reference is None:
        return None
    poses = [given.poses[0] for given in replies_of(reference, drives)]
    return [d._replace(episode=d.episode._replace(poses=jnp.asarray(p, jnp.float32)))
            for d, p in zip(drives, poses, strict=True)]  # fmt: skip


def summary_of(
    outcomes: list[Outcome],
    grid: OccupancyGrid,
    args: Args,
    on_plan: list[Drive] | None = None,
    others: Mapping[str, list[Replies]] | None = None,
) -> dict[str, Any]:
    """``summary.json``: what was asked for, :func:`.scores.scores`, the same ``on_plan`` and of ``external`` ones."""
    updates = sum(len(o.drive.stamps) for o in outcomes)
    timed = outcomes[1:] or outcomes
    head = {
        "map": str(args.map), "log": str(args.log), "map_kind": args.map_kind,
        "method": args.method, "proposal": drawn_from(args), "memory": remembers(args),
        "particles": args.particles, "segments": len(outcomes), "runs": args.runs, "updates": updates,
        "steps_per_segment": len(outcomes[0].drive.stamps), "seed": args.seed,
        "ms_per_update": 1e3 * float(np.median([o.seconds / len(o.drive.stamps) for o in timed])),
    }  # fmt: skip
    head |= verdicts([o.result.info for o in outcomes])
    head["confident"] = head["certain"]
    given = [replies(o.result.info, judged_by(args.method)) for o in outcomes]
    drives, rooms = [o.drive for o in outcomes], rooms_of(grid)

    def judged(given: list[Replies]) -> dict[str, Any]:
        found = scores(drives, given, grid, args.seed, rooms)
        return found | ({"on_plan": scores(on_plan, given, grid, args.seed, rooms)} if on_plan else {})

    external = {name: judged(theirs) for name, theirs in (others or {}).items()}
    return head | judged(given) | ({"external": external} if external else {})


def reference_notes(summary: dict[str, Any], shift: dict[str, float] | None) -> list[str]:
    """What is to be said about the frame of the reference; ``shift`` carries it onto the answers, if one does."""
    on_map = [part["on_map"] for part in summary.get("by_segment", ()) if part["on_map"] is not None]
    notes = []
    if on_map and np.mean(on_map) < 0.5:
        notes.append(f"reference: lies on free cells of the map at {np.mean(on_map):.0%} of its poses only")
    if shift is not None:
        moved = f"({shift['x']:.2f}, {shift['y']:.2f}) m, {math.degrees(shift['theta']):.1f} deg"
        notes.append(
            f"reference: is in another frame: moved by {moved} it agrees with {shift['share']:.0%} of the sure answers "
            "(or the map looks the same there); move it, or correct the origin of the map"
        )
    elif notes:
        notes.append("reference: no shift makes it agree with the answers; check that it is of this map and this drive")
    return notes


COLUMNS = (
    ("runs", "experiments", "{:d}"), ("found", "converged", "{:.1%}"), ("updates", "steps_median", "{:g}"),
    ("metres", "metres_median", "{:.1f}"), ("right later", "retention", "{:.1%}"),
    ("error", "e_pos_m_median", "{:.3f} m"), ("sure and wrong", "false_confident", "{:.2%}"),
)  # fmt: skip
"""Of the table for a person: head, key of ``summary.json``, format. Medians are those of the runs that found."""


def print_summary(summary: dict[str, Any], folder: Path) -> None:
    """One table for a person, and what to look at."""
    console = report.terminal()
    if "converged" in summary:
        table = Table(box=box.SIMPLE_HEAD, show_edge=False, padding=(0, 2, 0, 0))
        table.add_column("")
        for head, _, _ in COLUMNS:
            table.add_column(head, justify="right")
        parts = [("start anywhere", summary), ("carried away", summary.get("kidnap"))]
        parts += [("on the plan", summary.get("on_plan"))]
        for name, theirs in summary.get("external", {}).items():
            parts += [(name, theirs), (f"{name}, carried away", theirs.get("kidnap"))]
        for name, part in parts:
            if part and "converged" in part:
                table.add_row(name, *(_cell(part[key], text) for _, key, text in COLUMNS))
        console.print(table)
    else:
        sure = f"{summary['updates']} updates, sure of the answer in {summary['certain']:.1%} of them"
        console.print(f"{sure}; no reference to judge by")
    console.print(f"{summary['ms_per_update']:.1f} ms per update of all {summary['runs']} runs", style="dim")
    if latency := summary.get("latency_ms"):
        times = ", ".join(f"{name} {value:.1f} ms" for name, value in latency.items())
        console.print(f"latency {times}", style="dim")
    console.print(f"look at {folder / 'report.html'}{worst(summary)}", soft_wrap=True, highlight=False)


def worst(summary: dict[str, Any]) -> str:
    """Which segment to look at first, if any failed."""
    parts = [part.get("converged") for part in summary.get("by_segment", [])]
    rates = [1.0 if rate is None or rate != rate else rate for rate in parts]
    if not rates or min(rates) == 1:
        return ""
    number = int(np.argmin(rates)) + 1
    return f"#d={number} (segment {number}: found in {min(rates):.0%} of the runs)"


def _cell(value: Any, text: str) -> str:
    return "-" if value is None or value != value else text.format(value)


if __name__ == "__main__":
    run_cli(main)
