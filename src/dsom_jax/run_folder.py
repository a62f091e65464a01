"""The folder of a training run: what it keeps so that it can be killed at any moment and resumed.

One process at a time writes in it (``.lock``), and removes nothing but what ``owner.json`` says that the run has
written. Whatever else lies there stays. States and weights are on the disk before the older ones are removed.
"""

from __future__ import annotations

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
from dsom_jax.data.documents import read_yaml
from dsom_jax.errors import UserError
from dsom_jax.training.filter_loop import averaged_filter_model
from dsom_jax.training.loop import averaged_model, late_start

_S = TypeVar("_S")
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

    def newest(self, read: Callable[[Path], _S]) -> _S | None:
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
