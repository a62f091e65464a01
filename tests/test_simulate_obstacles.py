"""Obstacles put in and structure removed: sizes, places, what they never touch."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import ndimage

from dsom_jax.occupancy import from_cells
from dsom_jax.simulate import obstacles

add_obstacles = jax.jit(obstacles.add_obstacles, static_argnames=("count", "max_count", "sizes"))
remove_structure = jax.jit(obstacles.remove_structure, static_argnames=("count", "max_count", "sizes"))

EMPTY = from_cells(jnp.zeros((80, 100), bool), resolution=0.1)


def walled() -> np.ndarray:
    cells = np.zeros((80, 100), bool)
    cells[[0, -1], :] = cells[:, [0, -1]] = True
    return cells


def test_obstacles_are_of_the_size_asked_for() -> None:
    for seed in range(20):
        placed = add_obstacles(jax.random.key(seed), EMPTY, 1, sizes=(0.4, 1.0))
        i, j = np.nonzero(np.asarray(placed.occupied))
        extent = 0.1 * max(np.ptp(i) + 1, np.ptp(j) + 1)
        # A turned square of side 1 m is 1.41 m wide; the grid adds less than a cell on either side.
        assert 0.3 <= extent <= 1.42 + 0.1


def test_free_space_shrinks_by_obstacles_and_their_neighbours() -> None:
    placed = add_obstacles(jax.random.key(1), EMPTY, 12)
    np.testing.assert_array_equal(placed.free, ~ndimage.binary_dilation(np.asarray(placed.occupied)))


def test_obstacles_lie_where_allowed_and_keep_off_where_told() -> None:
    where = np.zeros(EMPTY.shape, bool)
    where[40:, 50:] = True
    keep = np.zeros(EMPTY.shape, bool)
    keep[60, :] = True
    placed = np.asarray(
        add_obstacles(jax.random.key(2), EMPTY, 30, where=jnp.asarray(where), keep=jnp.asarray(keep)).occupied
    )
    assert placed.any() and not placed[60].any()
    assert not placed[:30].any() and not placed[:, :40].any()


def test_a_traced_count_draws_the_first_of_many() -> None:
    count = jax.jit(lambda n: obstacles.add_obstacles(jax.random.key(3), EMPTY, n, max_count=20).occupied.sum())
    sizes = [int(count(n)) for n in (0, 5, 20)]
    assert sizes[0] == 0 < sizes[1] < sizes[2]
    with pytest.raises(ValueError, match="max_count"):
        jax.jit(lambda n: obstacles.add_obstacles(jax.random.key(3), EMPTY, n).occupied)(3)


def test_a_map_without_free_cells_gets_no_obstacles() -> None:
    full = from_cells(jnp.ones(EMPTY.shape, bool), resolution=0.1)
    assert not (~add_obstacles(jax.random.key(0), full, 12).occupied).any()
    nowhere = add_obstacles(jax.random.key(0), EMPTY, 12, where=jnp.zeros(EMPTY.shape, bool))
    assert not nowhere.occupied.any()


def test_removal_only_removes_and_makes_nothing_free() -> None:
    grid = from_cells(jnp.asarray(walled()), resolution=0.1)
    less = remove_structure(jax.random.key(4), grid, 4)
    assert 0 < less.occupied.sum() < grid.occupied.sum()
    assert not (less.occupied & ~grid.occupied).any()
    np.testing.assert_array_equal(less.free, grid.free)


def test_removal_can_be_confined() -> None:
    grid = from_cells(jnp.asarray(walled()), resolution=0.1)
    left = jnp.zeros(grid.shape, bool).at[:, :10].set(True)
    gone = np.asarray(grid.occupied & ~remove_structure(jax.random.key(5), grid, 4, where=left).occupied)
    assert gone.any() and not gone[:, 30:].any()


def test_equal_keys_give_equal_obstacles_also_under_vmap() -> None:
    keys = jax.random.split(jax.random.key(6), 3)
    batch = jax.vmap(lambda key: add_obstacles(key, EMPTY, 12).occupied)(keys)
    for key, cells in zip(keys, batch, strict=True):
        np.testing.assert_array_equal(add_obstacles(key, EMPTY, 12).occupied, cells)
    assert (batch[0] != batch[1]).any()
