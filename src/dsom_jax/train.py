"""``python -m dsom_jax.train``: train DSOM on procedural buildings or on given maps; resumable."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import jax

from dsom_jax import checkpoint
from dsom_jax.cli import parse
from dsom_jax.data.open_map import load_maps
from dsom_jax.errors import UserError, run_cli
from dsom_jax.judging.quality import make_evaluation
from dsom_jax.nn import DSOM
from dsom_jax.occupancy import OccupancyGrid
from dsom_jax.run_folder import Run, check_init, check_new, create_run, load_init, read_fields, reopen
from dsom_jax.trainer import Parts, check_length, train
from dsom_jax.training.batches import make_batch, plain_scans
from dsom_jax.training.loop import (
    TrainConfig,
    TrainState,
    init_state,
    make_batches,
    make_step,
    world_source,
)
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


class Material(NamedTuple):
    """What a run reads before it begins: maps at the network's resolution, and the network to start from, if any."""

    grids: list[OccupancyGrid]
    network: DSOM | None


def read_config(path: Path | None) -> TrainConfig:
    """TrainConfig from a YAML file with some of its fields."""
    return override(TrainConfig(), read_fields(path), str(path))


def open_run(args: TrainArgs) -> tuple[Run, Material]:
    """A new run in an empty folder, or the one to resume, and what it is made of."""
    path = args.out / "run.json"
    if args.resume and path.exists():
        run = resume_run(args, path)
        return run, read_material(args, run)
    check_new(args.out)
    begin = None if args.init is None else args.init.name
    run = Run(args.out, read_config(args.config), tuple(str(p) for p in args.maps), args.steps, init=begin)
    # Before anything is written: a bad map or checkpoint leaves no folder behind.
    material = read_material(args, run)
    create_run(run)
    return run, material


def read_material(args: TrainArgs, run: Run) -> Material:
    """Maps and network; a run that has saved a state no longer needs the network that it began with."""
    network = None if run.states() else load_init(args.init, run.config.model)
    # Procedural buildings have the network's scale, and so do maps that are mixed with them.
    alone = run.config.maps_share == 1.0
    return Material(load_maps(tuple(map(Path, run.maps)), run.config.model.resolution, alone), network)


def resume_run(args: TrainArgs, path: Path) -> Run:
    """The run described by run.json."""
    run = reopen(Run, path, lambda given: override(TrainConfig(), given, str(path)), args.maps, args.steps)
    if args.config is not None and read_config(args.config) != run.config:
        raise UserError(f"{args.config}: differs from the run in {path}; resume without --config")
    check_init(args.init, run, path)
    return run


def first_state(run: Run, network: DSOM | None) -> TrainState:
    """The newest saved state, or a fresh one."""
    saved = run.newest(lambda path: checkpoint.load_state(path, init_state(run.config)))
    return init_state(run.config, network) if saved is None else saved


def held_out(run: Run, grids: list[OccupancyGrid]) -> Any:
    """Evaluation on full-size buildings that training does not see."""
    scans = plain_scans(run.config.scan)
    source = world_source(replace(run.config, scan=scans), run.config.late, grids)
    key = jax.random.key(2**31 - 1 - run.config.seed)
    batch = jax.jit(lambda k: make_batch(k, source, scans, 12, 8, run.config.model))(key)
    return make_evaluation(batch, scans.lidar)


def parts(run: Run, material: Material) -> Parts:
    """Batches, step and evaluation of a run."""
    mesh, make = data_mesh(), make_batches(run.config, material.grids)
    return Parts(
        batches=lambda step, total: spread(make(step, total), mesh),
        step=make_step(run.config),
        evaluate=held_out(run, material.grids),
        state=replicate(first_state(run, material.network), mesh),
        shown=("kld", "KLD"),
    )


def main() -> None:
    """Entry point."""
    args = parse(TrainArgs, "python -m dsom_jax.train")
    keep_freed_memory()
    run, material = open_run(args)
    train(args, run, lambda: parts(run, material))


if __name__ == "__main__":
    run_cli(main)
