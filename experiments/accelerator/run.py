"""All that a GPU is to be asked, in one go: ``python experiments/accelerator/run.py --minutes 9 --out OUT``.

1. the time of one update of filters with 100, 1,000 and 10,000 runs, 2. the exact likelihood of one scan over a
building of 150 m x 100 m, 3. the speed of training, and 4. with all the time that is left, the paper's own network
(width 64, its encoders, its last layer): first after the shipped network's similarity, then with Eq 5. ``OUT`` has
``gpu.json``, which grows as results come in, ``curve.json``, and ``dsom-paper``, a checkpoint in half precision;
whoever stops the script keeps them.

Needs no network, no data and no git. ``--small`` asks the same of a CPU: fewer runs, a smaller building, width 16.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from dsom_jax import checkpoint, montecarlo
from dsom_jax.cli import parse
from dsom_jax.compiling import run_options
from dsom_jax.data.suite import load_suite
from dsom_jax.errors import UserError, run_cli
from dsom_jax.filters.methods import build_filter
from dsom_jax.filters.settings import Settings
from dsom_jax.judging.quality import make_evaluation
from dsom_jax.lidar import LidarConfig
from dsom_jax.nn import DSOMConfig
from dsom_jax.occupancy import OccupancyGrid, from_cells
from dsom_jax.proposals.likelihood_grid import LikelihoodGrid, likelihood_grid
from dsom_jax.simulate.worlds import WorldConfig, make_world
from dsom_jax.training.batches import ScanConfig, make_batch, plain_scans
from dsom_jax.training.loop import (
    StageConfig,
    TrainConfig,
    averaged_model,
    init_state,
    make_batches,
    make_step,
    world_source,
)
from dsom_jax.training.memory import keep_freed_memory
from dsom_jax.types import Inputs

sys.path[:0] = [str(Path(__file__).parents[1] / name) for name in ("perf", "dsom")]
import distil  # noqa: E402
from timing import machine, measure  # noqa: E402

FULL_TURN = {"limited": 0.0, "thinning": 1, "fov_min": 2 * np.pi, "reach_min": 10.0, "deep": 0.0, "bare": 0.1}
PAPER = TrainConfig(
    model=DSOMConfig(width=64, encoder="paper", scan_size=128, paper_head=True),
    scan=ScanConfig(**FULL_TURN, sigma=0.03, dropout=0.01, short=0.02),  # type: ignore[arg-type]
    ema=0.99,
    warmup=50,
)
"""The network of the paper's Table III for full turns of 10 m, and the scans that it learns from."""
RESERVE = 0.12
"""Share of the time that is kept for the last evaluation, and for what takes longer than it did before."""
SHARES = {"step": 0.2, "likelihood_grid": 0.3, "training": 0.45}
"""Shares of the time after which a measurement starts nothing new."""


@dataclass(frozen=True)
class Sizes:
    """How much is measured.

    Attributes:
        runs: Monte-Carlo runs at a time.
        updates: of the drive that is timed.
        building: metres, x and y.
        cell: metres per cell of its map.
        batches: (buildings, scans in each) of the training steps that are timed.
        train: the batch that is trained with; its size is one of ``batches``.
        width: of the network.
        held_out: buildings and scans of the evaluation, and cells along a side.
    """

    runs: tuple[int, ...] = (100, 1000, 10000)
    updates: int = 20
    building: tuple[float, float] = (150.0, 100.0)
    cell: float = 0.1
    batches: tuple[tuple[int, int], ...] = ((4, 16), (8, 32), (16, 32))
    train: StageConfig = StageConfig(64, 8, 32)
    held_out: StageConfig = StageConfig(128, 12, 8)
    width: int = 64


SMALL = Sizes((5, 20), 4, (30.0, 20.0), 0.1, ((1, 4),), StageConfig(64, 1, 4), StageConfig(64, 4, 4), 16)


@dataclass(frozen=True)
class Arguments:
    """Measure an accelerator and train the paper's network on it.

    Attributes:
        out: folder for gpu.json and the checkpoint.
        minutes: for everything together.
        small: sizes for a CPU.
        teacher: checkpoint whose similarity the encoders follow at first; the shipped network.
        init: checkpoint of an earlier run of this script to go on from, without a teacher.
        seed: of weights and data.
    """

    out: Path
    minutes: float = 9.0
    small: bool = False
    teacher: Path = checkpoint.SHIPPED
    init: Path | None = None
    seed: int = 0

    def __post_init__(self) -> None:
        if not 0 < self.minutes < 24 * 60:
            raise UserError(f"--minutes {self.minutes}: give a positive number of minutes")


class Record:
    """``gpu.json`` and the clock: what is known is on disk at any moment."""

    def __init__(self, path: Path, minutes: float, facts: dict[str, Any]) -> None:
        self.path, self.start, self.seconds = path, time.monotonic(), 60 * minutes
        self.facts = facts

    def spent(self) -> float:
        """Seconds since the start."""
        return time.monotonic() - self.start

    def over(self, share: float) -> bool:
        """Whether that share of the time is gone."""
        return self.spent() > share * self.seconds

    def note(self, part: str, name: str, value: Any) -> None:
        """Say and write one result."""
        self.facts.setdefault(part, {})[name] = value
        self.facts["seconds"] = round(self.spent(), 1)
        print(f"[{self.spent():5.0f} s] {part} {name}: {json.dumps(value)}", flush=True)
        checkpoint.write_record(self.path, self.facts)

    def each(self, part: str, calls: dict[str, Callable[[], Any]]) -> None:
        """Results of ``calls`` by name, as many as the part's share allows; one that fails is noted and passed over."""
        for name, call in calls.items():
            if self.over(SHARES[part]):
                self.note(part, name, "not measured, out of time")
                continue
            try:
                began = self.spent()
                value = call()
                self.note(part, name, value | {"with_compilation_s": round(self.spent() - began, 1)})
            except (RuntimeError, MemoryError) as error:  # XLA's errors, memory above all: the rest is still wanted
                self.note(part, name, f"failed: {str(error).splitlines()[0][:200]}")


def step_times(method: str, runs: int, updates: int) -> dict[str, float]:
    """Milliseconds of one update of all runs together, the reading of the scan included."""
    suite = load_suite("synthetic-v1")
    _, grid, episode = suite.episodes[0]
    filter = build_filter(method, grid, suite.lidar, particles=200, t_cut=0.6)
    drive = jax.tree.map(lambda leaf: leaf[:updates], episode)
    keys = montecarlo.run_keys(0, 0, runs)
    times = measure(lambda: montecarlo.run(filter, drive, keys).info, 3)
    return {
        "ms_per_update": times["wall_ms"] / updates,
        "poses_per_s": 1e3 * runs * 200 * updates / times["wall_ms"],
        "updates": updates,
    }


def building(size: tuple[float, float], cell: float) -> OccupancyGrid:
    """Procedural buildings side by side, cut to ``size`` metres."""
    side = 512 if min(size) > 50 else 192
    rows, cols = (-(-round(length / cell) // side) for length in (size[1], size[0]))
    make = jax.jit(lambda key: make_world(key, WorldConfig(cells=side, resolution=cell)))
    worlds = [make(jax.random.key(number)) for number in range(rows * cols)]

    def joined(layer: str) -> np.ndarray:
        parts = [np.asarray(getattr(world, layer)) for world in worlds]
        whole = np.block([parts[row * cols : (row + 1) * cols] for row in range(rows)])
        return whole[: round(size[1] / cell), : round(size[0] / cell)]

    return from_cells(jnp.asarray(joined("occupied")), jnp.asarray(joined("free")), resolution=cell)


def grid_times(sizes: Sizes) -> dict[str, Any]:
    """Time to prepare a building, and of the exact likelihood of one scan at every pose in it."""
    grid, lidar = building(sizes.building, sizes.cell), LidarConfig(range_max=10.0)
    began = time.monotonic()
    proposal = jax.block_until_ready(likelihood_grid(grid, lidar, Settings().grid))
    built = time.monotonic() - began
    ranges = jax.random.uniform(jax.random.key(1), (lidar.beams,), minval=0.5, maxval=9.0)
    scan = jax.jit(LikelihoodGrid.prepare, compiler_options=run_options())
    times = measure(lambda: scan(proposal, Inputs(ranges, jnp.zeros(3), jnp.int32(0))).mass, 5)
    poses = int(proposal.cells.size) * proposal.config.headings
    facts = {"building_m": list(sizes.building), "poses": poses, "table_MB": proposal.expected.nbytes / 1e6}
    return facts | {"build_s": built, "ms_per_scan": times["wall_ms"], "poses_per_s": 1e3 * poses / times["wall_ms"]}


@cache
def eq_5(config: TrainConfig) -> Callable[..., Any]:
    """The training step; the one that was timed is trained with, without another compilation."""
    return make_step(config)


def training_times(config: TrainConfig) -> dict[str, float]:
    """Samples per second of the training step and of making its batch."""
    batches, step, state = make_batches(config), eq_5(config), init_state(config)
    batch, total = batches(0, 1000), jnp.int32(1000)

    def one() -> Any:
        nonlocal state
        state, metrics = step(state, batch, total)
        return metrics

    stepped, made = measure(one, 5), measure(lambda: batches(1, 1000), 5)
    samples = config.early.worlds * config.early.scans
    rates = {"samples_per_s": 1e3 * samples / stepped["wall_ms"], "samples": samples}
    return rates | {"ms_per_step": stepped["wall_ms"], "ms_per_batch": made["wall_ms"]}


def with_batch(config: TrainConfig, worlds: int, scans: int) -> TrainConfig:
    """The same training with batches of that size only."""
    return replace(config, early=StageConfig(config.early.cells, worlds, scans), late_share=0.0)


def held_out(config: TrainConfig, stage: StageConfig) -> Callable[[Any], dict[str, float]]:
    """Evaluation on buildings that training does not see."""
    scans = plain_scans(config.scan)
    source = world_source(replace(config, scan=scans), stage)
    make = jax.jit(lambda key: make_batch(key, source, scans, stage.worlds, stage.scans, config.model))
    return make_evaluation(make(jax.random.key(2**31 - 1 - config.seed)), scans.lidar)


class Training:
    """The paper's network for the rest of the time."""

    def __init__(self, args: Arguments, config: TrainConfig, sizes: Sizes, record: Record) -> None:
        self.args, self.config, self.record = args, config, record
        self.evaluate = held_out(config, sizes.held_out)
        network = None if args.init is None else checkpoint.load(args.init)
        self.state, self.batches = init_state(config, network), make_batches(config)
        self.curve: list[dict[str, Any]] = []
        self.done = 0

    def run(self) -> None:
        """Both phases; the first one only for a network that begins here."""
        if self.args.init is None:
            teacher = checkpoint.load(self.args.teacher, resolution=self.config.model.resolution)
            follow = make_step(self.config, partial(distil.losses, teacher=teacher))
            self.phase("encoders", follow, self.record.spent() + 0.35 * self.left())
            # Adam's moments, the schedule and the average begin anew with the other loss.
            fresh = init_state(self.config)
            average = jax.tree.map(jnp.copy, (self.state.params, self.state.stats))
            self.state = fresh._replace(params=self.state.params, stats=self.state.stats, average=average)
        self.phase("eq_5", eq_5(self.config), self.record.spent() + self.left())

    def left(self) -> float:
        """Seconds to train."""
        return max((1 - RESERVE) * self.record.seconds - self.record.spent(), 1.0)

    def phase(self, name: str, step: Callable[..., Any], end: float) -> None:
        """Steps until ``end``; their number, which the schedule needs, is counted on the way, from the tenth on."""
        first, total, began, saved = int(self.state.step), 2**30, 0.0, self.record.spent()
        while self.record.spent() < end and int(self.state.step) < total:
            number = int(self.state.step) - first
            batch = self.batches(self.done, total)
            self.state, metrics = step(self.state, batch, jnp.int32(total))
            values = {key: float(value) for key, value in metrics.items()}
            self.done += 1
            if number == 4:
                began = self.record.spent()
            elif number == 9:
                left = (end - self.record.spent()) / max((self.record.spent() - began) / 5, 1e-9)
                total = first + 10 + max(int(left), 1)
            if number % max(total // 200, 1) == 0 or number < 10:
                where = {"phase": name, "step": self.done, "seconds": round(self.record.spent(), 1)}
                self.curve.append(where | values)
            if self.record.spent() - saved > 0.1 * self.record.seconds:
                self.save(name)
                saved = self.record.spent()
        self.save(name)

    def save(self, phase: str) -> None:
        """Evaluation, checkpoint and curve."""
        model = averaged_model(self.config, self.state)
        scores = self.evaluate(model)
        samples = self.done * self.config.early.worlds * self.config.early.scans
        init = self.args.init and self.args.init.name
        facts: dict[str, Any] = {"seed": self.config.seed, "init": init, "steps": self.done}
        facts |= {"samples": samples, "seconds": round(self.record.spent(), 1), "metrics": scores}
        data = {"data": "procedural buildings, dsom_jax.simulate.make_world", "train": asdict(self.config)}
        folder = self.record.path.with_name("dsom-paper")
        checkpoint.save(folder, model, facts | data, tag=f"weights-{self.done:08d}", half=True)
        checkpoint.write_record(folder.parent / "curve.json", self.curve)
        self.record.note("network", f"{phase}, step {self.done}", {"samples": samples, **scores})


def main() -> None:
    """Entry point."""
    args = parse(Arguments, "python experiments/accelerator/run.py")
    args.out.mkdir(parents=True, exist_ok=True)
    keep_freed_memory()
    sizes = SMALL if args.small else Sizes()
    facts = {"machine": machine(), "small": args.small, "minutes": args.minutes}
    record = Record(args.out / "gpu.json", args.minutes, facts)
    record.each(
        "step",
        {
            f"{method}, {runs} runs": partial(step_times, method, runs, sizes.updates)
            for runs in sizes.runs
            for method in ("mcl", "robust_likelihood_grid")
        },
    )
    record.each("likelihood_grid", {"one scan": partial(grid_times, sizes)})
    config = replace(PAPER, model=replace(PAPER.model, width=sizes.width), seed=args.seed)
    record.each(
        "training",
        {f"{n} x {s} scans": partial(training_times, with_batch(config, n, s)) for n, s in sizes.batches},
    )
    Training(args, with_batch(config, sizes.train.worlds, sizes.train.scans), sizes, record).run()
    record.note("machine", "ended_after_s", round(record.spent(), 1))


if __name__ == "__main__":
    run_cli(main)
