"""Speed of training and inference: ``python experiments/perf/train.py [--width 32] [--encoder polar]``.

Prints samples/s and GFLOP/s (convolutions and matrix products as XLA counts them) of one training step at the default
batch, the time to make a batch, and the time of one scan on a 128 x 128 map whose features are cached.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any, Literal

import jax
import jax.numpy as jnp
import tyro

from dsom_jax.nn import create, encode_map, evaluation_view, log_probability_map
from dsom_jax.training.loop import TrainConfig, compiler_options, init_state, make_batches, make_step
from dsom_jax.training.memory import keep_freed_memory


def seconds(call: Callable[[], Any], repeats: int) -> float:
    """Median time of a call after a first one."""
    jax.block_until_ready(call())
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        jax.block_until_ready(call())
        times.append(time.perf_counter() - start)
    return sorted(times)[repeats // 2]


def training(config: TrainConfig, repeats: int) -> None:
    """Print the speed of a batch and of a step."""
    batches, step = make_batches(config), make_step(config)
    batch = batches(0, 1000)
    compiled = step.lower(init_state(config), batch, jnp.int32(1000)).compile()
    state = init_state(config)

    def one() -> Any:
        nonlocal state
        state, metrics = compiled(state, batch, jnp.int32(1000))
        return metrics

    spent, samples = seconds(one, repeats), config.early.worlds * config.early.scans
    work = (compiled.cost_analysis() or {}).get("flops", float("nan")) / 1e9
    print(f"batch       {1e3 * seconds(lambda: batches(0, 1000), repeats):8.1f} ms")
    speed = f"{samples / spent:.1f} samples/s  {work / spent:.0f} GFLOP/s ({work:.0f} GFLOP)"
    print(f"step        {1e3 * spent:8.1f} ms  {speed}")


def inference(config: TrainConfig, repeats: int) -> None:
    """Print the time of one scan on a cached map."""
    model = evaluation_view(create(config.model))
    occupied = jax.random.uniform(jax.random.key(0), (128, 128)) < 0.1
    features = jax.jit(encode_map)(model, occupied)
    ranges = jax.random.uniform(jax.random.key(1), (360,), maxval=10.0)
    for name, options in (("", {}), (" (XLA's own convolutions)", compiler_options())):
        scan = jax.jit(log_probability_map, static_argnums=3, compiler_options=options)
        spent = seconds(lambda scan=scan: scan(model, features, ranges, config.scan.lidar), repeats)
        print(f"inference   {1e3 * spent:8.1f} ms  128 x 128 x {config.model.headings}{name}")


def main(width: int = 32, encoder: Literal["polar", "paper"] = "polar", repeats: int = 7) -> None:
    """Measure and print."""
    print(f"memory kept between steps: {keep_freed_memory()}; devices: {jax.devices()}; width {width}, {encoder}")
    config = TrainConfig()
    config = replace(config, model=replace(config.model, width=width, encoder=encoder))
    training(config, repeats)
    inference(config, repeats)


if __name__ == "__main__":
    tyro.cli(main)
