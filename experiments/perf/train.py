"""Speed of training and inference: ``python experiments/perf/train.py [--width 32]``.

Prints samples/s and GFLOP/s (convolutions and matrix products as XLA counts them) of one training step at the default
batch, the time to make a batch, and the time of one scan on a 128 x 128 map whose features are cached. Goal: inference
in 30 ms or less. (PyTorch's times in the report are of a twin of the network that stood here until commit de96c41.)
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import tyro
from timing import machine, measure, save

from dsom_jax.compiling import run_options
from dsom_jax.nn import create, encode_map, evaluation_view, log_probability_map
from dsom_jax.training.batches import Batch
from dsom_jax.training.loop import TrainConfig, init_state, make_batches, make_step
from dsom_jax.training.memory import keep_freed_memory

Call = Callable[[], Any]


def training(config: TrainConfig, batch: Batch) -> tuple[Call, float]:
    """One step on ``batch``, and its GFLOP."""
    step: Any = make_step(config)
    compiled = step.lower(init_state(config), batch, jnp.int32(1000)).compile()
    state = init_state(config)

    def one() -> Any:
        nonlocal state
        state, metrics = compiled(state, batch, jnp.int32(1000))
        return metrics

    return one, (compiled.cost_analysis() or {}).get("flops", float("nan")) / 1e9


def inference(config: TrainConfig, occupied: Any, ranges: Any) -> Call:
    """One scan on a map with cached features."""
    model = evaluation_view(create(config.model))
    features = jax.jit(encode_map)(model, occupied)
    scan = jax.jit(log_probability_map, static_argnums=3, compiler_options=run_options())
    return lambda: scan(model, features, ranges, config.scan.lidar)


def main(width: int = 32, repeats: int = 9) -> None:
    """Measure and print."""
    print(f"memory kept between steps: {keep_freed_memory()}; devices: {jax.devices()}; width {width}")
    config = TrainConfig()
    config = replace(config, model=replace(config.model, width=width))
    batches = make_batches(config)
    batch = jax.block_until_ready(batches(0, 1000))
    occupied = jax.random.uniform(jax.random.key(0), (128, 128)) < 0.1
    ranges = jax.random.uniform(jax.random.key(1), (360,), maxval=10.0)
    step, work = training(config, batch)
    calls = {"batch": lambda: batches(0, 1000), "step": step, "inference": inference(config, occupied, ranges)}
    results = {name: measure(call, repeats) for name, call in calls.items()}
    samples = config.early.worlds * config.early.scans
    for name, times in results.items():
        more = f"  {1e3 * samples / times['wall_ms']:.1f} samples/s" if name.endswith("step") else ""
        more += f"  {1e3 * work / times['wall_ms']:.0f} GFLOP/s ({work:.0f} GFLOP)" if name == "step" else ""
        print(f"{name:16s}{times['wall_ms']:8.1f} ms{more}")
    record = {"machine": machine(), "width": width, "gflop": work, "times": results}
    save("train", record)


if __name__ == "__main__":
    tyro.cli(main)
