"""The few cells that hold nearly all of a belief, and those that it can reach: found without a look at all others."""

from __future__ import annotations

import jax.numpy as jnp

from dsom_jax import pose_grid as pg
from dsom_jax.belief.moving import steps_of
from dsom_jax.occupancy import dilate
from dsom_jax.proposals.likelihood_grid import LikelihoodGrid
from dsom_jax.types import Array

_BLOCK = 64


def rows_ahead(
    likelihood: LikelihoodGrid, row_of: Array, rows: Array, focus: Array, odometry: Array, reach: int
) -> tuple[Array, Array]:
    """Rows (M,) that a focus can reach by an increment (3,) of the odometry, and whether they are all there ().

    Args:
        likelihood: the cells.
        row_of: (H * W + 1,) row of each cell, C for what is not free.
        rows, focus: (M,) and (M, K) of the focus.
        odometry: (3,) body-frame motion of the base.
        reach: cells around where it takes each row, along the heading that holds most of its mass.
    """
    grid = likelihood.pose_grid
    size, heading = grid.height * grid.width, pg.heading(grid, jnp.argmax(focus, -1))
    cells = likelihood.cells.at[rows].get(mode="fill", fill_value=size)
    forth, back = steps_of(likelihood, odometry, heading)
    image = jnp.zeros((grid.height, grid.width), bool)
    for step in (forth, back, jnp.zeros_like(forth)):
        y, x = jnp.round(jnp.stack(jnp.divmod(cells, grid.width)) + step).astype(jnp.int32)
        there = (cells < size) & (y >= 0) & (x >= 0)
        image = image.at[jnp.where(there, y, grid.height), x].set(True, mode="drop")
    image = dilate(image, reach) & likelihood.free
    return row_of[first_set(image.reshape(-1), rows.size)], image.sum() <= rows.size


def first_set(flags: Array, count: int) -> Array:
    """(M,) int32 where the first ``count`` of ``flags`` (n,) are set, in order; n where there are fewer.

    By blocks, of which at most ``count`` are looked into: a running sum over a large map takes long.
    """
    n = flags.size
    blocks = jnp.pad(flags, (0, -n % _BLOCK)).reshape(-1, _BLOCK)
    some = jnp.flatnonzero(blocks.any(-1), size=count, fill_value=len(blocks))
    within = blocks.at[some].get(mode="fill", fill_value=False)
    at = jnp.flatnonzero(within.reshape(-1), size=count, fill_value=within.size)
    block = some.at[at // _BLOCK].get(mode="fill", fill_value=len(blocks))
    return jnp.minimum(block * _BLOCK + at % _BLOCK, n).astype(jnp.int32)
