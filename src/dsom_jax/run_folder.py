"""The folder of a training run: what it keeps so that it can be killed at any moment and resumed."""

from __future__ import annotations

import json
import shutil
import subprocess
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from dsom_jax import checkpoint
from dsom_jax.atomic import write_atomic
from dsom_jax.data.documents import read_yaml
from dsom_jax.errors import UserError
from dsom_jax.training.filter_loop import averaged_filter_model
from dsom_jax.training.loop import averaged_model, late_start

R = TypeVar("R", bound="Run")


@dataclass
class Run:
    """A training run of DSOM and its folder: state-*/ (to resume), metrics.jsonl, run.json, and the checkpoint itself.

    ``commit`` is that of the code when this process began, whatever happens to the repository while it trains.
    """

    out: Path
    config: Any
    maps: tuple[str, ...]
    total: int | None
    seconds: float = 0.0
    init: str | None = None
    commit: str = field(default_factory=lambda: commit())

    def record(self) -> dict[str, Any]:
        """What run.json holds."""
        facts = {"maps": list(self.maps), "init": self.init, "total": self.total, "seconds": self.seconds}
        return {"config": asdict(self.config), **facts}

    def write(self) -> None:
        """Write run.json."""
        checkpoint.write_json(self.out / "run.json", self.record())

    def states(self) -> list[Path]:
        """Folders of complete states, oldest first."""
        return sorted(p for p in self.out.glob("state-*") if p.name[6:].isdigit())

    def save(self, state: Any, metrics: dict[str, Any]) -> None:
        """State and checkpoint; the two newest states stay."""
        step = int(state.step)
        checkpoint.save_state(self.out / f"state-{step:08d}", state)
        self.write()
        tag = f"weights-{step:08d}"
        # A checkpoint that is written over in place is broken until it is done; the same step has the same weights.
        if checkpoint.tag_of(self.out) != tag:
            checkpoint.save(self.out, self.model(state), self.provenance(step, metrics), tag)
        for old in self.states()[:-2]:
            shutil.rmtree(old, ignore_errors=True)

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


def create(run: Run) -> None:
    """The folder of a new run with its run.json."""
    try:
        run.out.mkdir(parents=True, exist_ok=True)
        run.write()
    except OSError as error:
        raise UserError(f"{run.out}: cannot write ({error.strerror}); give another --out") from error


def check_new(out: Path, resume: bool) -> None:
    """UserError if the folder of a run that is to begin is a file, or (unless ``resume``) not empty."""
    if out.exists() and not out.is_dir():
        raise UserError(f"--out {out}: is a file; give a folder")
    if not resume and out.exists() and any(out.iterdir()):
        raise UserError(f"{out}: not empty; add --resume to continue that run, or give another --out")


def reopen(
    kind: type[R], path: Path, read_config: Callable[[Any], Any], maps: tuple[Path, ...], steps: int | None
) -> R:
    """The run that the ``run.json`` at ``path`` describes; ``read_config`` makes its configuration of what it holds.

    UserError if it is another than ``maps`` and ``steps``, where given, ask for; ``steps`` are those of a run that was
    stopped before it had counted its own.
    """
    try:
        record = json.loads(path.read_text())
        config = read_config(record["config"])
        rest = (tuple(record["maps"]), record["total"], record["seconds"], record.get("init"))
        run = kind(path.parent, config, *rest)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UserError(f"{path}: no run to resume here ({error}); start without --resume") from error
    if maps and tuple(map(str, maps)) != run.maps:
        raise UserError(f"--maps: the run in {path} has {', '.join(run.maps) or 'none'}; resume without --maps")
    if steps is not None and run.total is not None and steps != run.total:
        raise UserError(f"--steps {steps}: the run in {path} has {run.total}; resume without --steps")
    run.total = run.total or steps
    return run


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


def trim_log(path: Path, step: int) -> None:
    """Drop what a killed run wrote to the log after its last saved state."""
    lines = path.read_text().splitlines() if path.exists() else []
    kept = [line for line in lines if line.endswith("}") and json.loads(line)["step"] <= step]
    write_atomic(path, "".join(line + "\n" for line in kept).encode())
