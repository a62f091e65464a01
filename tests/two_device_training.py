"""Losses of a few steps; test_training_sharding runs this in a process of its own, too, which prints them as JSON."""

from __future__ import annotations

import json
import sys

import jax
import jax.numpy as jnp

from dsom_jax.nn import DSOMConfig
from dsom_jax.occupancy import from_cells
from dsom_jax.training.batches import ScanConfig
from dsom_jax.training.loop import StageConfig, TrainConfig, init_state, make_batches, make_step
from dsom_jax.training.sharding import data_mesh, replicate, spread

SCAN = ScanConfig(beams=36, reach_min=5.0, obstacles=(0, 0))
ROOM = jnp.zeros((48, 48), bool).at[::47].set(True).at[:, ::47].set(True).at[12:18, 10].set(True)
"""At half of the network's cells, so that batches carry the views of the finer map."""


def losses(worlds: int, scans: int, steps: int = 6) -> list[float]:
    """KLD of the first steps."""
    model = DSOMConfig(width=4, headings=8, panorama=True, fov_min=SCAN.fov_min, reach_min=SCAN.reach_min)
    stage = StageConfig(16, worlds, scans)
    config = TrainConfig(model=model, scan=SCAN, early=stage, late=stage, warmup=5)
    mesh, batches = data_mesh(), make_batches(config, [from_cells(ROOM, resolution=model.resolution / 2)])
    state, step, found = replicate(init_state(config), mesh), make_step(config), []
    for number in range(steps):
        batch = spread(batches(number, 100), mesh)
        assert batch.views is not None
        if mesh.size > 1:
            shares = {shard.data.shape for shard in batch.poses.addressable_shards}
            assert shares == {(worlds // 2, scans, 3) if worlds % 2 == 0 else (worlds, scans // 2, 3)}, shares
        state, metrics = step(state, batch, jnp.int32(100))
        found.append(float(metrics["kld"]))
    return found


if __name__ == "__main__":
    assert jax.device_count() == 2
    print(json.dumps([losses(*case) for case in json.loads(sys.argv[1])]))
