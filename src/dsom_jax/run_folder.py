"""The folder of a training run: what it keeps so that it can be killed at any moment and resumed."""

from __future__ import annotations

import json
import shutil
import subprocess
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from dsom_jax import checkpoint
from dsom_jax.training.loop import TrainConfig, TrainState, averaged_model, late_start


@dataclass
class Run:
    """A training run and its folder: state-*/ (to resume), metrics.jsonl, run.json, and the checkpoint itself.

    ``commit`` is that of the code when this process began, whatever happens to the repository while it trains.
    """

    out: Path
    config: TrainConfig
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

    def save(self, state: TrainState, metrics: dict[str, Any]) -> None:
        """State and checkpoint; the two newest states stay."""
        step = int(state.step)
        checkpoint.save_state(self.out / f"state-{step:08d}", state)
        self.write()
        model, tag = averaged_model(self.config, state), f"weights-{step:08d}"
        checkpoint.save(self.out, model, self.provenance(step, metrics), tag)
        for old in self.states()[:-2]:
            shutil.rmtree(old, ignore_errors=True)

    def provenance(self, step: int, metrics: dict[str, Any]) -> dict[str, Any]:
        """How the weights came about."""
        data = [Path(path).name for path in self.maps] or "procedural buildings, dsom_jax.simulate.make_world"
        facts = {
            "seed": self.config.seed,
            "commit": commit(),
            "data": data,
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
    temporary = path.with_name(path.name + ".new")
    temporary.write_text("".join(line + "\n" for line in kept))
    temporary.replace(path)
