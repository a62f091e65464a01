"""A filter of one's own, run, judged and drawn as all others: ``python examples/own_filter.py``."""

from __future__ import annotations

from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
from own_map import LIDAR, last_error, room

import dsom_jax as dj


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class GridOnly:
    """Grid localization without any particle of its own: each answer is drawn from the belief after all scans."""

    belief: dj.proposals.MarkovGrid
    samples: int = field(default=200, metadata={"static": True})

    def begin(self):
        return self.belief.begin()  # one memory for all runs

    def prepare(self, memory, inputs):
        return self.belief.prepare(memory, inputs)

    def init(self, key):
        return jnp.int32(0)  # the state of one run: here only the number of updates

    def step(self, key, state, inputs, prepared):
        poses, _ = self.belief.sample(key, prepared, self.samples)
        even = jnp.full(self.samples, 1 / self.samples)
        return state + 1, dj.filters.describe(poses, even, jnp.float32(1), jnp.bool_(False))


if __name__ == "__main__":
    settings = dj.Settings()
    error = last_error(GridOnly(dj.make_proposal("markov_grid", room(), LIDAR, settings)))
    print(f"error at the end: {error:.2f} m")
    assert error < 0.5
