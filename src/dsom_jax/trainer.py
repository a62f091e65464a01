"""A training run from its folder to its end: what it begins with, and the loop around its jitted step."""

from __future__ import annotations

import json
import math
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import jax.numpy as jnp
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from dsom_jax import checkpoint
from dsom_jax.atomic import write_atomic
from dsom_jax.errors import UserError
from dsom_jax.occupancy import OccupancyGrid
from dsom_jax.run_folder import OWNER, RUN, FilterRun, Run, check_new, create_run, read_fields
from dsom_jax.run_resume import check_init, load_init, reopen, trim_log

CALIBRATION_STEPS = 30


class Material(NamedTuple):
    """What a run reads before it begins: maps at the network's resolution, and the network to start from, if any."""

    grids: list[OccupancyGrid]
    network: Any


class Options(Protocol):
    """The arguments of a training command, and what only they know of its network."""

    @property
    def config(self) -> Path | None: ...
    @property
    def maps(self) -> tuple[Path, ...]: ...
    @property
    def init(self) -> Path | None: ...
    @property
    def minutes(self) -> float: ...
    @property
    def steps(self) -> int | None: ...
    @property
    def resume(self) -> bool: ...
    @property
    def save_minutes(self) -> float: ...
    @property
    def save_steps(self) -> int | None: ...
    @property
    def folder(self) -> Path: ...
    @property
    def kind(self) -> str: ...
    def read_config(self, given: Any, where: str) -> Any: ...
    def read_maps(self, run: Run) -> list[OccupancyGrid]: ...


class Parts(NamedTuple):
    """What differs between networks.

    Attributes:
        batches: (step, total) -> batch, a function of seed and step alone.
        step: (state, batch, total) -> (state, metrics), jitted.
        evaluate: network -> numbers for the log and the provenance.
        state: before the first step of this process, ``state.step`` says which.
        shown: metric that is shown beside the total loss, and its name.
    """

    batches: Callable[[int, int], Any]
    step: Callable[..., Any]
    evaluate: Callable[[Any], dict[str, Any]]
    state: Any
    shown: tuple[str, str]


def check_length(options: Options) -> None:
    """UserError for a run of no length, or one that would never be saved."""
    if options.steps is not None and options.steps < 1:
        raise UserError(f"--steps {options.steps}: give at least one step")
    if options.steps is None and not 0 < options.minutes < math.inf:
        raise UserError(f"--minutes {options.minutes}: give a positive time")
    if not options.save_minutes > 0:
        raise UserError(f"--save-minutes {options.save_minutes}: give a positive time")
    if options.save_steps is not None and options.save_steps < 1:
        raise UserError(f"--save-steps {options.save_steps}: give at least one step")


def open_run(args: Options) -> tuple[Run, Material]:
    """A new run in an empty folder, or the one to resume, and what it is made of.

    UserError for a run to resume of another network or configuration.
    """
    path, kind = args.folder / RUN, Run if args.kind == "dsom" else FilterRun
    if args.resume and path.exists():
        run = reopen(kind, path, lambda given: args.read_config(given, str(path)), args.maps, args.steps)
        if args.config is not None and args.read_config(read_fields(args.config), str(args.config)) != run.config:
            raise UserError(f"{args.config}: differs from the run in {path}; resume without --config")
        check_init(args.init, run, path)
        return run, read_material(args, run)
    check_new(args.folder)
    config = args.read_config(read_fields(args.config), str(args.config))
    begin = None if args.init is None else args.init.name
    run = kind(args.folder, config, tuple(map(str, args.maps)), args.steps, init=begin)
    run.check(args.config)
    # Before anything is written: a bad map or checkpoint leaves no folder behind.
    material = read_material(args, run)
    create_run(run)
    return run, material


def read_material(args: Options, run: Run) -> Material:
    """Maps and network; a run that has saved a state no longer needs the network that it began with."""
    network = None if run.states() else load_init(args.init, run.config.model, args.kind)
    return Material(args.read_maps(run), network)


def first_state(run: Run, fresh: Any) -> Any:
    """The newest saved state, or the ``fresh`` one."""
    saved = run.newest(lambda path: checkpoint.load_state(path, fresh))
    return fresh if saved is None else saved


def train(options: Options, run: Run, make: Callable[[], Parts]) -> dict[str, Any]:
    """Steps until the end with a progress bar; returns the last evaluation."""
    columns = (TextColumn("{task.completed} / {task.total}"), BarColumn(), TextColumn("{task.fields[note]}"))
    with Progress(*columns, TimeElapsedColumn(), TimeRemainingColumn()) as progress:
        return Trainer(options, run, make()).train(progress)


class Trainer:
    """The Python loop around the jitted step."""

    def __init__(self, options: Options, run: Run, parts: Parts) -> None:
        self.options, self.run, self.parts = options, run, parts
        self.state, self.first = parts.state, int(parts.state.step)
        self.saved_at = time.monotonic()
        self.clock = time.monotonic()
        run.hold()
        self.lines = trim_log(log_path(run), self.first)

    def train(self, progress: Progress) -> dict[str, Any]:
        """Steps until the end; returns the last evaluation. Ctrl-C or SIGTERM end it after the step under way."""
        done = self.first
        task = progress.add_task("training", total=self.run.total, completed=done, note="compiling")
        batch = self.parts.batches(done, self.total())
        with noted_signals() as signals:
            while done < self.total() and not signals:
                self.state, metrics = self.parts.step(self.state, batch, jnp.int32(self.total()))
                done += 1
                # The next batch is made while the step runs.
                batch = self.parts.batches(done, self.total())
                values = {name: float(value) for name, value in metrics.items()}
                spent = self.tick(done)
                self.log({"step": done, **values, "seconds": round(self.run.seconds, 3)})
                progress.update(task, completed=done, total=self.run.total, note=self.note(values, done, spent))
                if self.due(done) and done < self.total():
                    self.save(progress)
            if signals and done == self.first:
                raise SystemExit(128 + signals[0])
            scores = self.save(progress)
        if signals and done < self.total():
            progress.console.print(f"stopped after step {done}, which is saved; --resume goes on", highlight=False)
            raise SystemExit(128 + signals[0])
        return scores

    def log(self, record: dict[str, Any]) -> None:
        """One line more in metrics.jsonl."""
        self.lines.append(json.dumps(record))
        path = log_path(self.run)
        try:
            if (path.parent / OWNER).exists():  # else it was removed, and :meth:`save` makes it again
                with path.open("a") as file:
                    file.write(self.lines[-1] + "\n")
        except OSError as error:
            saved = ", ".join(path.name for path in self.run.states()) or "no state"
            raise UserError(
                f"{path}: cannot be written ({error.strerror}); {saved} and all before it is intact; "
                "free some space and go on with --resume"
            ) from error

    def note(self, values: dict[str, float], done: int, spent: float) -> str:
        """Losses and speed, for the progress bar."""
        metric, name = self.parts.shown
        rate = (self.run.samples(done) - self.run.samples(done - 1)) / max(spent, 1e-9)
        return f"loss {values['total']:.3f}  {name} {values[metric]:.3f}  {rate:.0f} samples/s"

    def total(self) -> int:
        """Steps of the run; far away until calibrated."""
        return self.run.total or 2**30

    def tick(self, done: int) -> float:
        """Account for the time of step ``done``, and return it; with ``minutes`` decide on the number of steps."""
        now = time.monotonic()
        spent, self.clock = now - self.clock, now
        self.run.seconds += spent
        if self.run.total is None:
            self.calibrate(done, now)
        return spent

    def calibrate(self, done: int, now: float) -> None:
        """Number of steps that fit the minutes given, from the steps of this process after compilation."""
        count = done - self.first
        if count == 5:
            self.calibration_start = now
        elif count == 5 + CALIBRATION_STEPS:
            per_step = (now - self.calibration_start) / CALIBRATION_STEPS
            left = 60 * self.options.minutes * 0.95 - self.run.seconds
            self.run.total = max(done + int(left / per_step), done + 1)
            self.run.write()

    def due(self, done: int) -> bool:
        """Whether to save now."""
        if self.options.save_steps is not None:
            return done % self.options.save_steps == 0
        return time.monotonic() - self.saved_at > 60 * self.options.save_minutes

    def save(self, progress: Progress) -> dict[str, Any]:
        """Evaluate and save; the time it takes is not training time of a step but counts for the run."""
        scores = self.parts.evaluate(self.run.model(self.state))
        self.run.save(self.state, scores)
        if not log_path(self.run).exists():  # with its folder, while training went on
            write_atomic(log_path(self.run), "".join(line + "\n" for line in self.lines).encode())
        progress.console.print(f"step {int(self.state.step)}: " + json.dumps(scores))
        self.saved_at = time.monotonic()
        return scores


@contextmanager
def noted_signals() -> Iterator[list[int]]:
    """A list that the first Ctrl-C or SIGTERM is put into; a second one ends the process at once."""
    noted: list[int] = []
    if threading.current_thread() is not threading.main_thread():
        yield noted
        return

    def note(number: int, _: Any) -> None:
        if noted:
            raise KeyboardInterrupt
        noted.append(number)
        print("\nstopping after this step; once more stops at once", file=sys.stderr)

    before = {number: signal.signal(number, note) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield noted
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def log_path(run: Run) -> Path:
    """One line of JSON for each step."""
    return run.out / "metrics.jsonl"
