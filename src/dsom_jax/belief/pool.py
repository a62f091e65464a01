"""Some cells that stand for a belief: small enough to be handed to every run, whatever the size of the map."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from dsom_jax.proposals.likelihood_grid import LikelihoodGrid
from dsom_jax.resampling import pick, pick_in_rows
from dsom_jax.types import Array

_EVEN = np.array([0.6180339887, 0.7548776662, 0.5698402910])
"""Multiples of these, modulo one, lie evenly in a cube."""


class Pool(NamedTuple):
    """Cells that stand for a belief, each with 1 / P of its mass.

    Attributes:
        cell: (P,) flat (i, j) of the likelihood grid.
        heading: (P,) k.
        log_prior, log_posterior: (P,) log density in 1 / (m^2 rad) there, before and after the scan, of a belief that
            knows nothing off the map.
    """

    cell: Array
    heading: Array
    log_prior: Array
    log_posterior: Array


def draw(likelihood: LikelihoodGrid, cells: Array, prior: Array, posterior: Array, n: int) -> Pool:
    """``n`` of ``cells`` (m,) and headings by the posterior (m, K), one stratum each along the cells."""
    by_row = posterior.sum(-1)
    row = pick(jnp.cumsum(by_row), (jnp.arange(n) + 0.5) / n)
    k = pick_in_rows(*_along_headings(posterior, row), even(n, 1)[0])
    cell = cells[row]
    volume = likelihood.log_volume(cell)
    log_prior = jnp.log(prior[row, k] / prior.sum()) - volume
    return Pool(cell, k, log_prior, jnp.log(posterior[row, k] / by_row.sum()) - volume)


def _along_headings(posterior: Array, row: Array) -> tuple[Array, Array]:
    """Running sums over the headings and the rows (n,) of them, of all cells or those picked: whichever are fewer."""
    if len(posterior) < len(row):
        return jnp.cumsum(posterior, -1), row
    return jnp.cumsum(posterior[row], -1), jnp.arange(len(row))


def even(n: int, axes: int) -> Array:
    """(axes, n) points that lie evenly in [0, 1)."""
    return (jnp.arange(n) * _EVEN[:axes, None]) % 1.0
