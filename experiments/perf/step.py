"""Time of one filter update and of its parts: ``python experiments/perf/step.py [--repeats 15]``.

Reference load: 100 runs x 200 particles x 72 beams on a 128 x 128 map of synthetic-v1, PM given, the state that the
filter has after a few updates, compiled as :func:`dsom_jax.montecarlo.run` compiles. Parts are compiled on their own,
so they need not add up: inside of the step XLA fuses some of them. Goal for AdaM: <= 40 ms, aiming at 20.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import tyro
from timing import machine, measure, save

from dsom_jax import montecarlo
from dsom_jax.compiling import run_options
from dsom_jax.data.suite import load_suite
from dsom_jax.episode import Episode
from dsom_jax.filters import updates
from dsom_jax.filters.adam_robust import resampling_log_weights
from dsom_jax.filters.common import describe
from dsom_jax.filters.methods import build_filter
from dsom_jax.resampling import pick
from dsom_jax.sensor import beam_log_likelihood, beam_score
from dsom_jax.types import Inputs, prepare_alone

METHODS = {"adam": "adam_sharp_likelihood_grid", "mcl": "mcl_sharp", "robust": "robust_likelihood_grid"}
Parts = dict[str, tuple[Callable[..., Any], tuple[Any, ...]]]
"""Name -> (function of one run, its arguments, of which the leading axis is the run)."""


def main(runs: int = 100, particles: int = 200, repeats: int = 15, warm: int = 8, only: tuple[str, ...] = ()) -> None:
    """Measure, print and save."""
    suite = load_suite("synthetic-v1")
    _, grid, episode = suite.episodes[0]
    measured = {}
    for name, method in METHODS.items():
        if only and name not in only:
            continue
        filter = build_filter(method, grid, suite.lidar, particles=particles, t_cut=0.6)
        measured[name] = method_times(name, filter, episode, runs, repeats, warm)
        print(
            f"{name}: " + ", ".join(f"{k} {v['wall_ms']:.1f} ({v['cpu_ms']:.1f})" for k, v in measured[name].items()),
            flush=True,
        )
    print("milliseconds of all runs together: median wall clock (processor time / cores)")
    load = {"runs": runs, "particles": particles, "beams": 72, "map": list(grid.shape), "repeats": repeats}
    save("step", {"machine": machine(), "load": load, "methods": measured})


def method_times(
    name: str, filter: Any, episode: Episode, runs: int, repeats: int, warm: int
) -> dict[str, dict[str, float]]:
    """Times of the whole step, of ``prepare``, and of the parts of the step."""
    keys = montecarlo.run_keys(0, 0, runs)
    first = jax.tree.map(lambda leaf: leaf[:warm], episode)
    states = montecarlo.run(filter, first, keys).state
    now = jax.tree.map(lambda leaf: leaf[warm], episode.inputs)
    prepare, step = compiled(prepare_alone), compiled(all_runs)
    prepared = prepare(filter, now)
    times = {"step": measure(lambda: step(filter, keys, states, now, prepared), repeats)}
    if prepared is not None:
        times["prepare"] = measure(lambda: prepare(filter, now), repeats)
    split = robust_parts if name.startswith("robust") else score_parts
    for name, (function, arguments) in split(filter, keys, states, now, prepared).items():
        part = compiled(jax.vmap(function))
        times[name] = measure(partial(part, *arguments), repeats)
    whole = measure(lambda: montecarlo.run(filter, first, keys), 3)
    return times | {"whole_run_per_update": {k: v / warm for k, v in whole.items()}}


def compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    """``function`` under jit, with the options of the Monte-Carlo runs."""
    return jax.jit(function, compiler_options=run_options())


def all_runs(filter: Any, keys: Any, states: Any, now: Inputs, prepared: Any) -> Any:
    """One update of every run."""
    return jax.vmap(lambda key, state: filter.step(key, state, now, prepared))(keys, states)


def score_parts(filter: Any, keys: Any, states: Any, now: Inputs, prepared: Any) -> Parts:
    """Parts of the paper's filters."""
    world, config = filter.world, filter.config
    member = jnp.ones(states.weights.shape, bool)
    expected = compiled(world.tables.expected)(states.poses)
    seen = now.ranges[:: world.beam_step]
    parts: Parts = {
        "resample": (lambda k, s, m: updates.masked_ancestors(k, s.normalised, m, config.resampling),
                     (keys, states, member)),
        "move": (lambda k, s: world.motion.sample(k, s.poses, now.odometry), (keys, states)),
        "rays": (lambda s: world.tables.expected(s.poses), (states,)),
        "score": (lambda e: beam_score(seen, e, world.sensor), (expected,)),
        "rays_and_score": (lambda s: world.weigh(s.poses, now.ranges), (states,)),
        "estimates": (lambda s: describe(s.poses, s.normalised, jnp.float32(0.0), jnp.bool_(False)), (states,)),
    }  # fmt: skip
    if prepared is not None:
        fresh, _ = compiled(jax.vmap(lambda k: filter.proposal.sample(k, prepared, config.particles)))(keys)
        parts["draw_once"] = (lambda k: filter.proposal.sample(k, prepared, config.particles), (keys,))
        parts["knn"] = (lambda k, p, s: updates._by_distance(k, p, s.poses), (keys, fresh, states))
    return parts


def robust_parts(filter: Any, keys: Any, states: Any, now: Inputs, prepared: Any) -> Parts:
    """Parts of AdaM robust."""
    world, count = filter.world, filter.config.particles
    expected = compiled(world.tables.expected)(states.poses)
    seen = now.ranges[:: world.beam_step]

    def resample(key: Any, state: Any) -> Any:
        log_r = resampling_log_weights(state.log_weights, filter.config.flatten)
        return pick(jnp.cumsum(jnp.exp(log_r)), (jnp.arange(count) + jax.random.uniform(key)) / count)

    return {
        "resample": (resample, (keys, states)),
        "move": (lambda k, s: world.motion.sample(k, s.poses, now.odometry), (keys, states)),
        "draw_once": (lambda k: filter.proposal.sample(k, prepared, count), (keys,)),
        "rays": (lambda s: world.tables.expected(s.poses), (states,)),
        "likelihood": (lambda e: beam_log_likelihood(seen, e, world.sensor), (expected,)),
        "estimates": (
            lambda s: describe(s.poses, jnp.exp(s.log_weights), jnp.float32(0.0), jnp.bool_(False)),
            (states,),
        ),
    }


if __name__ == "__main__":
    tyro.cli(main)
