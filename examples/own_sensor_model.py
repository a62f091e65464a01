"""A sensor model of one's own in AdaM robust: ``python examples/own_sensor_model.py``."""

from __future__ import annotations

from dataclasses import dataclass, replace

import jax.numpy as jnp
from own_map import LIDAR, last_error, room

import dsom_jax as dj


@dataclass(frozen=True)
class Laplace(dj.SensorModel):
    """Beams err by a Laplace distribution: an error of 2 m is not much worse than one of 1 m."""

    scale: float = 0.2  # metres
    worst: float = 2.0  # errors count as at most this
    temper: float = 0.1  # neighbouring beams are not independent

    def log_likelihood(self, tables, poses, ranges):
        reach = tables.lidar.range_max
        expected = jnp.minimum(tables.expected(poses), reach)  # (..., B), +inf is no wall
        error = jnp.minimum(jnp.abs(jnp.minimum(ranges, reach) - expected), self.worst)
        valid = ranges > -jnp.inf  # neither NaN nor too close
        return -self.temper * jnp.where(valid, error / self.scale, 0.0).sum(-1)


if __name__ == "__main__":
    settings = replace(dj.Settings(particles=100), robust_sensor=Laplace())
    proposal = dj.make_proposal("likelihood_grid", room(), LIDAR, settings)
    error = last_error(dj.make_filter("adam_robust", proposal, room(), LIDAR, settings))
    print(f"error at the end: {error:.2f} m")
    assert error < 0.5
