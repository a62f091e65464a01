"""Kills, full disks and races: ``python experiments/stress/run_folder.py [--kill 100 --fill 20 --race 20]``.

Trainings of a network that costs nothing, with the real loop, the real states and checkpoints, each in a process of its
own. They are killed at random moments, run in a file system that is full sooner or later (a tmpfs, which needs the
right to mount one; without it, files may not grow beyond a random size), or two start at once in one folder. After each
blow: the newest state that was reported as saved can be read and holds what it should, so can the checkpoint, and files
that are not the run's are as they were. Writes ``results/run_folder.json`` unless ``--no-save``.
"""

from __future__ import annotations

import json
import os
import random
import resource
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from dsom_jax import checkpoint
from dsom_jax.errors import run_cli
from dsom_jax.nn import DSOMConfig, create
from dsom_jax.run_folder import Run, commit
from dsom_jax.train import TrainArgs
from dsom_jax.trainer import Parts, open_run, train

RESULTS = Path(__file__).parent / "results"
FOREIGN = ("weights_backup", "weights", "state-mine", "weights-00000000")
CELLS = 64


class State(NamedTuple):
    """What a step changes; ``values`` is a function of ``step``."""

    step: Any
    values: Any


def state(step: int) -> State:
    """What every training must have after ``step`` steps."""
    return State(jnp.int32(step), jnp.full((CELLS, CELLS), step, jnp.float32) + jnp.arange(CELLS))


def network(step: int) -> Any:
    """A network whose first temperature tells the step."""
    model = create(DSOMConfig(width=2, headings=4), 0)
    model.log_temperature[...] = jnp.float32(step)
    return model


def work(out: Path, steps: int, pause: float, saved: int) -> None:
    """A training in ``out``; every step that is saved is reported to the file descriptor ``saved``."""
    plain = Run.save
    Run.model = lambda self, state: network(int(state.step))  # type: ignore[method-assign]

    def save(run: Run, state: Any, metrics: dict[str, Any]) -> None:
        plain(run, state, metrics)
        os.write(saved, b"%d\n" % int(state.step))

    Run.save = save  # type: ignore[method-assign,assignment]
    args = TrainArgs(out=out, resume=True, steps=steps, save_steps=2)
    run, _ = open_run(args)

    def forward(now: State, batch: Any, total: Any) -> tuple[State, dict[str, float]]:
        time.sleep(pause)
        return state(int(now.step) + 1), {"total": float(now.step)}

    def parts() -> Parts:
        first = run.newest(lambda path: checkpoint.load_state(path, state(0)))
        return Parts(lambda step, total: None, forward, lambda model: {}, first or state(0), ("total", "total"))

    train(args, run, parts)


class Child:
    """A training in a process of its own. It is forked before JAX has begun, which saves the time of all imports."""

    def __init__(self, out: Path, steps: int, pause: float = 0.0, prepare: Callable[[], None] = lambda: None) -> None:
        self.errors, (self.saved, told) = tempfile.TemporaryFile(), os.pipe()  # noqa: SIM115
        self.told = b""
        self.id = os.fork()
        if self.id == 0:
            code = 70
            try:
                os.dup2(self.errors.fileno(), 2)
                os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
                prepare()
                run_cli(lambda: work(out, steps, pause, told))
                code = 0
            except SystemExit as stop:
                code = int(stop.code or 0)
            except BaseException:
                import traceback

                traceback.print_exc()
            finally:
                os._exit(code)
        os.close(told)

    def wait_for(self, reports: int) -> None:
        """Wait until so many steps have been reported as saved, or it has ended."""
        while self.told.count(b"\n") < reports and (part := os.read(self.saved, 4096)):
            self.told += part

    def kill(self) -> None:
        """SIGKILL, if it still runs."""
        os.kill(self.id, signal.SIGKILL)

    def end(self) -> tuple[int, str, int]:
        """Exit code (negative for a signal), what was said on stderr, and the last step reported as saved."""
        while part := os.read(self.saved, 4096):
            self.told += part
        code = os.waitstatus_to_exitcode(os.waitpid(self.id, 0)[1])
        os.close(self.saved)
        self.errors.seek(0)
        steps = [int(line) for line in self.told.split()]
        return code, self.errors.read().decode(errors="replace"), max(steps, default=0)


def put_foreign(out: Path) -> None:
    """Files that are not the run's, with names that look like it."""
    for name in FOREIGN:
        (out / name).mkdir(parents=True, exist_ok=True)
        (out / name / "mine").write_text(name)


def in_child(check: Callable[[], str]) -> str:
    """What ``check`` finds, computed in another process: this one must not start JAX."""
    read, write = os.pipe()
    if (child := os.fork()) == 0:
        try:
            found = check()
        except BaseException as error:
            found = f"{type(error).__name__}: {error}"
        os.write(write, found.encode()[:4000])
        os._exit(0)
    os.close(write)
    with os.fdopen(read) as pipe:
        found = pipe.read()
    os.waitpid(child, 0)
    return found


def harm(out: Path, least: int) -> str:
    """What is wrong with the folder of a run that has reported step ``least`` as saved; empty if nothing."""

    def check() -> str:
        for name in FOREIGN:
            if (out / name / "mine").read_text() != name:
                return f"{name} was touched"
        if least == 0:
            return ""
        run = Run(out, None, (), None)
        found = run.newest(lambda path: checkpoint.load_state(path, state(0)))
        if found is None or int(found.step) < least:
            return f"step {least} was saved, {found and int(found.step)} is there"
        if not np.array_equal(found.values, state(int(found.step)).values):
            return "the state holds other numbers"
        told = float(checkpoint.load(out).log_temperature[...])
        return "" if told in (least, int(found.step)) else f"the checkpoint is of step {told}, saved was {least}"

    return in_child(check)


def steps_logged(out: Path) -> list[int]:
    """Steps in the log of a run that has ended."""
    return [json.loads(line)["step"] for line in (out / "metrics.jsonl").read_text().splitlines()]


def kills(count: int, luck: random.Random, folder: Path) -> dict[str, Any]:
    """One training after the other is killed at a random moment and goes on; the last one ends."""
    out, wrong, done, reached, steps = folder / "killed", [], 0, 0, 40 * count
    first = Child(out, steps, 0.01)
    time.sleep(0.5)
    while done < count:
        child = first if done == 0 else Child(out, steps, 0.01)
        if luck.random() < 0.8:  # after one or two states, whatever it does then; else while it begins
            child.wait_for(luck.randrange(1, 3))
            time.sleep(luck.uniform(0.0, 0.4))
        else:
            time.sleep(luck.uniform(0.0, 3.0))
        child.kill()
        code, said, step = child.end()
        reached, done = max(reached, step), done + 1
        if not (out / FOREIGN[0]).exists() and (out / "run.json").exists():
            put_foreign(out)
        if code != -signal.SIGKILL:
            wrong.append(f"kill {done}: ended with {code}: {said[:300]}")
        if (out / FOREIGN[0]).exists() and (found := harm(out, reached)):
            wrong.append(f"kill {done}: {found}")
        if done % 10 == 0:
            print(f"killed {done} times, step {reached}, {len(wrong)} faults", flush=True)
    end = reached + 5
    record = json.loads((out / "run.json").read_text())
    (out / "run.json").write_text(json.dumps(record | {"total": end}))
    code, said, step = Child(out, end).end()
    if code or step != end or steps_logged(out) != list(range(1, end + 1)) or harm(out, end):
        wrong.append(f"the last start: {code}, step {step} of {end}: {said[:300]}")
    return {"kills": done, "steps": end, "faults": wrong}


def full_disks(count: int, luck: random.Random, folder: Path) -> dict[str, Any]:
    """Trainings on a disk that is soon full; with more room they go on to their end."""
    wrong, refused, how = [], 0, ""
    for number in range(count):
        disk = folder / f"disk{number}"
        disk.mkdir()
        size = luck.randrange(400, 2400)
        mount = ["mount", "-t", "tmpfs", "-o", f"size={size}k", "tmpfs", str(disk)]
        mounted = subprocess.run(mount, capture_output=True).returncode == 0
        how = "tmpfs" if mounted else "limit on the size of files"
        limit = luck.randrange(2_000, 24_000)

        def prepare(mounted: bool = mounted, limit: int = limit) -> None:
            if not mounted:
                signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
                resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))

        try:
            out = disk / "run"
            code, said, step = Child(out, 6, prepare=prepare).end()
            filler, reached = disk / "filler", step
            if mounted and code == 0:  # it fits: now fill what is left but for a few blocks, and go on
                extend(out, 12)
                put_foreign(out)
                fill_up(filler, 4096 * luck.randrange(0, 40))
                code, said, step = Child(out, 12).end()
                reached = max(reached, step)
            refused += code == 2
            if code not in (0, 2) or (code == 2 and (said.count("\n") != 1 or len(said) > 600)):
                wrong.append(f"disk {number}: {code}: {said[:400]}")
            if out.exists() and (out / FOREIGN[0]).exists() and (found := harm(out, reached)):
                wrong.append(f"disk {number}, {size}k: {found}")
            filler.unlink(missing_ok=True)
            if mounted:
                subprocess.run(["mount", "-o", "remount,size=64m", str(disk)], check=True, capture_output=True)
            if (out / "run.json").exists():
                put_foreign(out)
                code, said, step = Child(
                    out, 14 if False else json.loads((out / "run.json").read_text())["total"]
                ).end()
                if code or harm(out, step):
                    wrong.append(f"disk {number}, with room again: {code}: {said[:300]} {harm(out, step)}")
        finally:
            if mounted:
                subprocess.run(["umount", str(disk)], capture_output=True)
    return {"disks": count, "full": refused, "how": how, "faults": wrong}


def extend(out: Path, total: int) -> None:
    """Give a finished run more steps."""
    record = json.loads((out / "run.json").read_text())
    (out / "run.json").write_text(json.dumps(record | {"total": total}))


def fill_up(path: Path, spare: int) -> None:
    """Leave ``spare`` bytes of a small file system free."""
    free = os.statvfs(path.parent)
    left = free.f_bavail * free.f_frsize - spare
    if left > 0:
        path.write_bytes(b"\0" * left)


def races(count: int, luck: random.Random, folder: Path) -> dict[str, Any]:
    """Two trainings start at once, in a folder that is not there yet or in one that holds a run."""
    wrong = []
    for number in range(count):
        out, reached = folder / f"race{number}", 0
        if number % 2:
            reached = Child(out, 4).end()[2]
            put_foreign(out)
            extend(out, 30)
        pauses = [luck.uniform(0, 0.02) for _ in range(2)]
        both = [Child(out, 30, 0.1, partial(time.sleep, pause)) for pause in pauses]
        ends = [child.end() for child in both]
        lost = [said for code, said, _ in ends if code == 2]
        if sorted(code for code, _, _ in ends) != [0, 2] or lost[0].count("\n") != 1:
            wrong.append(f"race {number}: {[(code, said[:200]) for code, said, _ in ends]}")
            continue
        put_foreign(out)
        if steps_logged(out) != list(range(1, 31)) or (found := harm(out, max(reached, 30))):
            wrong.append(f"race {number}: {found or 'another log'}")
    return {"races": count, "faults": wrong}


def main(kill: int = 100, fill: int = 20, race: int = 20, seed: int = 0, save: bool = True) -> None:
    """All three; exit code 1 if anything was lost.

    Args:
        kill: number of kills.
        fill: number of full disks.
        race: number of races.
        seed: of the moments.
        save: write the results.
    """
    began, luck, found = time.monotonic(), random.Random(seed), {}
    with tempfile.TemporaryDirectory() as name:
        for part, count, what in (("kills", kill, kills), ("full", fill, full_disks), ("races", race, races)):
            if count:
                found[part] = what(count, luck, Path(name))
                print(json.dumps(found[part]), flush=True)
    faults = sum(len(part["faults"]) for part in found.values())
    record = {**found, "seconds": round(time.monotonic() - began), "seed": seed, "jax": jax.__version__}
    if save:
        RESULTS.mkdir(exist_ok=True)
        text = json.dumps(record | {"commit": commit()}, indent=1)
        (RESULTS / "run_folder.json").write_text(text + "\n")
    print(f"{faults} faults")
    sys.exit(min(faults, 1))


if __name__ == "__main__":
    tyro.cli(main, prog="python experiments/stress/run_folder.py")
