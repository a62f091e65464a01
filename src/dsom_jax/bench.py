"""``python -m dsom_jax.bench``: every method on every sequence of a suite, 100 times, in one table per phase."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from dsom_jax import plotting, report
from dsom_jax.cli import Advance, parse, progress_bar
from dsom_jax.data.suite import Suite, load_suite
from dsom_jax.episode import Episode
from dsom_jax.errors import UserError, run_cli
from dsom_jax.filters.methods import METHODS, STANDARD, build_filter, network_of
from dsom_jax.filters.settings import WEIGHT_POWER
from dsom_jax.judging import metrics
from dsom_jax.judging.by_drive import Judged, Worst, by_drive, judge_drives, worst_run
from dsom_jax.judging.foreign import drives_of, named, replies_of_suite
from dsom_jax.judging.run_table import RunTable, join, run_rows, write_runs
from dsom_jax.judging.scores import judge_drive, judged_by, replies
from dsom_jax.montecarlo import Result, run, run_keys, signature
from dsom_jax.occupancy import OccupancyGrid
from dsom_jax.protocol.digests import digests
from dsom_jax.trained import by_kind, check_networks, check_used, find_networks, load_networks
from dsom_jax.types import Filter, Key, Proposal
from dsom_jax.view.benched import write_benchmark

ESTIMATES = ("mean", "cluster")
"""The weighted mean of the paper, and the mean of the heaviest cluster."""
PER_EPISODE = ("mixture_mcl_star", "mixture_mcl_sharp_star")
"""Methods whose filter knows the episode, not only the map."""


@dataclass(frozen=True)
class BenchArgs:
    """Compare localization methods on a suite of drives, each with one kidnapping."""

    runs: int = 100
    """Monte-Carlo runs of each method on each sequence."""
    suite: str = "synthetic-v1"
    """Name of a suite, or a TOML file that describes one."""
    methods: str = ""
    """Comma-separated method names; default: the ten of the standard comparison, without those that need a network
    where none is shipped."""
    particles: int = 200
    """Particles per run."""
    t_cut: float = 0.6
    """T_cut of Alg 1: particles with a higher trust always keep their history."""
    seed: int = 0
    """Seed of all randomness; method, sequence and run number do the rest."""
    weight_power: float = WEIGHT_POWER
    """Power of Eq 15 in the `_sharp` methods; the others weigh as the paper prints, by Eq 15 itself."""
    out: Path | None = None
    """Folder for bench.json, bench.md, report.html and figures."""
    checkpoint: Path | None = None
    """Folder of a trained DSOM; default: the one in the repository."""
    per_run: bool = False
    """Write runs.npz, too: steps, final errors and retention of every single run, for paired comparisons."""
    pf_net: Path | None = None
    """Folder of a trained PF-Net; default: the one in the repository."""
    pfrnn: Path | None = None
    """Folder of a trained PFRNN; default: the one in the repository."""
    external: tuple[str, ...] = ()
    """NAME=DIR: another localizer's TUM trajectories of the exported suite, DIR/sequence-1.tum and so on."""


@dataclass(frozen=True)
class BenchSettings:
    """What all methods have in common; see :class:`BenchArgs`."""

    runs: int = 100
    particles: int = 200
    t_cut: float = 0.6
    seed: int = 0
    weight_power: float = WEIGHT_POWER

    def __post_init__(self) -> None:
        for name, value in (("--runs", self.runs), ("--particles", self.particles)):
            if not 1 <= value <= 1_000_000:
                raise UserError(f"{name} {value}: give at least 1 and at most 1000000")
        if not 0 < self.t_cut < 1:
            raise UserError(f"--t-cut {self.t_cut}: give a number between 0 and 1 (the paper uses 0.6)")
        if not 0 <= self.seed < 2**32:
            raise UserError(f"--seed {self.seed}: give 0 or more, and less than 2^32")
        if not 0 < self.weight_power <= 1000:
            raise UserError(f"--weight-power {self.weight_power:g}: give more than 0, at most 1000 (1: as printed)")


class Record(NamedTuple):
    """What one method did.

    Attributes:
        runs: by estimate (``mean``, ``cluster``) and phase.
        traces: E_pos (R, T) of each sequence, metres, by the estimate that the method is judged by.
        worst: run of each sequence, likewise; the poses of the others are not kept.
        ms_per_step: milliseconds of one update of all runs.
        compilations: how many shapes of map and episode had to be compiled.
        table: every single run, by the estimate that the method is judged by.
        filter, result: those of the first sequence, for pictures.
    """

    runs: dict[str, dict[str, metrics.Runs]]
    traces: list[np.ndarray]
    worst: list[Worst]
    ms_per_step: float
    compilations: int
    table: RunTable
    filter: Filter
    result: Result


Build = Callable[[str, str, OccupancyGrid, Episode], Filter]


def collect(
    suite: Suite,
    methods: Sequence[str],
    settings: BenchSettings,
    progress: Advance | None = None,
    checkpoint: Any = None,
) -> dict[str, Record]:
    """Run every method on every sequence; run r of a sequence has the same key for all methods.

    ``checkpoint`` is a DSOM, or a mapping of networks by kind (``dsom``, ``pf_net``, ``pfrnn``).
    """
    trained = by_kind(checkpoint)
    check_methods(methods, trained)

    sources: dict[str, dict[str, Proposal]] = {where: {} for where, _, _ in suite.episodes}

    def build(name: str, where: str, grid: OccupancyGrid, episode: Episode) -> Filter:
        own: dict[str, Any] = {name: getattr(settings, name) for name in ("particles", "t_cut", "weight_power")}
        network = trained.get(network_of(name) or "")
        filter = build_filter(
            name, grid, suite.lidar, **own, episode=episode, checkpoint=network, sources=sources[where]
        )
        return jax.block_until_ready(filter)

    keys = [run_keys(settings.seed, number, settings.runs) for number in range(len(suite.episodes))]
    return {name: run_method(name, suite, keys, build, progress) for name in methods}


def check_methods(methods: Sequence[str], checkpoint: Any = None) -> None:
    """UserError for names that are none, and for methods that lack their network."""
    unknown = [name for name in methods if name not in METHODS]
    if unknown or not methods:
        raise UserError(f"--methods: unknown {', '.join(unknown) or '(none)'}; choose from {', '.join(METHODS)}")
    check_networks(methods, by_kind(checkpoint))


def chosen_methods(names: str, checkpoint: Any) -> tuple[str, ...]:
    """The methods of a comma-separated list; an empty one means the standard ones that can be run."""
    methods = tuple(dict.fromkeys(name.strip() for name in names.split(",") if name.strip()))
    methods = methods or tuple(name for name in STANDARD if network_of(name) is None or by_kind(checkpoint).get("dsom"))
    check_methods(methods, checkpoint)
    return methods


def left_out(methods: Sequence[str]) -> str:
    """One line about methods of the standard comparison that are not among ``methods``, and why; empty if all are."""
    missing = [name for name in STANDARD if name not in methods]
    return f"left out: {', '.join(missing)}: no trained network here; name its folder with --checkpoint" * bool(missing)


def run_method(name: str, suite: Suite, keys: Sequence[Key], build: Build, progress: Advance | None = None) -> Record:
    """One method on all sequences."""
    parts: dict[str, dict[str, list[metrics.Runs]]] = {e: {"global": [], "kidnap": []} for e in ESTIMATES}
    traces, worst, rows, clock = [], [], [], Clock()
    first: tuple[Any, ...] = ()
    filters: dict[Any, Filter] = {}
    for number, (where, grid, episode) in enumerate(suite.episodes):
        if progress:
            progress(name, number)
        known = number if name in PER_EPISODE else where
        filter = filters[known] = filters.get(known) or build(name, where, grid, episode)
        result = clock.run(filter, episode, keys[number])
        for estimate, by_phase in parts.items():
            for phase, runs in judge_drive(replies(result.info, estimate), episode, number).items():
                by_phase[phase] += runs
                if estimate == judged_by(name):
                    rows += [run_rows(name, phase, number, part, some) for part, some in enumerate(runs)]
        said = getattr(result.info, judged_by(name))
        errors = metrics.pose_error(said, episode.poses)
        traces.append(np.asarray(errors[0]))
        worst.append(worst_run(said, *errors))
        first = first or (filter, result)
    pooled = {e: {phase: metrics.pool(runs) for phase, runs in by.items()} for e, by in parts.items()}
    return Record(pooled, traces, worst, clock.ms_per_step(), len(clock.compiled), join(rows), *first)


class Clock:
    """Times runs, leaving out those that had to be compiled first."""

    def __init__(self) -> None:
        self.compiled: set[Any] = set()
        self.seconds: list[float] = []
        self.last: tuple[Filter, Episode, Key] | None = None

    def run(self, filter: Filter, episode: Episode, keys: Key) -> Result:
        """As :func:`montecarlo.run`, finished on return."""
        start = time.perf_counter()
        result = jax.block_until_ready(run(filter, episode, keys, picture_updates(episode)))
        elapsed = (time.perf_counter() - start) / episode.ranges.shape[0]
        shape = (signature(filter, episode), keys.shape)
        if shape in self.compiled:
            self.seconds.append(elapsed)
        self.compiled.add(shape)
        self.last = filter, episode, keys
        return result

    def ms_per_step(self) -> float:
        """Median milliseconds of one update of all runs together, compilation excluded."""
        if not self.seconds and self.last:
            self.run(*self.last)
        return 1e3 * float(np.median(self.seconds))


def picture_updates(episode: Episode) -> tuple[int, ...]:
    """Four updates worth a picture: the start, soon after, the first kidnapping (or half way), soon after."""
    moved = np.flatnonzero(np.asarray(episode.kidnapped)[1:]) + 1
    last = len(episode.ranges) - 1
    middle = int(moved[0]) if len(moved) else last // 2
    return 0, min(5, last), middle, min(middle + 5, last)


def summary(suite: Suite, records: dict[str, Record], settings: BenchSettings) -> dict[str, Any]:
    """``bench.json``: see :mod:`dsom_jax.report`."""
    methods = {}
    for name, record in records.items():
        tables = {
            estimate: {phase: metrics.summarize(runs, settings.seed) for phase, runs in by_phase.items()}
            for estimate, by_phase in record.runs.items()
        }
        chosen = judged_by(name)
        facts = {"ms_per_step": record.ms_per_step, "compilations": record.compilations, "estimate": chosen}
        methods[name] = tables[chosen] | facts | {"estimates": tables}
    device = f"{jax.device_count()} x {jax.devices()[0].device_kind} ({jax.default_backend()})"
    return {"suite": suite.name, **asdict(settings), "device": device, "sequences": len(suite.episodes),
            "methods": methods}  # fmt: skip


def foreign(judged: Judged, seed: int) -> dict[str, Any]:
    """The entry of another localizer; what it took for an update it alone knows."""
    tables = {phase: metrics.summarize(runs, seed) for phase, runs in judged.runs.items()}
    facts = {"ms_per_step": None, "compilations": 0, "estimate": "trajectory"}
    return tables | facts | {"estimates": {"trajectory": tables}}


def write_results(
    folder: Path, suite: Suite, records: dict[str, Record], judged: dict[str, Judged], data: dict[str, Any]
) -> None:
    """Write bench.json, bench.md, report.html and the figures."""
    report.write_json(folder / "bench.json", data)
    report.write_text(folder / "bench.md", report.markdown(data))
    write_benchmark(folder / "report.html", suite, data, {name: found.worst for name, found in judged.items()})
    runs = {name: record.runs[judged_by(name)] for name, record in records.items()}
    traces = [{name: record.traces[n] for name, record in records.items()} for n in range(len(suite.episodes))]
    moved = [np.asarray(episode.kidnapped) for _, _, episode in suite.episodes]
    figures = plotting.benchmark_figures(runs, traces, moved)
    _, grid, episode = suite.episodes[0]
    for name, record in records.items():
        estimates = getattr(record.result.info, judged_by(name))[0]
        figures[f"map_{name}"] = plotting.moment_figure(
            grid, suite.lidar, episode, record.filter, picture_updates(episode), record.result.kept.poses, estimates
        )
    for name, figure in figures.items():
        plotting.save_figure(figure, folder / f"{name}.png")


def main() -> None:
    """Argument handling."""
    args = parse(BenchArgs, "python -m dsom_jax.bench")
    if args.per_run and not args.out:
        raise UserError("--per-run: give --out, the folder for runs.npz")
    settings = BenchSettings(args.runs, args.particles, args.t_cut, args.seed, args.weight_power)
    asked = {"dsom": args.checkpoint, "pf_net": args.pf_net, "pfrnn": args.pfrnn}
    folders = find_networks(asked)
    methods = chosen_methods(args.methods, folders)
    missing = "" if args.methods else left_out(methods)
    check_used(asked, methods)
    suite = load_suite(args.suite)
    trained = load_networks(folders, methods, suite.lidar)
    drives = drives_of(suite)
    others = {name: replies_of_suite(where, drives) for name, where in named(args.external, "DIR").items()}
    folder = report.output_folder(args.out) if args.out else None
    bar, advance = progress_bar(len(methods) * len(suite.episodes))
    with bar:
        records = collect(suite, methods, settings, advance, trained)
    judged = {name: Judged(record.runs[judged_by(name)], record.worst) for name, record in records.items()}
    judged |= {name: judge_drives([drive.episode for drive in drives], given) for name, given in others.items()}
    data = summary(suite, records, settings) | {"digests": digests(suite, {kind: folders[kind] for kind in trained})}
    data["methods"] |= {name: foreign(judged[name], args.seed) for name in others}
    for name, found in judged.items():
        data["methods"][name]["by_drive"] = by_drive(found)
    report.print_tables(data)
    if missing:
        print(missing)
    if folder:
        write_results(folder, suite, records, judged, data)
        report.terminal().print(f"look at {folder / 'report.html'}", soft_wrap=True, highlight=False)
    if folder and args.per_run:
        write_runs(folder / "runs.npz", join([record.table for record in records.values()]))


if __name__ == "__main__":
    run_cli(main)
