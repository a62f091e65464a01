"""The step learns, repeats itself exactly, and starts large worlds when it should."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dsom_jax.nn import DSOMConfig
from dsom_jax.occupancy import from_cells
from dsom_jax.training.batches import ScanConfig
from dsom_jax.training.descent import learning_rate
from dsom_jax.training.loop import (
    StageConfig,
    TrainConfig,
    init_state,
    late_start,
    make_batches,
    make_step,
)

SCAN = ScanConfig(beams=36, reach_min=5.0, obstacles=(0, 0))
CONFIG = TrainConfig(
    model=DSOMConfig(width=4, headings=8, fov_min=SCAN.fov_min, reach_min=SCAN.reach_min),
    scan=SCAN,
    early=StageConfig(16, 1, 4),
    late=StageConfig(24, 1, 2),
    late_share=0.5,
    learning_rate=1e-2,
    warmup=5,
)
ROOM = jnp.zeros((24, 24), bool).at[::23].set(True).at[:, ::23].set(True).at[6:9, 5].set(True)


@pytest.fixture(scope="module")
def tools():
    return make_batches(CONFIG, [from_cells(ROOM, resolution=CONFIG.model.resolution)]), make_step(CONFIG)


def run(tools, steps):
    batches, step = tools
    state, losses = init_state(CONFIG), []
    for number in range(steps):
        state, metrics = step(state, batches(0, 100), jnp.int32(1000))
        losses.append(float(metrics["kld"]))
        assert int(state.step) == number + 1
    return state, losses


def test_learns_one_batch_by_heart_and_repeats_bit_for_bit(tools):
    state, losses = run(tools, 40)
    assert losses[-1] < 0.6 * losses[0] and np.isfinite(losses).all()
    again, losses_again = run(tools, 40)
    assert losses == losses_again
    jax.tree.map(np.testing.assert_array_equal, state, again)


def test_step_is_compiled_once_for_each_stage(tools):
    batches, step = tools
    run(tools, 2)
    step(init_state(CONFIG), batches(99, 100), jnp.int32(100))
    assert step._cache_size() <= 2


def test_full_size_worlds_come_last(tools):
    assert late_start(CONFIG, 100) == 50
    assert tools[0](49, 100).free.shape == (1, 16, 16) and tools[0](50, 100).free.shape == (1, 24, 24)


def test_rate_warms_up_and_decays_to_zero():
    rates = [float(learning_rate(CONFIG, jnp.int32(s), jnp.int32(100))) for s in (0, 4, 5, 52, 100)]
    np.testing.assert_allclose(rates, [0.002, 0.01, 0.01, 0.005, 0.0], atol=2e-4)


def test_config_does_not_promise_more_than_it_trains():
    with pytest.raises(ValueError, match="promise"):
        TrainConfig(model=DSOMConfig(fov_min=1.0, reach_min=5.0))
    with pytest.raises(ValueError, match="multiple of 8"):
        StageConfig(cells=12)
