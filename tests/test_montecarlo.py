"""Runs of a small but real particle filter: same numbers alone, in a batch, and spread over devices."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dsom_jax import montecarlo
from dsom_jax.episode import Episode
from dsom_jax.resampling import draw_ancestors
from dsom_jax.types import Inputs


class Info(NamedTuple):
    mean: Any
    cluster: Any
    lost: Any


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Toy:
    """Particles (n, 3) weighed by a made-up scan: sums, logs, cumulative sums, sorting, products and gathers."""

    table: Any
    n: int = field(default=203, metadata={"static": True})

    def begin(self):
        return ()

    def prepare(self, memory, inputs: Inputs):
        kernel = inputs.ranges[:9].reshape(3, 3, 1, 1)
        layout = ("NHWC", "HWIO", "NHWC")
        image = jax.lax.conv_general_dilated(
            self.table[None, :, :, None], kernel, (1, 1), "SAME", dimension_numbers=layout
        )
        return jax.nn.softmax(image.ravel()), memory

    def init(self, key):
        return jax.random.uniform(key, (self.n, 3), maxval=10.0)

    def step(self, key, state, inputs, prepared):
        k_move, k_pick, k_new = jax.random.split(key, 3)
        poses = state + inputs.odometry + 0.3 * jax.random.normal(k_move, state.shape)
        beams = jnp.sin(poses[:, :1] * jnp.linspace(0.1, 3.0, 72)) - inputs.ranges[0]
        score = ((0.9 * jnp.exp(-(beams**2)) + 0.01) ** 3).sum(-1)
        weights = jax.nn.softmax(jnp.log(score) + jnp.log1p(prepared[:1] @ jnp.ones((1, self.n))))
        near = jax.lax.top_k(-((poses[:, None] - poses) ** 2).sum(-1), 3)[0].sum(-1)
        weights = weights * jnp.exp(0.01 * near)
        poses = poses[draw_ancestors(k_pick, weights, self.n)]
        redrawn = jax.random.categorical(k_new, jnp.log(prepared), shape=(self.n,))
        poses = poses.at[::10, 0].set(redrawn[::10] / 100.0)
        info = Info(jnp.einsum("n,nd->d", weights, poses), jnp.std(poses, axis=0), jnp.cumsum(weights)[-1])
        return poses, info


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Walk(Toy):
    """The least of a filter, quick to compile."""

    n: int = field(default=7, metadata={"static": True})

    def prepare(self, memory, inputs):
        return self.table.sum() + inputs.ranges[0], memory

    def step(self, key, state, inputs, prepared):
        poses = state + inputs.odometry + 0.3 * jax.random.normal(key, state.shape)
        return poses, Info(poses.mean(0), poses[0], prepared)


def episode(steps: int = 5, seed: int = 0) -> Episode:
    rng = np.random.default_rng(seed)
    ranges, odometry = rng.uniform(0, 1, (steps, 12)), rng.normal(0, 0.1, (steps, 3))
    as_float = (jnp.asarray(x, jnp.float32) for x in (ranges, odometry, np.zeros((steps, 3))))
    return Episode(*as_float, jnp.zeros(steps, bool), jnp.arange(steps, dtype=jnp.float32))


def toy(seed: int = 0) -> Toy:
    return Toy(jax.random.normal(jax.random.key(seed), (16, 16)))


def walk(seed: int = 0) -> Walk:
    return Walk(toy(seed).table)


def same(a: Any, b: Any) -> None:
    jax.tree.map(np.testing.assert_array_equal, a, b)


def test_shapes():
    result = montecarlo.run(walk(), episode(), montecarlo.run_keys(0, 0, 4), keep=(0, 3))
    assert result.info.mean.shape == (4, 5, 3) and result.info.lost.shape == (4, 5)
    assert result.state.shape == (4, 7, 3) and result.kept.shape == (2, 7, 3)


def test_against_a_plain_loop():
    result = montecarlo.run(walk(), episode(), montecarlo.run_keys(0, 0, 2))
    key = montecarlo.run_keys(0, 0, 2)[1]
    filter, drive = walk(), episode()
    state = filter.init(jax.random.fold_in(key, 0))
    for t in range(5):
        inputs = Inputs(drive.ranges[t], drive.odometry[t], jnp.int32(t))
        state, info = filter.step(jax.random.fold_in(key, t + 1), state, inputs, filter.prepare((), inputs)[0])
        np.testing.assert_allclose(result.info.mean[1, t], info.mean, atol=1e-5)
    np.testing.assert_allclose(result.state[1], state, atol=1e-5)


def test_an_increment_that_is_no_number_moves_no_particle():
    drive, keys = episode(), montecarlo.run_keys(0, 0, 2)
    spoilt, still = (drive._replace(odometry=drive.odometry.at[2].set(row)) for row in ([0.1, jnp.nan, 0.2], 0.0))
    same(montecarlo.run(walk(), spoilt, keys), montecarlo.run(walk(), still, keys))


@pytest.mark.parametrize("runs", [1, 3])
def test_run_r_of_a_batch_equals_the_same_run_alone_bit_for_bit(runs):
    keys = montecarlo.run_keys(0, 0, 33)
    batch = montecarlo.run(toy(), episode(), keys)
    part = montecarlo.run(toy(), episode(), keys[-runs:])
    same(jax.tree.map(lambda leaf: leaf[-runs:], batch), part)


def test_a_memory_is_carried_once_for_all_runs():
    @jax.tree_util.register_dataclass
    @dataclass(frozen=True)
    class Sum(Walk):
        def begin(self):
            return jnp.zeros(12)

        def prepare(self, memory, inputs):
            return (memory + inputs.ranges)[0], memory + inputs.ranges

    info = montecarlo.run(Sum(walk().table), episode(), montecarlo.run_keys(0, 0, 3)).info
    expected = np.broadcast_to(np.cumsum(np.asarray(episode().ranges)[:, 0]), (3, 5))
    np.testing.assert_allclose(info.lost, expected, rtol=1e-6)


def test_same_seed_same_bits():
    same(*(montecarlo.run(walk(), episode(), montecarlo.run_keys(7, 1, 5)) for _ in range(2)))


def test_keys_depend_on_seed_episode_and_run_alone():
    data = jax.random.key_data(montecarlo.run_keys(1, 2, 100))
    same(data[:3], jax.random.key_data(montecarlo.run_keys(1, 2, 3)))
    others = [jax.random.key_data(montecarlo.run_keys(*seed, 100)) for seed in ((1, 3), (2, 2))]
    assert len(np.unique(np.concatenate([data, *others]), axis=0)) == 300


def test_one_trace_for_maps_and_episodes_of_one_shape():
    chex.clear_trace_counter()

    @jax.tree_util.register_dataclass
    @dataclass(frozen=True)
    class Counted(Walk):
        step = chex.assert_max_traces(n=1)(Walk.step)

    for seed in range(3):
        montecarlo.run(Counted(walk(seed).table, 21), episode(seed=seed), montecarlo.run_keys(seed, 0, 3))
    with pytest.raises(AssertionError):
        montecarlo.run(Counted(walk().table, 22), episode(), montecarlo.run_keys(0, 0, 3))


def test_prepare_is_computed_once_per_update_for_all_runs():
    calls = []

    @jax.tree_util.register_dataclass
    @dataclass(frozen=True)
    class Watched(Walk):
        def prepare(self, memory, inputs):
            jax.debug.callback(calls.append, inputs.index)
            return super().prepare(memory, inputs)

    jax.block_until_ready(montecarlo.run(Watched(walk().table, 21), episode(), montecarlo.run_keys(0, 0, 9)))
    jax.effects_barrier()
    assert len(calls) == 5 * jax.device_count()


def test_kept_states_are_those_of_run_0_after_the_update():
    keys = montecarlo.run_keys(0, 0, 3)
    whole = montecarlo.run(walk(), episode(), keys, keep=(1, 4))
    start = jax.tree.map(lambda leaf: leaf[:2], episode())
    same(whole.kept[0], montecarlo.run(walk(), start, keys).state[0])
    same(whole.kept[1], whole.state[0])
    assert montecarlo.run(walk(), episode(), keys).kept is None


def test_no_runs_are_refused():
    with pytest.raises(ValueError, match="at least one"):
        montecarlo.run(walk(), episode(), montecarlo.run_keys(0, 0, 0))


def test_signature_tells_what_is_compiled_anew():
    base = montecarlo.signature(walk(), episode())
    assert base == montecarlo.signature(walk(1), episode(seed=1))
    assert hash(base) == hash(montecarlo.signature(walk(1), episode()))
    assert base != montecarlo.signature(replace(walk(), n=5), episode())
    assert base != montecarlo.signature(walk(), episode(6))


CHILD = """
import sys
import jax, numpy as np
import test_montecarlo as t
assert jax.device_count() == 2
result = t.montecarlo.run(t.toy(), t.episode(), t.montecarlo.run_keys(0, 0, 7), keep=(2,))
np.savez(sys.argv[1], *jax.tree.leaves(result))
"""


@pytest.mark.slow
def test_two_devices_give_the_same_numbers(tmp_path):
    flags = os.environ.get("XLA_FLAGS", "") + " --xla_force_host_platform_device_count=2"
    path = os.pathsep.join([os.path.dirname(__file__), *filter(None, [os.environ.get("PYTHONPATH")])])
    env = os.environ | {
        "XLA_FLAGS": flags,
        "PYTHONPATH": path,
        "JAX_PLATFORMS": "cpu",
        "JAX_DISABLE_MOST_OPTIMIZATIONS": "0",
    }
    file = tmp_path / "two.npz"
    subprocess.run([sys.executable, "-c", CHILD, str(file)], env=env, check=True, timeout=120)
    # An odd number of runs: the last device is filled up, and the filling cut off.
    here = montecarlo.run(toy(), episode(), montecarlo.run_keys(0, 0, 7), keep=(2,))
    there = list(np.load(file).values())
    same(jax.tree.leaves(here), there)
