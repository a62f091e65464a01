"""The folder of a training run: what it keeps so that it can be killed at any moment and resumed.

One process at a time writes in it (``.lock``), and removes nothing but what ``owner.json`` says that the run has
written. Whatever else lies there stays. States and weights are on the disk before the older ones are removed.
"""

from __future__ import annotations

import json
import os
import platform
import subprocess
import uuid
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from filelock import FileLock, Timeout

from dsom_jax import checkpoint
from dsom_jax.atomic import write_atomic
from dsom_jax.data.documents import read_yaml
from dsom_jax.errors import UserError
from dsom_jax.training.filter_loop import averaged_filter_model
from dsom_jax.training.loop import averaged_model, late_start

R = TypeVar("R", bound="Run")
S = TypeVar("S")
LOCK, OWNER, RUN = ".lock", "owner.json", "run.json"
THIS_PROCESS = uuid.uuid4().hex
"""What ``owner.json`` calls this process; its number alone is given to others, too."""


class Claim:
    """The right of this process to write in a run folder, and what was written there by it and those before it.

    UserError if another process holds the folder, or if it cannot be written.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.lock = FileLock(folder / LOCK, is_singleton=True)
        try:
            self.lock.acquire(timeout=0)
        except Timeout:
            raise UserError(
                f"{folder}: another training (process {self.read().get('process', 'unknown')}) writes there; "
                "wait for it, or give another --out"
            ) from None
        except OSError as error:
            raise UserError(f"{folder}: cannot write ({error.strerror}); give another --out") from error
        wrote = self.read().get("wrote")
        # A run of an earlier version has no list: its states, and the weights of its checkpoint.
        old = [path.name for path in states_in(folder)] + [tag for tag in [checkpoint.tag_of(folder)] if tag]
        self.wrote: set[str] = set(wrote if isinstance(wrote, list) else old if (folder / RUN).is_file() else [])
        self.write()

    def read(self) -> dict[str, Any]:
        """What ``owner.json`` holds; nothing where there is none."""
        path = self.folder / OWNER
        record = checkpoint.read_record(path, "remove it if nothing trains there") if path.is_file() else {}
        return record if isinstance(record, dict) else {}

    def write(self) -> None:
        """Write ``owner.json``."""
        who = {"process": os.getpid(), "host": platform.node(), "claim": THIS_PROCESS}
        checkpoint.write_record(self.folder / OWNER, {**who, "wrote": sorted(self.wrote)})

    def check(self) -> None:
        """UserError if the folder is no longer that of this process: nothing may be written or removed there."""
        if self.read().get("claim") != THIS_PROCESS:
            raise UserError(f"{self.folder}: was taken by another training (see {OWNER}); nothing was written there")

    def announce(self, *names: str) -> None:
        """Note folders that are about to be written; what a killed process has left of them is removed."""
        self.wrote |= set(names)
        self.write()
        for name in names:
            checkpoint.remove_tree(self.folder / (name + checkpoint.DRAFT))

    def discard(self, names: Iterable[str]) -> None:
        """Remove those of ``names`` that the run has written."""
        for name in self.wrote.intersection(names):
            checkpoint.remove_tree(self.folder / name)
            checkpoint.remove_tree(self.folder / (name + checkpoint.DRAFT))
        self.wrote = {name for name in self.wrote if (self.folder / name).exists()}
        self.write()


@dataclass
class Run:
    """A training run of DSOM and its folder: state-*/ (to resume), metrics.jsonl, run.json, and the checkpoint itself.

    ``commit`` is that of the code when this process began, whatever happens to the repository while it trains;
    ``damaged`` names states that could not be read; ``claim`` is there once the folder is written in.
    """

    out: Path
    config: Any
    maps: tuple[str, ...]
    total: int | None
    seconds: float = 0.0
    init: str | None = None
    commit: str = field(default_factory=lambda: commit())
    damaged: set[str] = field(default_factory=set)
    claim: Claim | None = None

    def record(self) -> dict[str, Any]:
        """What run.json holds."""
        facts = {"maps": list(self.maps), "init": self.init, "total": self.total, "seconds": self.seconds}
        return {"config": asdict(self.config), **facts}

    def write(self) -> None:
        """Write run.json."""
        checkpoint.write_record(self.out / RUN, self.record())

    def states(self) -> list[Path]:
        """Folders of states, oldest first, without those known to be damaged."""
        return [path for path in states_in(self.out) if path.name not in self.damaged]

    def newest(self, read: Callable[[Path], S]) -> S | None:
        """The newest state that ``read`` can read, or None if there is none at all; says which ones are damaged."""
        reason, found = "", self.states()
        if not found:
            return None
        for path in reversed(found):
            try:
                state = read(path)
            except UserError as error:
                reason = reason or str(error)
                self.damaged.add(path.name)
                continue
            if reason:
                print(f"{', '.join(sorted(self.damaged))}: damaged; the run goes on from {path}")
            return state
        raise UserError(f"{self.out}: no state can be read ({reason}); train again, with another --out")

    def hold(self) -> Claim:
        """The claim on the folder. One that has been removed under a run is made again, with ``run.json`` in it."""
        removed = self.claim is not None and not any((self.out / name).exists() for name in (LOCK, OWNER))
        if self.claim is None or removed:
            if self.claim is not None:
                self.claim.lock.release(force=True)
            try:
                self.out.mkdir(parents=True, exist_ok=True)
            except OSError as error:
                raise UserError(f"{self.out}: cannot write ({error.strerror}); give another --out") from error
            self.claim = Claim(self.out)
        if removed:
            self.write()
        self.claim.check()
        return self.claim

    def save(self, state: Any, metrics: dict[str, Any]) -> None:
        """State and checkpoint; the two newest states stay, and so does all that the run has not written."""
        step = int(state.step)
        claim, name, tag = self.hold(), f"state-{step:08d}", f"weights-{step:08d}"
        claim.discard(self.damaged & {name})
        claim.announce(name)
        # The same step has the same numbers; what is written over in place is broken until it is done.
        if not (self.out / name).is_dir():
            checkpoint.save_state(self.out / name, state)
        self.damaged.discard(name)
        self.write()
        if checkpoint.tag_of(self.out) != tag:
            claim.discard([tag])
            claim.announce(tag)
            checkpoint.write(self.out, self.model(state), self.provenance(step, metrics), tag)
        keep = {path.name for path in self.states()[-2:]} | {tag}
        claim.discard(claim.wrote - keep)

    def check(self, path: Path | None) -> None:
        """UserError for a configuration, that of ``path``, with which no run should begin."""

    def model(self, state: Any) -> Any:
        """The network that is shipped."""
        return averaged_model(self.config, state)

    def data(self) -> list[str] | str:
        """What is trained on."""
        return [Path(path).name for path in self.maps] or "procedural buildings, dsom_jax.simulate.make_world"

    def provenance(self, step: int, metrics: dict[str, Any]) -> dict[str, Any]:
        """How the weights came about."""
        facts = {
            "seed": self.config.seed,
            "commit": self.commit,
            "data": self.data(),
            "init": self.init,
            "steps": step,
            "total": self.total,
        }
        effort = {"seconds": round(self.seconds, 1), "samples": self.samples(step)}
        return {**facts, **effort, "metrics": metrics, "train": asdict(self.config)}

    def samples(self, step: int) -> int:
        """Scans seen after ``step`` steps."""
        early, late = self.config.early, self.config.late
        start = step if self.total is None else min(step, late_start(self.config, self.total))
        return start * early.worlds * early.scans + (step - start) * late.worlds * late.scans


@dataclass
class FilterRun(Run):
    """A training run of PF-Net or PFRNN; without ``maps``, on the test maps of the frozen suite."""

    def check(self, path: Path | None) -> None:
        """UserError if the network would refuse the scans that it is to be trained on."""
        if unfit := self.config.model.misfit(self.config.data.lidar):
            raise UserError(f"{path}: data.lidar: {unfit}; give model: view: what these scans have")

    def model(self, state: Any) -> Any:
        """The network that is shipped."""
        return averaged_filter_model(self.config, state)

    def data(self) -> list[str] | str:
        """What is trained on."""
        return [Path(path).name for path in self.maps] or "random drives in the test maps of synthetic-v1"

    def samples(self, step: int) -> int:
        """Scans seen after ``step`` steps."""
        return step * self.config.batch * self.config.data.window


def read_fields(path: Path | None) -> dict[str, Any]:
    """Fields of a configuration file; none without one."""
    return {} if path is None else read_yaml(path, "configuration")


def create_run(run: Run) -> None:
    """The folder of a new run with its run.json."""
    run.hold()
    try:
        check_new(run.out)  # which another process may have begun since it was looked at
    except UserError:
        run.claim = None
        raise
    run.write()


def check_new(out: Path) -> None:
    """UserError if the folder of a run that is to begin is a file, or not empty but for what a killed start leaves."""
    if out.exists() and not out.is_dir():
        raise UserError(f"--out {out}: is a file; give a folder")
    if not out.exists():
        return
    names = {path.name for path in out.iterdir()}
    if RUN in names:
        raise UserError(f"{out}: not empty; add --resume to continue that run, or give another --out")
    if foreign := sorted(name for name in names - {LOCK, OWNER} if not name.startswith((f".{RUN}.", f".{OWNER}."))):
        raise UserError(f"{out}: not empty ({foreign[0]}) and without {RUN}: no run to resume; give another --out")


def reopen(
    kind: type[R], path: Path, read_config: Callable[[Any], Any], maps: tuple[Path, ...], steps: int | None
) -> R:
    """The run that the ``run.json`` at ``path`` describes; ``read_config`` makes its configuration of what it holds.

    UserError if it is another than ``maps`` and ``steps``, where given, ask for; ``steps`` are those of a run that was
    stopped before it had counted its own.
    """
    record = checkpoint.read_record(path, "restore it, or give another --out")
    run = kind(path.parent, None, *_checked(record, path))
    run.config = read_config(record["config"])
    if maps and tuple(map(str, maps)) != run.maps:
        raise UserError(f"--maps: the run in {path} has {', '.join(run.maps) or 'none'}; resume without --maps")
    run.hold()
    if steps is not None and run.total is not None and steps != run.total:
        raise UserError(f"--steps {steps}: the run in {path} has {run.total}; resume without --steps")
    run.total = run.total or steps
    return run


def _checked(record: Any, path: Path) -> tuple[tuple[str, ...], int | None, float, str | None]:
    """Maps, steps, seconds and ``init`` of a run.json; UserError for a field that is missing or of another kind."""

    def fits(name: str, *kinds: type) -> Any:
        if not isinstance(record, dict) or name not in record:
            raise UserError(f"{path}: no run to resume here (field {name} is missing); give another --out")
        value = record[name]
        if not isinstance(value, kinds) or isinstance(value, bool):
            raise UserError(f"{path}: field {name}: is {str(value)[:40]}; restore the file, or give another --out")
        return value

    maps, total, seconds = fits("maps", list), fits("total", int, type(None)), fits("seconds", int, float)
    fits("config", dict)
    if not all(isinstance(name, str) for name in maps):
        raise UserError(f"{path}: field maps: holds no names of files; restore the file, or give another --out")
    if (total is not None and total < 1) or not 0 <= seconds < float("inf"):
        raise UserError(f"{path}: field total or seconds: out of range; restore the file, or give another --out")
    init = record.get("init")
    return tuple(maps), total, float(seconds), init if isinstance(init, str) else None


def check_init(init: Path | None, run: Run, path: Path) -> None:
    """UserError for another ``--init`` than the run's, or none where it is still needed; says if it is not read."""
    if init is not None and init.name != run.init:
        raise UserError(f"--init {init}: the run in {path} began with {run.init or 'fresh weights'}; resume without it")
    if init is None and run.init is not None and not run.states():
        raise UserError(f"{path}: the run begins with {run.init} and has saved no state yet; give --init, too")
    if init is not None and run.states():
        print(f"--init {init}: not read, the run goes on from {run.states()[-1]}")


def load_init(path: Path | None, wanted: Any, kind: str = "dsom") -> Any:
    """The network to start from, if one is named; it must be of the run's configuration ``wanted``."""
    if path is None:
        return None
    model = checkpoint.load(path, kind=kind)
    own, run = flat(asdict(model.config)), flat(asdict(wanted))
    unlike = ", ".join(f"{name} = {own[name]!r}, the run's is {run[name]!r}" for name in own if own[name] != run[name])
    if unlike:
        raise UserError(f"{path}: field model: {unlike}; give a --config with the network's own, or another --init")
    return model


def flat(fields: dict[str, Any]) -> dict[str, Any]:
    """Fields of a network's configuration by name, without the scans it was trained for: they are no part of it."""
    inner = {name: value for part in fields.values() if isinstance(part, dict) for name, value in part.items()}
    outer = {name: value for name, value in fields.items() if not isinstance(value, dict)}
    return {name: value for name, value in (outer | inner).items() if name not in ("fov_min", "reach_min")}


def commit() -> str:
    """Commit of the source, or unknown."""
    command = ["git", "-C", str(Path(__file__).parent), "rev-parse", "HEAD"]
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return "unknown"


def states_in(out: Path) -> list[Path]:
    """Folders of complete states, oldest first."""
    return sorted(p for p in out.glob("state-*") if p.name[6:].isdigit())


def trim_log(path: Path, step: int) -> list[str]:
    """The lines of the log up to ``step``, to which the file is cut; says how many are damaged and left out."""
    lines = path.read_bytes().decode(errors="replace").splitlines() if path.exists() else []
    numbers = [step_of(line) for line in lines]
    intact = [line for line, number in zip(lines, numbers, strict=True) if number is not None and number <= step]
    # The last line is half there if its process was killed; any other has suffered something else.
    if lost := sum(number is None for number in numbers[:-1]):
        print(f"{path}: {lost} damaged lines, left out")
    write_atomic(path, "".join(line + "\n" for line in intact).encode())
    return intact


def step_of(line: str) -> int | None:
    """The step that a line of the log is about, None if it is damaged."""
    try:
        step = json.loads(line)["step"]
    except (ValueError, KeyError, TypeError, RecursionError):
        return None
    return step if isinstance(step, int) else None
