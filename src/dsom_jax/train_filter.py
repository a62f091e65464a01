"""``python -m dsom_jax.train_filter``: train PF-Net or PFRNN on sequences in the maps that they are to be used in."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp

from dsom_jax.cli import parse
from dsom_jax.data.open_map import load_maps
from dsom_jax.data.suite import load_suite
from dsom_jax.errors import run_cli
from dsom_jax.judging.tracking import make_tracking
from dsom_jax.nn import KINDS
from dsom_jax.occupancy import OccupancyGrid
from dsom_jax.run_folder import Run
from dsom_jax.trainer import Material, Parts, check_length, first_state, open_run, train
from dsom_jax.training.filter_loop import FilterTrainConfig, init_filter_state, make_filter_step, stack_maps
from dsom_jax.training.memory import keep_freed_memory
from dsom_jax.training.options import override
from dsom_jax.training.sequences import make_windows, plan_paths


@dataclass(frozen=True)
class TrainFilterArgs:
    """Train PF-Net or PFRNN.

    Attributes:
        filter: which of the two.
        config: YAML file with fields of FilterTrainConfig that differ from the defaults.
        maps: map.yaml files to train in; default: the two test maps of synthetic-v1, as the paper trains its baselines.
        init: checkpoint whose weights to start from.
        minutes: time to train; the number of steps is set after the first few.
        steps: number of steps, in place of minutes.
        out: folder for the checkpoint, the training state and metrics.jsonl; default: runs/ and the filter's name.
        resume: continue the run in the folder ``out``, or start it if there is none yet.
        save_minutes: time between checkpoints.
        save_steps: steps between checkpoints, in place of save_minutes.
    """

    filter: Literal["pf_net", "pfrnn"]
    config: Path | None = None
    maps: tuple[Path, ...] = ()
    init: Path | None = None
    minutes: float = 20.0
    steps: int | None = None
    out: Path | None = None
    resume: bool = False
    save_minutes: float = 3.0
    save_steps: int | None = None

    def __post_init__(self) -> None:
        check_length(self)

    @property
    def folder(self) -> Path:
        """Where the run lives."""
        return self.out or Path("runs") / self.filter.replace("_", "-")

    @property
    def kind(self) -> str:
        """Of the network."""
        return self.filter

    def read_config(self, given: Any, where: str) -> FilterTrainConfig:
        """The configuration of this filter with the fields of ``given``."""
        return override(FilterTrainConfig(model=KINDS[self.filter].config()), given, where)

    def read_maps(self, run: Run) -> list[OccupancyGrid]:
        """Maps of ``run`` at the network's resolution, their frames at their lower-left corners."""
        if run.maps:
            return load_maps(tuple(map(Path, run.maps)), run.config.model.resolution)
        return list({name: grid for name, grid, _ in load_suite("synthetic-v1").episodes}.values())


def _make_batches(run: Run, grids: list[OccupancyGrid]) -> tuple[Callable[[int, int], Any], Any]:
    """(step, total) -> batch of that step, and the maps that are cropped."""
    config, resolution = run.config, grids[0].resolution
    pool, root = plan_paths(config.seed, grids, config.data), jax.random.key(config.seed + 1)
    sizes = {"resolution": resolution, "count": config.batch, "strays": config.particles}

    @jax.jit
    def batch(step: jax.Array) -> Any:
        return make_windows(jax.random.fold_in(root, step), pool, config.data, **sizes)

    return lambda step, total: batch(jnp.int32(step)), stack_maps(pool, resolution)


def filter_parts(run: Run, material: Material) -> Parts:
    """Batches, step and evaluation of a run."""
    grids = [replace(grid, origin=jnp.zeros(3)) for grid in material.grids]
    batches, places = _make_batches(run, grids)
    step, evaluate = make_filter_step(run.config, places), make_tracking(run.config, grids)
    state = first_state(run, init_filter_state(run.config, material.network))
    return Parts(batches, step, evaluate, state, ("prediction", "prediction"))


def main() -> None:
    """Entry point."""
    args = parse(TrainFilterArgs, "python -m dsom_jax.train_filter")
    keep_freed_memory()
    run, material = open_run(args)
    train(args, run, lambda: filter_parts(run, material))


if __name__ == "__main__":
    run_cli(main)
