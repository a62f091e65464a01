"""Buildings in which exactly one, two or four poses are right, whatever is seen."""

from __future__ import annotations

import math
from dataclasses import replace

import jax.numpy as jnp

from dsom_jax.geometry import wrap_angle
from dsom_jax.occupancy import OccupancyGrid
from dsom_jax.simulate.morphology import clear_of
from dsom_jax.types import Array

ORDERS = (1, 2, 4)


def symmetric(grid: OccupancyGrid, order: int) -> OccupancyGrid:
    """The building made of one half or quarter of a square ``grid``, turned about its middle 1, 2 or 4 times."""
    height, width = grid.shape
    if order not in ORDERS or height != width or height % 2:
        raise ValueError(f"symmetric: need order 1, 2 or 4 and an even square, got {order} and {grid.shape}")
    occupied = _turned(grid.occupied, order)
    return replace(grid, occupied=occupied, free=_turned(grid.free, order) & clear_of(occupied))


def _turned(cells: Array, order: int) -> Array:
    """The first half or quarter of ``cells`` (n, n) and its images under turns by 360 / ``order`` degrees."""
    if order == 1:
        return cells
    half = cells.shape[0] // 2
    part = (
        jnp.zeros_like(cells)
        .at[:half, : half if order == 4 else None]
        .set(cells[:half, : half if order == 4 else None])
    )
    images = [jnp.rot90(part, quarter) for quarter in range(0, 4, 4 // order)]
    return jnp.stack(images).any(0)


def images(grid: OccupancyGrid, poses: Array, order: int) -> Array:
    """Poses (..., order, 3) that look like ``poses`` (..., 3), themselves first, in the map frame."""
    local = grid.to_grid(poses)[..., None, :]
    middle = grid.shape[0] * grid.resolution / 2
    turn = 2 * math.pi / order * jnp.arange(order)
    x, y = local[..., 0] - middle, local[..., 1] - middle
    turned = [x * jnp.cos(turn) - y * jnp.sin(turn) + middle, x * jnp.sin(turn) + y * jnp.cos(turn) + middle]
    return grid.from_grid(jnp.stack([*turned, wrap_angle(local[..., 2] + turn)], axis=-1))


def off_middle(grid: OccupancyGrid, metres: Array | float) -> Array:
    """(H, W) bool, cells at least ``metres`` from the middle: nearer ones and their images are one place."""
    i, j = jnp.indices(grid.shape)
    away = jnp.hypot(i - (grid.shape[0] - 1) / 2, j - (grid.shape[1] - 1) / 2) * grid.resolution
    return away >= metres
