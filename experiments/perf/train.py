"""Speed of training and inference: ``python experiments/perf/train.py [--width 32]``.

Prints samples/s and GFLOP/s (convolutions and matrix products as XLA counts them) of one training step at the default
batch, the time to make a batch, and the time of one scan on a 128 x 128 map whose features are cached. Where torch is
installed the same network takes the same batch in PyTorch, by turns with JAX, and the ratios are printed. Goals:
training at 0.8 of PyTorch's speed or more; inference in 30 ms or less and no slower than PyTorch.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from importlib.util import find_spec
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from timing import machine, measure, save

from dsom_jax.compiling import run_options
from dsom_jax.nn import create, encode_map, evaluation_view, log_probability_map
from dsom_jax.nn.panorama import expected_ranges, view_features
from dsom_jax.training.batches import Batch
from dsom_jax.training.loop import TrainConfig, init_state, make_batches, make_step
from dsom_jax.training.memory import keep_freed_memory
from dsom_jax.training.target import dense, make_target, pooled

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


def expected_views(config: TrainConfig, occupied: Any) -> np.ndarray:
    """What the panorama of PyTorch's network is given: views of maps (N, H, W)."""
    return np.asarray(view_features(jax.vmap(lambda one: expected_ranges(one, config.model))(occupied), config.model))


def torch_training(config: TrainConfig, batch: Batch) -> Call:
    """The same step in PyTorch."""
    import torch_dsom

    observe = jax.vmap(jax.vmap(lambda r, c: create(config.model).observation(r, config.scan.lidar, c)))
    scans = np.asarray(observe(batch.ranges, batch.conditions)).swapaxes(2, 3).copy()
    views = expected_views(config, batch.occupied)
    shape = (batch.free.shape[1], batch.free.shape[2])
    target = make_target(batch.poses, shape, config.model.headings, config.model.resolution, config.blur)
    free = batch.free[:, None]
    truths, masks = [], []
    for factor in (1, 2, 8):
        truth = dense(target, free) if factor == 1 else pooled(target, free, factor)
        n, s, h, w, k = truth.shape
        open_ = np.asarray(batch.free).reshape(n, h, factor, w, factor).any((2, 4))
        masks.append(np.repeat(open_, s, 0)[:, None].copy())
        truths.append(np.moveaxis(np.asarray(truth).reshape(n * s, h, w, k), -1, 1).copy())
    return torch_dsom.make_step(
        config.model, np.asarray(batch.occupied, np.float32), views, scans, truths, masks
    )  # fmt: skip


def torch_inference(config: TrainConfig, occupied: Any, ranges: Any) -> Call:
    """The same scan in PyTorch."""
    import torch_dsom

    scan = np.asarray(create(config.model).observation(ranges, config.scan.lidar)).T[None].copy()
    views = expected_views(config, occupied[None])
    return torch_dsom.make_inference(config.model, np.asarray(occupied, np.float32)[None], views, scan)


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
    if find_spec("torch"):
        calls |= {
            "torch_step": torch_training(config, batch),
            "torch_inference": torch_inference(config, occupied, ranges),
        }
    results = {name: measure(call, repeats) for name, call in calls.items()}
    samples = config.early.worlds * config.early.scans
    for name, times in results.items():
        more = f"  {1e3 * samples / times['wall_ms']:.1f} samples/s" if name.endswith("step") else ""
        more += f"  {1e3 * work / times['wall_ms']:.0f} GFLOP/s ({work:.0f} GFLOP)" if name == "step" else ""
        print(f"{name:16s}{times['wall_ms']:8.1f} ms{more}")
    ratios = {
        name: results[f"torch_{name}"]["wall_ms"] / results[name]["wall_ms"]
        for name in ("step", "inference")
        if f"torch_{name}" in results
    }
    for name, ratio in ratios.items():
        print(f"speed of {name} over PyTorch's: {ratio:.2f}")
    record = {"machine": machine(), "width": width, "gflop": work, "times": results, "speed_over_torch": ratios}
    save("train", record)


if __name__ == "__main__":
    tyro.cli(main)
