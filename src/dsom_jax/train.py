"""``python -m dsom_jax.train``: train DSOM on procedural buildings or on given maps; resumable."""

from __future__ import annotations

import json
import math
import time
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import yaml
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from dsom_jax import checkpoint
from dsom_jax.cli import parse
from dsom_jax.errors import UserError, run_cli
from dsom_jax.nn import DSOM
from dsom_jax.occupancy import OccupancyGrid, resample
from dsom_jax.run_folder import Run, trim_log
from dsom_jax.training.batches import make_batch, plain
from dsom_jax.training.evaluation import make_evaluation
from dsom_jax.training.loop import (
    TrainConfig,
    TrainState,
    averaged_model,
    init_state,
    make_batches,
    make_step,
    world_source,
)
from dsom_jax.training.memory import keep_freed_memory
from dsom_jax.training.options import override
from dsom_jax.training.sharding import data_mesh, replicate, spread

CALIBRATION_STEPS = 30


@dataclass(frozen=True)
class Arguments:
    """Train DSOM.

    Attributes:
        config: YAML file with fields of TrainConfig that differ from the defaults.
        maps: map.yaml files to train on, with random obstacles, in place of procedural buildings.
        init: checkpoint whose weights to start from.
        minutes: time to train; the number of steps is set after the first few.
        steps: number of steps, in place of minutes.
        out: folder for the checkpoint, the training state and metrics.jsonl.
        resume: continue the run in the folder ``out``, or start it if there is none yet.
        save_minutes: time between checkpoints.
        save_steps: steps between checkpoints, in place of save_minutes.
    """

    config: Path | None = None
    maps: tuple[Path, ...] = ()
    init: Path | None = None
    minutes: float = 40.0
    steps: int | None = None
    out: Path = Path("runs/dsom")
    resume: bool = False
    save_minutes: float = 3.0
    save_steps: int | None = None

    def __post_init__(self) -> None:
        if self.steps is not None and self.steps < 1:
            raise UserError(f"--steps {self.steps}: give at least one step")
        if self.steps is None and not 0 < self.minutes < math.inf:
            raise UserError(f"--minutes {self.minutes}: give a positive time")
        if not self.save_minutes > 0:
            raise UserError(f"--save-minutes {self.save_minutes}: give a positive time")
        if self.save_steps is not None and self.save_steps < 1:
            raise UserError(f"--save-steps {self.save_steps}: give at least one step")


class Material(NamedTuple):
    """What a run reads before it begins: maps at the network's resolution, and the network to start from, if any."""

    grids: list[OccupancyGrid]
    network: DSOM | None


def read_config(path: Path | None) -> TrainConfig:
    """TrainConfig from a YAML file with some of its fields."""
    if path is None:
        return TrainConfig()
    try:
        given = yaml.safe_load(path.read_text()) or {}
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise UserError(f"{path}: cannot read the configuration ({error}); give a YAML file") from error
    return override(TrainConfig(), given, str(path))


def load_maps(paths: tuple[Path, ...], resolution: float) -> list[OccupancyGrid]:
    """Maps at the network's resolution, each with free space."""
    from dsom_jax.data.open_map import load_map

    grids = [resample(load_map(path), resolution) for path in paths]
    for path, grid in zip(paths, grids, strict=True):
        if not bool(grid.free.any()):
            raise UserError(f"{path}: no free cell at {resolution:.3f} m per cell; give a map with free space")
    return grids


def open_run(args: Arguments) -> tuple[Run, Material]:
    """A new run in an empty folder, or the one to resume, and what it is made of."""
    path = args.out / "run.json"
    if args.resume and path.exists():
        run = resume_run(args, path)
        return run, read_material(args, run)
    if args.out.exists() and not args.out.is_dir():
        raise UserError(f"--out {args.out}: is a file; give a folder")
    if not args.resume and args.out.exists() and any(args.out.iterdir()):
        raise UserError(f"{args.out}: not empty; add --resume to continue that run, or give another --out")
    begin = None if args.init is None else args.init.name
    run = Run(args.out, read_config(args.config), tuple(str(p) for p in args.maps), args.steps, init=begin)
    # Before anything is written: a bad map or checkpoint leaves no folder behind.
    material = read_material(args, run)
    try:
        args.out.mkdir(parents=True, exist_ok=True)
        run.write()
    except OSError as error:
        raise UserError(f"{args.out}: cannot write ({error.strerror}); give another --out") from error
    return run, material


def read_material(args: Arguments, run: Run) -> Material:
    """Maps and network; a run that has saved a state no longer needs the network that it began with."""
    network = None if run.states() else load_init(args.init, run.config)
    return Material(load_maps(tuple(map(Path, run.maps)), run.config.model.resolution), network)


def resume_run(args: Arguments, path: Path) -> Run:
    """The run described by run.json."""
    try:
        record = json.loads(path.read_text())
        config = override(TrainConfig(), record["config"], str(path))
        run = Run(args.out, config, tuple(record["maps"]), record["total"], record["seconds"], record.get("init"))
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UserError(f"{path}: no run to resume here ({error}); start without --resume") from error
    if args.maps and tuple(map(str, args.maps)) != run.maps:
        raise UserError(f"--maps: the run in {path} has {', '.join(run.maps) or 'none'}; resume without --maps")
    if args.config is not None and read_config(args.config) != config:
        raise UserError(f"{args.config}: differs from the run in {path}; resume without --config")
    if args.steps is not None and run.total is not None and args.steps != run.total:
        raise UserError(f"--steps {args.steps}: the run in {path} has {run.total}; resume without --steps")
    return run


def first_state(run: Run, network: DSOM | None) -> TrainState:
    """The newest saved state, or a fresh one."""
    if run.states():
        return checkpoint.load_state(run.states()[-1], init_state(run.config))
    return init_state(run.config, network)


def load_init(path: Path | None, config: TrainConfig) -> DSOM | None:
    """The network to start from, if one is named; it must be of the run's configuration."""
    if path is None:
        return None
    model: DSOM = checkpoint.load(path)
    if model.config != config.model:
        pairs = [(f.name, getattr(model.config, f.name), getattr(config.model, f.name)) for f in fields(config.model)]
        unlike = ", ".join(f"{name} = {own!r}, the run's is {wanted!r}" for name, own, wanted in pairs if own != wanted)
        raise UserError(f"{path}: field model: {unlike}; give a --config with the network's own, or another --init")
    return model


def held_out(run: Run, grids: list[OccupancyGrid]) -> Any:
    """Evaluation on full-size buildings that training does not see."""
    scans = plain(run.config.scan)
    source = world_source(replace(run.config, scan=scans), run.config.late, grids)
    key = jax.random.key(2**31 - 1 - run.config.seed)
    batch = jax.jit(lambda k: make_batch(k, source, scans, 12, 8))(key)
    return make_evaluation(batch, scans.lidar)


class Trainer:
    """The Python loop around the jitted step."""

    def __init__(self, args: Arguments, run: Run, material: Material) -> None:
        self.args, self.run = args, run
        self.mesh = data_mesh()
        make = make_batches(run.config, material.grids)
        self.batches = lambda step, total: spread(make(step, total), self.mesh)
        self.step = make_step(run.config)
        self.evaluate = held_out(run, material.grids)
        self.state = replicate(first_state(run, material.network), self.mesh)
        self.saved_at = time.monotonic()
        self.clock = time.monotonic()
        trim_log(run.out / "metrics.jsonl", int(self.state.step))

    def train(self, progress: Progress) -> dict[str, Any]:
        """Steps until the end; returns the last evaluation."""
        first = done = int(self.state.step)
        task = progress.add_task("training", total=self.run.total, completed=done, note="compiling")
        batch = self.batches(done, self.total())
        with (self.run.out / "metrics.jsonl").open("a") as log:
            while done < self.total():
                self.state, metrics = self.step(self.state, batch, jnp.int32(self.total()))
                done += 1
                # The next batch is made while the step runs.
                batch = self.batches(done, self.total())
                values = {name: float(value) for name, value in metrics.items()}
                rate = self.tick(done - first)
                log.write(json.dumps({"step": done, **values, "seconds": round(self.run.seconds, 3)}) + "\n")
                log.flush()
                note = f"loss {values['total']:.3f}  KLD {values['kld']:.3f}  {rate:.0f} samples/s"
                progress.update(task, completed=done, total=self.run.total, note=note)
                if self.due(done):
                    self.save(progress)
        return self.save(progress)

    def total(self) -> int:
        """Steps of the run; far away until calibrated."""
        return self.run.total or 2**30

    def tick(self, count: int) -> float:
        """Account for the time of a step; with ``minutes`` decide on the number of steps. Returns samples/s."""
        now = time.monotonic()
        spent, self.clock = now - self.clock, now
        self.run.seconds += spent
        if self.run.total is None:
            self.calibrate(count, now)
        return self.run.config.early.worlds * self.run.config.early.scans / max(spent, 1e-9)

    def calibrate(self, count: int, now: float) -> None:
        """Number of steps that fit the minutes given, from the steps after compilation."""
        if count == 5:
            self.calibration_start = now
        elif count == 5 + CALIBRATION_STEPS:
            per_step = (now - self.calibration_start) / CALIBRATION_STEPS
            left = 60 * self.args.minutes * 0.95 - self.run.seconds
            self.run.total = max(count + int(left / per_step), count + 1)
            self.run.write()

    def due(self, done: int) -> bool:
        """Whether to save now."""
        if self.args.save_steps is not None:
            return done % self.args.save_steps == 0
        return time.monotonic() - self.saved_at > 60 * self.args.save_minutes

    def save(self, progress: Progress) -> dict[str, Any]:
        """Evaluate and save; the time it takes is not training time of a step but counts for the run."""
        scores = self.evaluate(averaged_model(self.run.config, self.state))
        self.run.save(self.state, scores)
        progress.console.print(f"step {int(self.state.step)}: " + json.dumps(scores))
        self.saved_at = time.monotonic()
        return scores


def main() -> None:
    """Entry point."""
    args = parse(Arguments, "python -m dsom_jax.train")
    keep_freed_memory()
    run, material = open_run(args)
    columns = (TextColumn("{task.completed} / {task.total}"), BarColumn(), TextColumn("{task.fields[note]}"))
    with Progress(*columns, TimeElapsedColumn(), TimeRemainingColumn()) as progress:
        Trainer(args, run, material).train(progress)


if __name__ == "__main__":
    run_cli(main)
