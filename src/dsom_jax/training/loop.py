"""The training loop's device side: configuration, state, one jitted step. It is called from a plain Python loop."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import nnx

from dsom_jax import checks
from dsom_jax.compiling import training_options
from dsom_jax.nn import DSOM, DSOMConfig, create
from dsom_jax.occupancy import OccupancyGrid
from dsom_jax.simulate.worlds import WorldConfig
from dsom_jax.training.batches import Batch, ScanConfig, make_batch
from dsom_jax.training.buildings import (
    WorldSource,
    crop_side,
    crop_source,
    make_pool,
    mixed_source,
    procedural_source,
)
from dsom_jax.training.descent import descend, follow_average, optimizer
from dsom_jax.training.loss import Losses, dsom_losses
from dsom_jax.training.target import make_target
from dsom_jax.types import Array


@dataclass(frozen=True)
class StageConfig:
    """Sizes of a batch.

    Attributes:
        cells: side of the square worlds, a multiple of 8.
        worlds: buildings in a batch.
        scans: scans in each building; they share one pass of the environment encoder.
    """

    cells: int = 64
    worlds: int = 4
    scans: int = 16

    def __post_init__(self) -> None:
        checks.count(self, "cells worlds scans")
        if self.cells % 8:
            raise ValueError(checks.message(self, "cells", "give a multiple of 8"))


def _default_model() -> DSOMConfig:
    """A network that promises what the default scans train it for."""
    return DSOMConfig(channels=16, panorama=True, fov_min=ScanConfig.fov_min, reach_min=ScanConfig.reach_min)


@dataclass(frozen=True)
class TrainConfig:
    """Everything that determines a training run together with its number of steps.

    Attributes:
        model: the network.
        scan: simulated scans.
        world: procedural buildings (its ``cells`` and ``resolution`` are taken from the stage and the model).
        maps_share: where maps are given, the share of buildings that are crops of them; the rest are procedural.
        early: small batches that most steps use.
        late: full-size worlds that the last steps use.
        late_share: share of the steps on ``late``.
        learning_rate: peak of Adam's rate, warm-up then cosine decay to zero.
        warmup: steps to the peak.
        clip: largest norm of the gradient.
        blur: sigma of the ground truth, cells; the paper's is 3, which spreads a third of PM beyond 1 m of the truth.
        similarity_weight: weight of the cross-entropy on SIM beside Eq 5.
        ema: decay of the averaged weights that are shipped.
        seed: of weights and data.
    """

    model: DSOMConfig = field(default_factory=_default_model)
    scan: ScanConfig = ScanConfig()
    world: WorldConfig = WorldConfig()
    maps_share: float = 1.0
    early: StageConfig = StageConfig()
    late: StageConfig = StageConfig(cells=128, worlds=1, scans=16)
    late_share: float = 0.1
    learning_rate: float = 1e-3
    warmup: int = 100
    clip: float = 5.0
    blur: float = 1.0
    similarity_weight: float = 1.0
    ema: float = 0.995
    seed: int = 0

    def __post_init__(self) -> None:
        checks.share(self, "maps_share late_share")
        checks.share(self, "ema", excluding=")")
        checks.positive(self, "learning_rate clip blur")
        checks.not_negative(self, "similarity_weight")
        checks.count(self, "warmup seed", 0)
        checks.within(self, "seed", 0, 2**31 - 1, "give less than 2^31")
        if self.model.fov_min < self.scan.fov_min - 1e-6 or self.model.reach_min < self.scan.reach_min - 1e-6:
            raise ValueError("model.fov_min and model.reach_min promise scans that scan.* does not draw")


class TrainState(NamedTuple):
    """All that a step changes; saved and restored, training continues bit for bit.

    Attributes:
        step: () int32, steps done.
        params: weights.
        stats: batch-norm statistics.
        optimizer: moments of Adam.
        average: exponential average of (params, stats).
    """

    step: Array
    params: Any
    stats: Any
    optimizer: Any
    average: Any


def split_model(model: DSOM) -> tuple[Any, Any, Any]:
    """Graph definition, pure params and pure batch statistics."""
    parts: Any = nnx.split(model, nnx.Param, nnx.BatchStat)
    graphdef, params, stats = parts
    return graphdef, nnx.as_pure(params), nnx.as_pure(stats)


def init_state(config: TrainConfig, model: DSOM | None = None) -> TrainState:
    """State before the first step, from fresh weights or those of ``model``."""
    _, params, stats = split_model(create(config.model, config.seed) if model is None else model)
    # The average gets buffers of its own: the step donates all of the state.
    average = jax.tree.map(jnp.copy, (params, stats))
    return TrainState(jnp.zeros((), jnp.int32), params, stats, optimizer(config).init(params), average)


def averaged_model(config: TrainConfig, state: TrainState) -> DSOM:
    """The network that is shipped: averaged weights, evaluation view."""
    graphdef = split_model(nnx.eval_shape(lambda: create(config.model)))[0]
    return nnx.view(nnx.merge(graphdef, *state.average), use_running_average=True)


def _batch_losses(model: DSOM, batch: Batch, config: TrainConfig) -> Losses:
    """Losses of a batch under a training view."""
    observe = partial(model.observation, lidar=config.scan.lidar)
    observations = jax.vmap(jax.vmap(lambda r, c: observe(r, conditions=c)))(batch.ranges, batch.conditions)
    outputs = model(batch.occupied, observations, batch.views)
    shape = (batch.free.shape[1], batch.free.shape[2])
    target = make_target(batch.poses, shape, config.model.headings, config.model.resolution, config.blur)
    return dsom_losses(outputs, target, batch.free, config.similarity_weight)


def make_step(
    config: TrainConfig, measure: Callable[[DSOM, Batch, TrainConfig], Any] = _batch_losses
) -> Callable[[TrainState, Batch, Array], tuple[TrainState, dict[str, Array]]]:
    """The jitted step: (state, batch, total steps) -> (state, metrics). The state given is consumed.

    ``measure`` gives a named tuple whose ``total`` is minimised; all of it becomes metrics.
    """
    graphdef = split_model(nnx.eval_shape(lambda: create(config.model)))[0]

    def objective(params: Any, stats: Any, batch: Batch) -> tuple[Array, tuple[Any, Any]]:
        model = nnx.merge(graphdef, params, stats)
        losses = measure(model, batch, config)
        return losses.total, (losses, nnx.as_pure(nnx.state(model, nnx.BatchStat)))

    def step(state: TrainState, batch: Batch, total: Array) -> tuple[TrainState, dict[str, Array]]:
        (_, (losses, stats)), gradient = jax.value_and_grad(objective, has_aux=True)(state.params, state.stats, batch)
        params, moments, facts = descend(config, state.step, total, state.params, state.optimizer, gradient)
        average = follow_average(config, state.step, state.average, (params, stats))
        return TrainState(state.step + 1, params, stats, moments, average), {**losses._asdict(), **facts}

    return jax.jit(step, donate_argnums=0, compiler_options=training_options())


def world_source(config: TrainConfig, stage: StageConfig, grids: list[OccupancyGrid] | None = None) -> WorldSource:
    """Procedural buildings, crops of ``grids``, or some of both.

    ``grids`` have one resolution: the model's, or a finer one if nothing is mixed with them.
    """
    if grids and config.maps_share == 1.0:
        scale, own = config.model.resolution, grids[0].resolution
        fine = own if own < scale - 1e-4 else None
        return crop_source(make_pool(grids, crop_side(stage.cells, scale, fine or scale)), stage.cells, scale, fine)
    world = replace(config.world, cells=stage.cells, resolution=config.model.resolution)
    procedural = procedural_source(world, config.scan.bare)
    if not grids:
        return procedural
    crops = crop_source(make_pool(grids, stage.cells), stage.cells, config.model.resolution)
    return mixed_source(crops, procedural, config.maps_share)


def make_batches(config: TrainConfig, grids: list[OccupancyGrid] | None = None) -> Callable[[int, int], Batch]:
    """(step, total) -> batch of that step: a function of the seed and the step alone, so that it can be resumed."""
    root = jax.random.key(config.seed + 1)

    def stage_maker(stage: StageConfig) -> Callable[[Array], Batch]:
        source = world_source(config, stage, grids)
        return jax.jit(
            lambda step: make_batch(
                jax.random.fold_in(root, step), source, config.scan, stage.worlds, stage.scans, config.model
            )
        )

    early, late = stage_maker(config.early), stage_maker(config.late)
    return lambda step, total: (late if step >= late_start(config, total) else early)(jnp.int32(step))


def late_start(config: TrainConfig, total: int) -> int:
    """First step on full-size worlds."""
    return total - round(config.late_share * total)
