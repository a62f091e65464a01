"""A proposal of one's own in AdaM robust: ``python examples/own_proposal.py``."""

from __future__ import annotations

from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
from own_map import LIDAR, last_error, room

import dsom_jax as dj


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Hedged:
    """The likelihood grid, but for a share of draws from anywhere, in case it is wrong."""

    inner: dj.proposals.LikelihoodGrid
    space: dj.proposals.FreeSpace
    share: float = field(default=0.1, metadata={"static": True})

    def begin(self):
        return self.inner.begin()  # the memory before the first scan; () for none

    def prepare(self, memory, inputs):
        return self.inner.prepare(memory, inputs)  # once per scan, for all particles of all runs; and the memory after

    def sample(self, key, pm, n):
        k_coin, k_pm, k_space = jax.random.split(key, 3)
        likely, _ = self.inner.sample(k_pm, pm, n)
        anywhere, log_u = self.space.sample(k_space, None, n)
        poses = jnp.where((jax.random.uniform(k_coin, (n,)) < self.share)[:, None], anywhere, likely)
        log_likely = jnp.log1p(-self.share) + self.inner.log_density(pm, poses)
        return poses, jnp.logaddexp(log_likely, jnp.log(self.share) + log_u)


if __name__ == "__main__":
    settings = dj.Settings(particles=100)
    likelihood = dj.make_proposal("likelihood_grid", room(), LIDAR, settings)
    proposal = Hedged(likelihood, dj.proposals.free_space(room()))
    error = last_error(dj.make_filter("adam_robust", proposal, room(), LIDAR, settings))
    print(f"error at the end: {error:.2f} m")
    assert error < 0.5
