"""A belief over cells and headings, moved by the odometry: of all cells, or of the few that a focus holds."""

from __future__ import annotations

import jax.numpy as jnp

from dsom_jax import pose_grid as pg
from dsom_jax.geometry import rotate
from dsom_jax.proposals.likelihood_grid import LikelihoodGrid
from dsom_jax.proposals.markov_grid import spline, turned
from dsom_jax.types import Array


def moved_everywhere(likelihood: LikelihoodGrid, mass: Array, odometry: Array, slip: float) -> Array:
    """:func:`moved_mass` of all free cells (C, K), to all free cells."""
    # Laid out over the whole grid, a cell's neighbours are found without looking them up.
    laid = jnp.zeros((likelihood.free.size, mass.shape[1])).at[likelihood.cells].set(mass, mode="drop")
    return moved_mass(likelihood, laid, None, likelihood.cells, odometry, slip)


def moved_mass(
    likelihood: LikelihoodGrid, mass: Array, slot: Array | None, cells: Array, odometry: Array, slip: float
) -> Array:
    """Mass (n, K) that a body-frame increment (3,) brings to ``cells`` (n,); what leaves free space is lost.

    ``mass`` (m, K) is that of the cells for which ``slot`` (H * W + 1,) says a row, or of all (H * W, K). ``slip`` is
    the probability that the robot stood still, or drove back what is reported as forth.
    """
    grid = likelihood.pose_grid
    padded = jnp.pad(mass, ((0, 1), (0, 0)))
    forth, back = steps_of(likelihood, odometry, pg.heading(grid, jnp.arange(grid.headings)))
    moved = (1 - slip) * _shifted(grid, padded, slot, cells, forth)
    # Slips are rare and need no interpolation.
    slipped = _taken(grid, padded, slot, cells, jnp.round(back).astype(jnp.int32))
    slipped = slipped + _taken(grid, padded, slot, cells, jnp.zeros_like(back, jnp.int32))
    return turned(moved + slip / 2 * slipped, odometry[2] / grid.turn)


def steps_of(likelihood: LikelihoodGrid, odometry: Array, theta: Array) -> tuple[Array, Array]:
    """Cells (2, n) along y and x that a base of heading ``theta`` (n,) takes its sensor, driving forth, and back.

    The turn of ``odometry`` (3,) is the same in both; it swings a sensor that does not sit on the axle.
    """
    mount = jnp.array(likelihood.lidar.mount)[:2]
    swing = jnp.stack(rotate(odometry[2], *mount)) - mount
    resolution = likelihood.pose_grid.resolution
    forth, back = (
        jnp.stack(rotate(theta, *step)[::-1]) / resolution for step in (swing + odometry[:2], swing - odometry[:2])
    )
    return forth, back


def _shifted(grid: pg.PoseGrid, padded: Array, slot: Array | None, cells: Array, shift: Array) -> Array:
    """Mass (n, K) at ``cells`` after heading k moved by ``shift`` (2, K) cells along y and x."""
    (rows, of_row), (cols, of_col) = (spline(s) for s in shift)
    total = jnp.zeros((cells.size, padded.shape[1]))
    for a in range(3):
        for b in range(3):
            part = _taken(grid, padded, slot, cells, jnp.stack([rows + a - 1, cols + b - 1]))
            total += of_row[a] * of_col[b] * part
    return total


def _taken(grid: pg.PoseGrid, padded: Array, slot: Array | None, cells: Array, shift: Array) -> Array:
    """Mass (n, K) that lay ``shift`` (2, K) whole cells before ``cells`` (n,); the last row of ``padded`` is 0."""
    i, j = jnp.divmod(cells, grid.width)
    y, x = i[:, None] - shift[0], j[:, None] - shift[1]
    inside = (y >= 0) & (y < grid.height) & (x >= 0) & (x < grid.width)
    cell = jnp.where(inside, y * grid.width + x, grid.height * grid.width)
    row = cell if slot is None else slot.at[cell].get(mode="promise_in_bounds")
    headings = jnp.arange(grid.headings)
    return padded.reshape(-1).at[row * grid.headings + headings].get(mode="promise_in_bounds")
