"""Deliberate faults in the core, each with the tests that have to notice it."""

# ruff: noqa: E501

from __future__ import annotations

from typing import NamedTuple


class Fault(NamedTuple):
    """Text of a file of the package that is replaced, and the tests (files of ``tests/``, a ``-k`` expression) to run."""

    file: str
    old: str
    new: str
    tests: str
    only: str = ""


FAULTS = (
    # Poses
    Fault("geometry.py", "wrap_angle(a[..., 2] + b[..., 2])], axis=-1)", "a[..., 2] + b[..., 2]], axis=-1)", "test_geometry.py"),
    Fault("geometry.py", "wrap_angle(b[..., 2] - a[..., 2])], axis=-1)", "b[..., 2] - a[..., 2]], axis=-1)", "test_geometry.py"),
    Fault("geometry.py", "return c * x - s * y, s * x + c * y", "return c * x + s * y, s * x + c * y", "test_geometry.py"),
    Fault("geometry.py", "rotate(-a[..., 2], b", "rotate(a[..., 2], b", "test_geometry.py"),
    Fault("geometry.py", "(weights * jnp.sin(angles)).sum(-1)", "jnp.sin(angles).sum(-1)", "test_geometry.py"),
    # Drives
    Fault("motion.py", "travel < 0.01, 0.0", "travel < 0.1, 0.0", "test_motion.py"),
    Fault("motion.py", "jnp.abs(wrap_angle(r - jnp.pi))) for r in turns", "jnp.abs(r - jnp.pi)) for r in turns", "test_motion.py"),
    Fault("motion.py", "self.alpha3 * travel**2 + self.alpha4", "self.alpha4 * travel**2 + self.alpha3", "test_motion.py"),
    Fault("motion.py", "by_travel = self.alpha2 * travel**2", "by_travel = self.alpha2 * travel", "test_motion.py"),
    Fault("motion.py", "minval=-1.2", "minval=0.0", "test_motion.py"),
    Fault("motion.py", "< self.tail, self.tail_scale", "> self.tail, self.tail_scale", "test_motion.py"),
    Fault("motion.py", "[self.alpha5, self.alpha4]", "[self.alpha3, self.alpha4]", "test_motion.py"),
    Fault("motion.py", "alpha5=drive.alpha3", "alpha5=drive.alpha4", "test_motion.py"),
    # Sensors
    Fault("sensor.py", "jnp.isposinf(ranges) & jnp.isposinf(expected)", "jnp.isposinf(ranges) | jnp.isposinf(expected)", "test_sensor.py"),
    Fault("sensor.py", "+ model.beta / model.range_max) ** model.power", "+ model.beta) ** model.power", "test_sensor.py"),
    Fault("sensor.py", "return ranges > -jnp.inf", "return ranges > -1e9", "test_sensor.py"),
    Fault("sensor.py", "jnp.where(no_wall, model.z_hit + model.z_max, model.z_max)", "model.z_max", "test_sensor.py"),
    Fault("sensor.py", "jnp.where(ranges < reach, 1.0", "jnp.where(ranges > reach, 1.0", "test_sensor.py"),
    Fault("sensor.py", "return model.temper * beam_log_terms", "return beam_log_terms", "test_sensor.py"),
    Fault("sensor.py", "return model.temper * jnp.where(valid", "return jnp.where(valid", "test_sensor.py"),
    Fault("sensor.py", "return self.temper * jnp.log(self.weigh", "return jnp.log(self.weigh", "test_sensor.py"),
    Fault("sensor.py", "jnp.exp(evidence - jnp.where(jnp.isfinite(best), best, 0.0))", "jnp.exp(evidence)", "test_sensor.py"),
    Fault("sensor.py", "euclidean_distance(grid.occupied, cap) * grid.resolution", "euclidean_distance(grid.occupied, cap)", "test_sensor.py"),
    # Resampling
    Fault("resampling.py", "width) - 1] <= scaled)", "width) - 1] < scaled)", "test_resampling.py"),
    Fault("resampling.py", "scaled = jnp.minimum(positions * total, jnp.nextafter(total, jnp.zeros_like(total)))", "scaled = positions * total", "test_resampling.py"),
    Fault("resampling.py", "jnp.arange(n) + jax.random.uniform(key)) / n", "jnp.arange(n) + jax.random.uniform(key, (n,))) / n", "test_resampling.py"),
    Fault("resampling.py", "ratio = log_weights - jnp.log(", "ratio = log_weights + jnp.log(", "test_resampling.py"),
    # Rays
    Fault("marching.py", "np.ceil(slopes[1:] * (column + 1) + 1 + _NUDGE)", "np.ceil(slopes[1:] * column + 1)", "test_raycast.py", "wedges"),
    Fault("marching.py", "first = np.floor(slopes[:-1] * np.maximum(column - 1, 0))", "first = np.floor(slopes[:-1] * (column + 1))", "test_raycast.py", "wedges"),
    Fault("marching.py", "columns = side - 1.0", "columns = side", "test_raycast.py", "wedges"),
    # Clusters and estimates
    Fault("filters/common.py", "for _ in range(2):", "for _ in range(0):", "test_filters.py", "cluster"),
    Fault("filters/common.py", "candidates[jnp.argmax(mass)]", "candidates[0]", "test_filters.py", "cluster"),
    Fault("filters/common.py", "cluster, 1.0 - mass, redrawn", "cluster, mass, redrawn", "test_filters.py", "robust_finds"),
    Fault("filters/common.py", "jnp.where(total > 0, weights / jnp.where(total > 0, total, 1.0), 1.0 / weights.shape[0])", "weights / total", "test_filters_guards.py"),
    # MCL, Mixture MCL, Alg 1
    Fault("filters/mcl.py", "return poses.at[slots].set(fresh[:count])", "return poses", "test_filters.py", "injects"),
    Fault("filters/mcl.py", "round(self.injection * self.config.particles)", "self.config.particles", "test_filters.py", "mcl"),
    Fault("filters/mixture.py", "(jax.random.uniform(k_split) < self.p) | (state.updates == 0)", "jax.random.uniform(k_split) < self.p", "test_filters.py", "mixture"),
    Fault("filters/mixture.py", "jax.random.uniform(k_split) < self.p", "jax.random.uniform(k_split) > self.p", "test_filters.py", "mixture"),
    Fault("filters/adam.py", "high = (state.updates == 0) | trusted", "high = trusted", "test_filters.py", "first_update"),
    Fault("filters/adam.py", "(trust > t_cut) | (", "(", "test_filters.py", "trust_decides"),
    Fault("filters/adam.py", "jax.random.uniform(key, trust.shape) < trust", "jax.random.uniform(key, trust.shape) < t_cut", "test_filters.py", "trust_decides"),
    Fault("filters/updates.py", "mass = jnp.where(member, normalised, 0.0)", "mass = normalised", "test_filters.py", "descend"),
    Fault("filters/updates.py", "(rank % count + jax.random.uniform(key)) / count", "rank / count", "test_filters.py test_filters_exact.py", "algorithm or known"),
    Fault("filters/updates.py", "return poses, state.weights[parents]", "return poses, state.weights", "test_filters.py", "predecessor"),
    Fault("filters/updates.py", "closeness = 1.0 / (jnp.sqrt(squared) + 1e-6)", "closeness = jnp.ones_like(squared)", "test_filters.py", "predecessor"),
    Fault("filters/updates.py", "_NEIGHBOURS = 3", "_NEIGHBOURS = 1", "test_filters.py", "predecessor"),
    Fault("filters/updates.py", "jnp.minimum(turn, 2 * jnp.pi - turn) ** 2", "turn**2", "test_filters.py", "predecessor"),
    Fault("filters/updates.py", "(weights / weights.max()) ** power", "weights**power", "test_filters.py", "tiny"),
    Fault("filters/updates.py", "powered(weights, config.estimate_power), redrawn", "powered(weights, 1.0), redrawn", "test_filters.py", "own"),
    Fault("filters/updates.py", "powered(weights, config.weight_power), state", "powered(weights, config.estimate_power), state", "test_filters.py", "raised"),
    Fault("filters/updates.py", "poses = jnp.where(dead, spare, draw.poses)", "poses = draw.poses", "test_filters_guards.py", "vanished"),
    Fault("filters/world.py", "self.sensor.log_likelihood(self.tables, poses, ranges[:: self.beam_step])", "self.sensor.log_likelihood(self.tables, poses, 1.1 * ranges[:: self.beam_step])", "test_filters_exact.py"),
    # AdaM robust
    Fault("filters/adam_robust.py", "prior = jnp.where(state.updates == 0, 0.0, jnp.log(self.config.kidnap))", "prior = 0.0", "test_filters_exact.py"),
    Fault("filters/adam_robust.py", "return jnp.log1p(-self.config.kidnap)", "return 0.0", "test_filters_exact.py"),
    Fault("filters/adam_robust.py", "- log_q - jnp.log(low.sum()))", "- jnp.log(low.sum()))", "test_filters_exact.py"),
    Fault("filters/adam_robust.py", "(state.log_weights - log_r)[ancestors]", "(0.0 * log_r)[ancestors]", "test_filters_exact.py"),
    Fault("filters/adam_robust.py", "log_r = resampling_log_weights(state.log_weights, self.config.flatten)", "log_r = resampling_log_weights(state.log_weights, 0.0)", "test_filters_exact.py"),
    Fault("filters/adam_robust.py", "self.config.caution * state.lost", "0.0 * state.lost", "test_filters.py", "leaves_out"),
    Fault("filters/adam_robust.py", "1.0 - self.config.caution * state.lost", "1.0 + self.config.caution * state.lost", "test_filters.py", "leaves_out"),
    Fault("filters/adam_robust.py", "is_free(self.world.grid, poses), self.world.space.log_density_value, -jnp.inf)", "is_free(self.world.grid, poses), self.world.space.log_density_value, 0.0)", "test_filters_guards.py", "stand"),
    Fault("filters/adam_robust.py", "share = jnp.clip(state.lost, self.config.low_min, self.config.low_max)", "share = self.config.low_min", "test_filters.py test_markov_grid.py", "leaves_out or shares"),
    # Memory
    Fault("filters/adam_memory.py", "return jnp.log1p(-self._share(state))", "return 0.0", "test_markov_grid.py", "shares or counts"),
    Fault("filters/adam_memory.py", "jnp.clip(state.lost, *self.share)", "self.share[0]", "test_markov_grid.py", "counts"),
    Fault("proposals/markov_grid.py", "+ self.config.kidnap * self.begin()", "", "test_markov_grid.py", "carried"),
    Fault("proposals/markov_grid.py", "(1 - self.config.slip) * forth + self.config.slip / 2 * (back + belief)", "forth", "test_markov_grid.py", "motion"),
    Fault("proposals/markov_grid.py", "log_posterior = log_prior + self.evidence(inputs)", "log_posterior = log_prior", "test_markov_grid.py", "bayes"),
    Fault("proposals/markov_grid.py", "still = (inputs.index == 0) | ~known", "still = ~known", "test_markov_grid.py", "number"),
    # Proposals
    Fault("proposals/uniform.py", "(2 * u[2] - 1) * jnp.pi", "u[2] * jnp.pi", "test_proposals.py", "uniform or free"),
    Fault("proposals/likelihood_grid.py", "return self.config.model.temper * self.evidence", "return self.evidence", "test_proposals.py"),
    # Runs
    Fault("montecarlo.py", "step_keys = _fold(keys, inputs.index + 1)", "step_keys = _fold(keys, inputs.index)", "test_montecarlo.py", "plain_loop"),
    Fault("montecarlo.py", "jnp.isfinite(inputs.odometry).all(), inputs.odometry, 0.0", "True, inputs.odometry, 0.0", "test_montecarlo.py", "no_number"),
    Fault("montecarlo.py", "lambda leaf: leaf[keep][None], shown", "lambda leaf: leaf[keep - 1][None], shown", "test_montecarlo.py", "kept"),
)  # fmt: skip
