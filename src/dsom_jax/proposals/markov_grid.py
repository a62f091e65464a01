"""Grid localization (Probabilistic Robotics, Table 8.1) as a proposal: a likelihood grid that remembers.

One scan on a floor plan, or in a corridor, fits many places; a drive fits few. The belief over the whole (x, y, theta)
grid is moved by the odometry and multiplied by the likelihood of every scan. It is the same for all particles and all
runs, so it is computed once per update.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import jax
import jax.numpy as jnp

from dsom_jax import checks
from dsom_jax import pose_grid as pg
from dsom_jax.geometry import rotate
from dsom_jax.proposals.likelihood_grid import LikelihoodGrid
from dsom_jax.types import Array, Inputs, Key


@dataclass(frozen=True)
class MarkovGridConfig:
    """How the belief moves, beyond what the odometry says.

    Attributes:
        kidnap: probability of being carried anywhere between two updates.
        slip: probability that the robot stood still, or drove back what the odometry reports as forth.
    """

    kidnap: float = 1e-9
    slip: float = 0.1

    def __post_init__(self) -> None:
        checks.share(self, "kidnap", excluding="()")
        checks.share(self, "slip", excluding=")")


class Recollection(NamedTuple):
    """Belief about the pose at one update, as PMs: before the scan, and after it."""

    prior: pg.ProbabilityMap
    posterior: pg.ProbabilityMap


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class MarkovGrid:
    """Proposal that draws from the belief after all scans so far.

    Beliefs are densities (C, K) at the free cells of the likelihood grid, zero at the cells that fill up C.

    Attributes:
        likelihood: what each scan says, and the cells.
        config: static.
    """

    likelihood: LikelihoodGrid
    config: MarkovGridConfig = field(default=MarkovGridConfig(), metadata={"static": True})

    def begin(self) -> Array:
        """Belief before the first update: even over free space."""
        even = jnp.broadcast_to(self._real(), (self.likelihood.cells.size, self.likelihood.config.headings))
        return even / jnp.maximum(even.sum(), 1)

    def _real(self) -> Array:
        """Which of the cells (C, 1) are cells, not filling."""
        return (self.likelihood.cells < self.likelihood.free.size)[:, None]

    def prepare(self, memory: Array, inputs: Inputs) -> tuple[Recollection, Array]:
        """Belief (C, K) of the update before -> PMs of this one, and its belief."""
        # An increment that is not a number tells nothing, and would make all beliefs to come none: nothing moves.
        known = jnp.isfinite(inputs.odometry).all()
        still = (inputs.index == 0) | ~known
        moved = jnp.where(still, memory, self.predict(memory, jnp.where(known, inputs.odometry, 0.0)))
        prior = (1 - self.config.kidnap) * normalised(moved) + self.config.kidnap * self.begin()
        log_prior = jnp.log(prior)
        log_posterior = log_prior + self.evidence(inputs)
        posterior = pg.exp_or_zero(log_posterior - log_posterior.max())
        maps = (self.likelihood.probability_map(v) for v in (log_prior, log_posterior))
        return Recollection(*maps), normalised(posterior)

    def around(self, pose: Array, covariance: Array) -> Array:
        """Belief (C, K) that is Gaussian about a base pose (3,); no narrower than a cell."""
        return self.likelihood.around(pose, covariance)

    def evidence(self, inputs: Inputs) -> Array:
        """(C, K) what one scan says: the tempered log-likelihood."""
        return self.likelihood.log_likelihood(inputs.ranges)

    def sample(self, key: Key, prepared: Recollection, n: int) -> tuple[Array, Array]:
        """``n`` base poses (n, 3) from the belief after the scan, and their log densities."""
        return self.likelihood.sample(key, prepared.posterior, n)

    def log_prior(self, prepared: Recollection, poses: Array) -> Array:
        """Log density (...) of the belief before the scan at base poses (..., 3) in 1 / (m^2 rad)."""
        return self.likelihood.log_density(prepared.prior, poses)

    def predict(self, belief: Array, odometry: Array) -> Array:
        """Belief (C, K) moved by a body-frame increment (3,); what would leave free space is lost."""
        grid, cells = self.likelihood.pose_grid, self.likelihood.cells
        mount = jnp.array(self.likelihood.lidar.mount)[:2]
        # Cells are those of the sensor, which a turn of the base moves, too.
        swing = jnp.stack(rotate(odometry[2], *mount)) - mount
        theta = pg.heading(grid, jnp.arange(grid.headings))
        steps = (swing + odometry[:2], swing - odometry[:2])
        shifts = (jnp.stack(rotate(theta, *step)[::-1]) / grid.resolution for step in steps)
        full = jnp.zeros((self.likelihood.free.size + 1, grid.headings)).at[cells].set(belief)
        forth, back = (_shifted(full, cells, (grid.height, grid.width), s) for s in shifts)
        moved = (1 - self.config.slip) * forth + self.config.slip / 2 * (back + belief)
        return jnp.where(self._real(), turned(moved, odometry[2] / grid.turn), 0.0)


def normalised(belief: Array) -> Array:
    """Belief of sum one."""
    return belief / jnp.maximum(belief.sum(), 1e-30)


def spline(offset: Array) -> tuple[Array, Array]:
    """Nearest whole number () to ``offset`` and the weights (3, ...) of it and its neighbours.

    Quadratic B-splines: interpolation and a blur with standard deviation half a cell in one.
    """
    whole = jnp.round(offset)
    rest = offset - whole
    weights = jnp.stack([0.5 * (0.5 - rest) ** 2, 0.75 - rest**2, 0.5 * (0.5 + rest) ** 2])
    return whole.astype(jnp.int32), weights


def _shifted(full: Array, cells: Array, shape: tuple[int, int], shift: Array) -> Array:
    """Belief (C, K) of ``cells`` (C,) after heading k moved by ``shift`` (2, K) cells along y and x.

    ``full`` (H * W + 1, K) is the belief before, its last row zero.
    """
    (rows, of_row), (cols, of_col) = (spline(s) for s in shift)
    i, j = jnp.divmod(cells, shape[1])
    headings = jnp.arange(full.shape[1])
    flat, total = full.reshape(-1), jnp.zeros((cells.size, full.shape[1]))
    for a in range(3):
        for b in range(3):
            y, x = i[:, None] - (rows + a - 1), j[:, None] - (cols + b - 1)
            inside = (y >= 0) & (y < shape[0]) & (x >= 0) & (x < shape[1])
            source = jnp.where(inside, y * shape[1] + x, full.shape[0] - 1) * full.shape[1] + headings
            total += of_row[a] * of_col[b] * flat.at[source].get(mode="promise_in_bounds")
    return total


def turned(belief: Array, bins: Array) -> Array:
    """Belief (C, K) turned by a number of heading bins ()."""
    whole, weights = spline(bins)
    return jnp.stack([w * jnp.roll(belief, whole + a - 1, axis=1) for a, w in enumerate(weights)]).sum(0)
