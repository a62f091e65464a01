"""``python -m dsom_jax.train``: train DSOM on procedural buildings or on given maps; resumable."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax

from dsom_jax.cli import parse
from dsom_jax.data.open_map import load_maps
from dsom_jax.errors import run_cli
from dsom_jax.judging.quality import make_evaluation
from dsom_jax.occupancy import OccupancyGrid
from dsom_jax.run_folder import Run
from dsom_jax.trainer import Material, Parts, check_length, first_state, open_run, train
from dsom_jax.training.batches import make_batch, plain_scans
from dsom_jax.training.loop import TrainConfig, init_state, make_batches, make_step, world_source
from dsom_jax.training.memory import keep_freed_memory
from dsom_jax.training.options import override
from dsom_jax.training.sharding import data_mesh, replicate, spread


@dataclass(frozen=True)
class TrainArgs:
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
        check_length(self)

    @property
    def folder(self) -> Path:
        """Where the run lives."""
        return self.out

    @property
    def kind(self) -> str:
        """Of the network."""
        return "dsom"

    def read_config(self, given: Any, where: str) -> TrainConfig:
        """The configuration with the fields of ``given``."""
        return override(TrainConfig(), given, where)

    def read_maps(self, run: Run) -> list[OccupancyGrid]:
        """Maps of ``run``; procedural buildings have the network's scale, and so do maps that are mixed with them."""
        return load_maps(tuple(map(Path, run.maps)), run.config.model.resolution, run.config.maps_share == 1.0)


def held_out(run: Run, grids: list[OccupancyGrid]) -> Any:
    """Evaluation on full-size buildings that training does not see."""
    scans = plain_scans(run.config.scan)
    source = world_source(replace(run.config, scan=scans), run.config.late, grids)
    key = jax.random.key(2**31 - 1 - run.config.seed)
    batch = jax.jit(lambda k: make_batch(k, source, scans, 12, 8, run.config.model))(key)
    return make_evaluation(batch, scans.lidar)


def dsom_parts(run: Run, material: Material) -> Parts:
    """Batches, step and evaluation of a run."""
    mesh, make = data_mesh(), make_batches(run.config, material.grids)
    return Parts(
        batches=lambda step, total: spread(make(step, total), mesh),
        step=make_step(run.config),
        evaluate=held_out(run, material.grids),
        state=replicate(first_state(run, init_state(run.config, material.network)), mesh),
        shown=("kld", "KLD"),
    )


def main() -> None:
    """Entry point."""
    args = parse(TrainArgs, "python -m dsom_jax.train")
    keep_freed_memory()
    run, material = open_run(args)
    train(args, run, lambda: dsom_parts(run, material))


if __name__ == "__main__":
    run_cli(main)
