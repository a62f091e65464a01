"""The paper's scan encoder learns from the polar one: ``python experiments/dsom/distil.py --teacher checkpoints/dsom``.

From places alone the paper's network learns little in the hours that two cores allow (``REPORT.md``). Here its coarse
SIM follows that of a trained network, cell by cell and heading by heading, besides the truth; the map encoder and what
fits of the decoder begin with the teacher's weights. What comes out begins the training with Eq 5, by ``train --init``.
All other options, and what the folder holds, are those of ``python -m dsom_jax.train``.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import nnx

from dsom_jax import checkpoint
from dsom_jax.cli import parse
from dsom_jax.errors import UserError, run_cli
from dsom_jax.nn import DSOM, create
from dsom_jax.nn.dsom import MapFeatures
from dsom_jax.train import TrainArgs, dsom_parts
from dsom_jax.trainer import Material, open_run, train
from dsom_jax.training.batches import Batch
from dsom_jax.training.loop import TrainConfig, make_step, split_model
from dsom_jax.training.loss import PLACE_AXES, similarity_loss
from dsom_jax.training.memory import keep_freed_memory
from dsom_jax.training.target import make_target
from dsom_jax.types import Array

LIKENESS = 10.0
"""Weight of the correlation with the teacher's SIM beside the cross-entropies."""


@dataclass(frozen=True)
class Args(TrainArgs):
    """Train the encoders of a network after those of another."""

    teacher: Path = checkpoint.SHIPPED
    """Checkpoint of a network of the same width, headings and scale."""


def read_teacher(path: Path, config: TrainConfig) -> DSOM:
    """The network to imitate; UserError if its features are not of the student's size and scale."""
    teacher: DSOM = checkpoint.load(path, resolution=config.model.resolution)
    for name in ("width", "headings"):
        own, wanted = getattr(teacher.config, name), getattr(config.model, name)
        if own != wanted:
            raise UserError(
                f"--teacher {path}: field model.{name} is {own}, the run's is {wanted}; give another --config"
            )
    return teacher


def begun(student: DSOM, teacher: DSOM) -> DSOM:
    """``student`` with the teacher's map encoder, and of its decoder the weights for inputs that both have."""
    graph, *own = split_model(student)
    for mine, given in zip(own, split_model(teacher)[1:], strict=True):
        mine["environment"]["stages"] = jax.tree.map(jnp.copy, given["environment"]["stages"])
        mine["decoder"] = jax.tree.map(common, mine["decoder"], given["decoder"])
    return nnx.merge(graph, *own)


def common(mine: Array, given: Array) -> Array:
    """The leading part of ``given`` that has the shape of ``mine``: further inputs come last."""
    return jnp.copy(given[tuple(slice(0, size) for size in mine.shape)])


def coarse(model: DSOM, batch: Batch, config: TrainConfig) -> Array:
    """Coarse SIM (N, S, h, w, K), sharpened; without panorama and decoder."""
    features, indices = model.environment(batch.occupied)
    observe = jax.vmap(jax.vmap(lambda r, c: model.observation(r, config.scan.lidar, c)))
    maps = MapFeatures(features, indices, None, batch.free)
    return model.similarity(maps, observe(batch.ranges, batch.conditions)).coarse


def standard(x: Array) -> Array:
    """Each SIM of x (N, S, h, w, K) with mean zero and length one."""
    x = x - x.mean(PLACE_AXES, keepdims=True)
    return x * jax.lax.rsqrt((x * x).sum(PLACE_AXES, keepdims=True) + 1e-6)


def imitation(similarity: Array, given: Array) -> tuple[Array, Array]:
    """How far SIM is from the teacher's (N, S, h, w, K): mean correlation, and cross-entropy of the softmaxes."""
    truth = jax.nn.softmax(given, axis=PLACE_AXES)
    entropy = -(truth * jax.nn.log_softmax(similarity, axis=PLACE_AXES)).sum(PLACE_AXES)
    return (standard(similarity) * standard(given)).sum(PLACE_AXES).mean(), entropy.mean()


class Imitation(NamedTuple):
    """Means over a batch: what is minimised, both parts of :func:`imitation`, and the cross-entropy to the truth."""

    total: Array
    likeness: Array
    imitated: Array
    similarity: Array


def losses(model: DSOM, batch: Batch, config: TrainConfig, teacher: DSOM) -> Imitation:
    """What takes the place of Eq 5 and its auxiliary loss."""
    similarity, given = coarse(model, batch, config), coarse(teacher, batch, config)
    likeness, imitated = imitation(similarity, jax.lax.stop_gradient(given))
    shape = (batch.free.shape[1], batch.free.shape[2])
    target = make_target(batch.poses, shape, config.model.headings, config.model.resolution, config.blur)
    found = similarity_loss(similarity, target, batch.free[:, None])
    return Imitation(LIKENESS * (1 - likeness) + imitated + found, likeness, imitated, found)


def main() -> None:
    """Entry point."""
    args = parse(Args, "python experiments/dsom/distil.py")
    keep_freed_memory()
    run, material = open_run(args)
    teacher = read_teacher(args.teacher, run.config)
    # As `--init` does, a run that has saved a state goes on from that.
    first = None if run.states() else begun(create(run.config.model, run.config.seed), teacher)
    step = make_step(run.config, partial(losses, teacher=teacher))
    begun_with = Material(material.grids, first)
    train(args, run, lambda: dsom_parts(run, begun_with)._replace(step=step, shown=("likeness", "r")))


if __name__ == "__main__":
    run_cli(main)
