"""Which place: grid localization (Probabilistic Robotics, Table 8.1) that knows a place off the map, and looks where
the mass is.

The belief is a mass for each free cell and heading, and one for "not on this map". Every update moves it by the
odometry and multiplies it by what the scan says. While nearly all of it lies in a few cells, only these and those that
they can reach are moved and judged; as soon as the scan speaks against all of them, the whole grid is judged again.

What is exact and what is not: moving and judging are Bayes' rule on the cells, for the beam model to a power (the
temper), as neighbouring beams and scans taken one after another err alike. A focus begins where it leaves out at most
``_SPILT`` of the mass; what it cannot reach later is left out until it ends. A scan counts as much as it is new
(:func:`novelty`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import NamedTuple

import jax
import jax.numpy as jnp

from dsom_jax import pose_grid as pg
from dsom_jax.belief.focus import first_set, rows_ahead
from dsom_jax.belief.grid_memory import GridBeliefConfig, Memory, Places
from dsom_jax.belief.moving import moved_everywhere, moved_mass
from dsom_jax.belief.pool import Pool, draw, even
from dsom_jax.geometry import compose
from dsom_jax.occupancy import OccupancyGrid, dilate, pad
from dsom_jax.proposals.likelihood_grid import LikelihoodGrid, beam_choice
from dsom_jax.proposals.markov_grid import normalised
from dsom_jax.types import Array, Inputs, Key

_SPILT = 1e-4
"""Mass outside of the focus above which there is none."""
_FAINT = 1e-7
"""Share of the mass below which a row is empty."""
_AWAY = 0.02
"""Mass off the map from which on the whole grid is judged."""
_NEWS = 0.25
"""Novelty of a scan below which the belief waits for more."""


class _Judged(NamedTuple):
    """The belief after one way of updating it, but for the whole grid; fields as in :class:`Memory`."""

    rows: Array
    focus: Array
    held: Array
    focused: Array
    off: Array
    pool: Pool


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class GridBelief:
    """Proposal that draws from the belief after all scans so far.

    Attributes:
        likelihood: cells, expected ranges and sensor model.
        row_of: (H * W + 1,) row of each cell in the belief, C for what is not free.
        frontier: (C, 1) share of those who enter the map that come in here.
        config: static.
    """

    likelihood: LikelihoodGrid
    row_of: Array
    frontier: Array
    config: GridBeliefConfig = field(default=GridBeliefConfig(), metadata={"static": True})

    def begin(self) -> Memory:
        """Belief before the first update: even over free space."""
        count, headings = self._shape
        nothing = jnp.zeros(self.config.pool)
        pool = Pool(nothing.astype(jnp.int32), nothing.astype(jnp.int32), nothing, nothing)
        rows = jnp.full(self.config.rows, count, jnp.int32)
        scan = jnp.full(self.likelihood.lidar.beams, jnp.nan)
        focus = jnp.zeros((self.config.rows, headings))
        no = jnp.bool_(False)
        return Memory(self._even(), rows, focus, no, no, jnp.float32(0.0), pool, scan, jnp.zeros(3))

    def around(self, pose: Array, covariance: Array) -> Memory:
        """Belief that is Gaussian about a base pose (3,); no narrower than a cell."""
        return self.begin()._replace(mass=self.likelihood.around(pose, covariance))

    @property
    def _shape(self) -> tuple[int, int]:
        return self.likelihood.cells.size, self.likelihood.config.headings

    def _real(self) -> Array:
        """Which of the cells (C, 1) are cells, not filling, as numbers."""
        return (self.likelihood.cells < self.likelihood.free.size)[:, None].astype(jnp.float32)

    def _even(self) -> Array:
        """(C, K) the same mass everywhere."""
        return jnp.broadcast_to(self._real() / jnp.maximum(self._real().sum() * self._shape[1], 1), self._shape)

    def prepare(self, memory: Memory, inputs: Inputs) -> tuple[Places, Memory]:
        """Belief of the update before -> what this one makes of it, and its belief."""
        first = inputs.index == 0
        told = jnp.where(jnp.isfinite(inputs.odometry).all() & ~first, inputs.odometry, 0.0)
        odometry = compose(memory.pending, told)
        unseen = jnp.isnan(memory.scan).all()  # as after a pose that was told
        fresh = jnp.where(first | unseen, 1.0, novelty(memory.scan, inputs.ranges, odometry))
        counts = fresh > _NEWS
        rows, fits = rows_ahead(self.likelihood, self.row_of, memory.rows, memory.focus, odometry, self.config.reach)
        near = memory.focused & fits & ~first
        judged = jax.lax.cond(counts & near, self._near, self._waiting, memory, rows, odometry, inputs.ranges, fresh)
        # A loop of one turn or none: unlike a branch, it leaves the mass of the whole grid where it is.
        whole = jax.lax.while_loop(
            lambda state: state[0],
            lambda state: (jnp.bool_(False), *self._everywhere(memory, state[1], odometry, inputs.ranges, fresh)),
            (counts & ~near, memory.mass, judged),
        )
        _, mass, judged = whole
        scan, pending = jnp.where(counts, inputs.ranges, memory.scan), jnp.where(counts, 0.0, odometry)
        stride = max(1, self.config.pool // self.config.samples)
        cell, k = judged.pool.cell[::stride], judged.pool.heading[::stride]
        poses = self.likelihood.poses_in(cell, k, even(cell.size, 3))
        places = Places(judged.pool, poses, judged.off, jnp.where(counts, fresh, 0.0))
        return places, Memory(mass, **judged._asdict(), scan=scan, pending=pending)

    def _waiting(self, memory: Memory, rows: Array, odometry: Array, ranges: Array, fresh: Array) -> _Judged:
        """Nothing new: the belief as it was."""
        pool = memory.pool._replace(log_prior=memory.pool.log_posterior)
        return _Judged(memory.rows, memory.focus, memory.held, memory.focused, memory.off, pool)

    def _near(self, memory: Memory, rows: Array, odometry: Array, ranges: Array, fresh: Array) -> _Judged:
        """All mass stays within ``rows`` (M,), the cells that it can reach."""
        count, size = self._shape[0], self.row_of.size
        cells = self.likelihood.cells.at[rows].get(mode="fill", fill_value=size - 1)
        old = self.likelihood.cells.at[memory.rows].get(mode="fill", fill_value=size)
        slot = jnp.full(size, self.config.rows, jnp.int32).at[old].set(jnp.arange(self.config.rows), mode="drop")
        moved = moved_mass(self.likelihood, memory.focus, slot, cells, odometry, self.config.slip)
        # Without the barrier XLA moves the mass once for its sum, and again for its shares.
        moved = jax.lax.optimization_barrier(moved)
        # Where all of it would leave free space, it stays near.
        moved = jnp.where((rows < count)[:, None], moved + 1e-12, 0.0)
        away = self._away(memory)
        prior = (1 - away) * normalised(moved)
        posterior, off, level = self._bayes(prior, away, ranges, fresh, rows)
        focused = (off < _AWAY) & (level > self.config.fits)
        # Rows that have become empty need no following.
        by_row = posterior.sum(-1)
        rows = jnp.where(by_row > _FAINT, rows, count)
        focus = jnp.where((rows < count)[:, None], posterior, 0.0)
        pool = draw(self.likelihood, cells, prior, posterior, self.config.pool)
        return _Judged(rows, focus, jnp.bool_(True), focused, off, pool)

    def _everywhere(
        self, memory: Memory, mass: Array, odometry: Array, ranges: Array, fresh: Array
    ) -> tuple[Array, _Judged]:
        """All cells moved and judged; here those who are carried away, or come back, come down.

        ``mass`` (C, K) is that of ``memory``.
        """
        mass = jax.lax.cond(memory.held, lambda: self._spread(memory.rows, memory.focus), lambda: mass)
        moved = jax.lax.cond(
            (odometry == 0).all(),
            lambda: mass,
            lambda: moved_everywhere(self.likelihood, mass, odometry, self.config.slip) * self._real(),
        )
        away, even = self._away(memory), self._even()
        back = memory.off * self.config.enter / 2 * (even + self.frontier / self._shape[1])
        prior = (1 - away) * normalised((1 - memory.off) * normalised(moved) + back + self.config.kidnap * even)
        posterior, off, level = self._bayes(prior, away, ranges, fresh)
        by_row = posterior.sum(-1)
        holds = by_row > _FAINT * by_row.sum()
        rows = first_set(holds, self.config.rows)
        held = jnp.where(holds, by_row, 0.0).sum() >= (1 - _SPILT) * by_row.sum()
        focused = held & (holds.sum() <= self.config.rows) & (off < _AWAY) & (level > self.config.fits)
        focus = posterior.at[rows].get(mode="fill", fill_value=0.0)
        pool = draw(self.likelihood, self.likelihood.cells, prior, posterior, self.config.pool)
        return posterior, _Judged(rows, focus, focused, focused, off, pool)

    def _spread(self, rows: Array, focus: Array) -> Array:
        """(C, K) of the masses (M, K) of a focus."""
        return jnp.zeros(self._shape).at[rows].set(focus, mode="drop")

    def _away(self, memory: Memory) -> Array:
        """Mass off the map before the scan."""
        return memory.off * (1 - self.config.enter) + (1 - memory.off) * self.config.leave

    def _bayes(
        self, prior: Array, away: Array, ranges: Array, fresh: Array, rows: Array | None = None
    ) -> tuple[Array, Array, Array]:
        """Masses (n, K) and () after the scan, which sum to one, and the mean evidence of a beam on the map ().

        ``prior`` (n, K) is that of ``rows`` (n,), or of all free cells; ``away`` () is the mass off the map.
        """
        evidence = self.likelihood.evidence(ranges, self.config.beams, rows)
        valid = (ranges[beam_choice(self.likelihood.lidar.beams, self.config.beams)] > -jnp.inf).sum()
        scale = fresh * self.config.temper
        log_on, log_off = jnp.log(prior) + scale * evidence, jnp.log(away) + scale * self._unmapped() * valid
        top = log_on.max()
        on = pg.exp_or_zero(log_on - top)
        total = on.sum()
        # A little of both is always left: neither is ever impossible for good.
        off = jnp.clip(jax.nn.sigmoid(log_off - top - jnp.log(total)), 0.0, 1 - 1e-6)
        level = jnp.where(on > 0, on * evidence, 0.0).sum() / total / jnp.maximum(valid, 1)
        return (1 - off) / total * on, off, level

    def _unmapped(self) -> float:
        """Log-likelihood of a beam off the map: hits that are a deviation off, and readings that no wall explains."""
        model = self.likelihood.config.model
        hit = model.z_hit * math.exp(-0.5) / (model.sigma_hit * math.sqrt(2 * math.pi))
        other = (4 * model.z_short + model.z_rand) / model.range_max
        share = self.config.explained
        return share * math.log(hit + other) + (1 - share) * math.log(other)

    def sample(self, key: Key, prepared: Places, n: int) -> tuple[Array, Array]:
        """``n`` base poses (n, 3) from the belief after the scan, and their log densities."""
        poses, _, log_q = self.draw(key, prepared, n)
        return poses, log_q

    def draw(self, key: Key, prepared: Places, n: int) -> tuple[Array, Array, Array]:
        """As :meth:`sample`; between the two the log densities (n,) of the belief before the scan."""
        k_which, k_where = jax.random.split(key)
        which = jnp.floor((jnp.arange(n) + jax.random.uniform(k_which)) * (self.config.pool / n)).astype(jnp.int32)
        some = jax.tree.map(lambda v: v[jnp.minimum(which, self.config.pool - 1)], prepared.pool)
        poses = self.likelihood.poses_in(some.cell, some.heading, jax.random.uniform(k_where, (n, 3)).T)
        return poses, some.log_prior, some.log_posterior


def grid_belief(likelihood: LikelihoodGrid, grid: OccupancyGrid, config: GridBeliefConfig) -> GridBelief:
    """Belief on the cells of a likelihood grid that was made for the map ``grid``."""
    cells, size = likelihood.cells, likelihood.free.size
    number = jnp.arange(cells.size, dtype=jnp.int32)
    real = jnp.where(cells < size, cells, size + 1)
    row_of = jnp.full(size + 1, cells.size, jnp.int32).at[real].set(number, mode="drop")
    at_edge = (dilate(_unknown(likelihood, grid), 2) & likelihood.free).reshape(-1)
    frontier = at_edge.at[cells].get(mode="fill", fill_value=False).astype(jnp.float32)[:, None]
    return GridBelief(likelihood, row_of, normalised(frontier), config)


def _unknown(likelihood: LikelihoodGrid, grid: OccupancyGrid) -> Array:
    """(H, W) bool, cells of the likelihood grid in which some cell of the map is neither free nor occupied."""
    rows, cols = likelihood.free.shape
    side = likelihood.map_cells.height // rows
    blank = ~(pad(grid, (rows * side, cols * side)).free | pad(grid, (rows * side, cols * side)).occupied)
    return blank.reshape(rows, side, cols, side).any((1, 3))


def novelty(before: Array, now: Array, odometry: Array) -> Array:
    """Share () of a scan (B,) that counts: all of it after a quarter of a metre or 0.2 rad, or where it has changed."""
    moved = jnp.hypot(odometry[0], odometry[1]) / 0.25 + jnp.abs(odometry[2]) / 0.2
    both = jnp.isfinite(before) & jnp.isfinite(now)
    gap = jnp.abs(jnp.where(both, before, 0.0) - jnp.where(both, now, 0.0)) > 0.3
    judged = (before > -jnp.inf) & (now > -jnp.inf)
    changed = jnp.where(both, gap, jnp.isfinite(before) != jnp.isfinite(now)) & judged
    share = changed.sum() / jnp.maximum(judged.sum(), 1)
    return jnp.clip(jnp.maximum(moved, (share - 0.2) / 0.3), 0.0, 1.0)
