"""Procedural buildings: connected, closed, varied, reproducible."""

from __future__ import annotations

from functools import lru_cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import ndimage

from dsom_jax.simulate.morphology import clear_of, components, grow, largest_component, renumber
from dsom_jax.simulate.walls import boundary
from dsom_jax.simulate.worlds import WorldConfig, make_world

PLAIN = WorldConfig(
    cells=96, rotated=0, curved=0, slanted=0, furniture=0, pillars=0, shelves=0, thick=0, symmetric=1, notched=0
)
BUILDINGS = {"small": 60, "full": 12, "plain": 12}
"""Kinds of buildings, and how many of each are drawn."""

build = jax.jit(make_world, static_argnums=1)


@lru_cache
def worlds(kind: str) -> tuple[np.ndarray, np.ndarray]:
    """Occupied and free cells (n, H, W) of the buildings of one kind; the plain ones are made under ``vmap``."""
    keys = jax.random.split(jax.random.key(5), BUILDINGS[kind])
    if kind == "plain":
        grids = jax.jit(jax.vmap(lambda key: make_world(key, PLAIN)))(keys)
        return np.asarray(grids.occupied), np.asarray(grids.free)
    config = WorldConfig(cells=64 if kind == "small" else 128)
    each = [build(key, config) for key in keys]
    return np.stack([grid.occupied for grid in each]), np.stack([grid.free for grid in each])


@pytest.mark.parametrize("kind", BUILDINGS)
def test_every_free_cell_is_connected_to_every_other(kind: str) -> None:
    for free in worlds(kind)[1]:
        assert ndimage.label(free)[1] == 1


@pytest.mark.parametrize("kind", BUILDINGS)
def test_free_cells_keep_off_occupied_ones(kind: str) -> None:
    for occupied, free in zip(*worlds(kind), strict=True):
        assert not (free & ndimage.binary_dilation(occupied)).any()


@pytest.mark.parametrize("kind", BUILDINGS)
def test_no_ray_leaves_the_building(kind: str) -> None:
    """The cells that are not occupied and hang together with free ones never touch the border of the map."""
    for occupied, free in zip(*worlds(kind), strict=True):
        labels, _ = ndimage.label(~occupied)
        indoors = np.isin(labels, np.unique(labels[free]))
        assert not (indoors[0].any() or indoors[-1].any() or indoors[:, 0].any() or indoors[:, -1].any())


@pytest.mark.parametrize("kind", BUILDINGS)
def test_there_is_room_to_drive_and_something_to_see(kind: str) -> None:
    occupied, free = worlds(kind)
    assert (free.sum((1, 2)) * (1 / 3) ** 2 > 10.0).all()
    assert np.median(free.mean((1, 2))) > 0.15
    # Seen from half of the free cells of every building, something lies within 5 m.
    for walls, room in zip(occupied, free, strict=True):
        assert np.median(ndimage.distance_transform_edt(~walls)[room]) < 15


def test_buildings_vary() -> None:
    occupied, free = worlds("small")
    flat = occupied.reshape(len(occupied), -1).astype(float)
    similar = np.corrcoef(flat) - np.eye(len(flat))
    assert similar.max() < 0.7
    shares = free.mean((1, 2))
    assert np.quantile(shares, 0.9) > 1.8 * np.quantile(shares, 0.1)


def test_the_same_key_gives_the_same_building() -> None:
    again = build(jax.random.split(jax.random.key(5), BUILDINGS["small"])[7], WorldConfig(cells=64))
    occupied, free = worlds("small")
    np.testing.assert_array_equal(again.occupied, occupied[7])
    np.testing.assert_array_equal(again.free, free[7])
    assert (occupied[7] != occupied[8]).any()


def test_knobs_reach_the_building() -> None:
    """Without clutter, turns and bends nearly every occupied cell lies in a straight run along an axis."""
    for occupied in worlds("plain")[0]:
        rows = ndimage.binary_opening(occupied, np.ones((1, 3)))
        columns = ndimage.binary_opening(occupied, np.ones((3, 1)))
        assert (rows | columns)[occupied].mean() > 0.85
    assert WorldConfig(cells=64).depth < WorldConfig(cells=128).depth


@pytest.mark.parametrize(
    ("wrong", "named"),
    [
        ({"cells": 16}, "cells"),
        ({"resolution": 1.0}, "resolution"),
        ({"room_size": (0.5, 2.0)}, "rooms"),
    ],
)
def test_impossible_configs_are_refused(wrong: dict, named: str) -> None:
    with pytest.raises(ValueError, match=named):
        WorldConfig(**wrong)


@pytest.mark.parametrize("density", [0.3, 0.55, 0.65, 0.9])
def test_components_are_those_of_scipy(density: float) -> None:
    cells = np.random.default_rng(1).uniform(size=(40, 56)) < density
    ours, (theirs, count) = np.asarray(components(jnp.asarray(cells))), ndimage.label(cells)
    assert (ours[~cells] == cells.size).all()
    pairs = set(zip(ours[cells].tolist(), theirs[cells].tolist(), strict=True))
    assert len(pairs) == count == len(np.unique(ours[cells]))
    largest = np.bincount(theirs[cells])[1:].max()
    assert np.asarray(largest_component(jnp.asarray(cells))).sum() == largest


def test_components_follow_a_spiral() -> None:
    """The worst case: one corridor as long as the map has cells."""
    cells = np.zeros((31, 31), bool)
    i, j, di, dj = 0, 0, 0, 1
    cells[0, 0] = True
    for _ in range(2 * 31):
        while 0 <= i + di < 31 and 0 <= j + dj < 31 and not cells[i + di, j + dj]:
            ahead = i + 2 * di, j + 2 * dj
            if 0 <= ahead[0] < 31 and 0 <= ahead[1] < 31 and cells[ahead]:
                break
            i, j = i + di, j + dj
            cells[i, j] = True
        di, dj = dj, -di
    assert ndimage.label(cells)[1] == 1 and cells.sum() > 400
    np.testing.assert_array_equal(largest_component(jnp.asarray(cells)), cells)


def test_nothing_is_the_largest_component_of_nothing() -> None:
    assert not largest_component(jnp.zeros((5, 4), bool)).any()


def test_renumber_by_hand() -> None:
    kinds = jnp.asarray([[5, 5, 0, 7], [5, 0, 0, 7], [0, 5, 5, 0], [3, 5, 5, 0]])
    numbers, kind_of = renumber(kinds, smallest=2, count=5)
    np.testing.assert_array_equal(numbers, [[1, 1, 0, 2], [1, 0, 0, 2], [0, 3, 3, 0], [0, 3, 3, 0]])
    np.testing.assert_array_equal(kind_of, [0, 5, 7, 5, 0])


def test_grow_and_clear_by_hand() -> None:
    dot = jnp.zeros((5, 5), bool).at[2, 2].set(True)
    assert grow(dot, 1).sum() == 9 and (~clear_of(dot)).sum() == 5


def test_walls_leave_no_gap_between_labels() -> None:
    """Cells beside each other, or at a corner, with different labels: at least one of them is a wall."""
    labels = np.random.default_rng(0).integers(0, 4, (12, 12)).repeat(3, 0).repeat(4, 1)
    wall = np.asarray(boundary(jnp.asarray(labels), 4).wall)
    for di, dj in ((0, 1), (1, 0), (1, 1), (1, -1)):
        a = np.s_[: labels.shape[0] - di, max(0, -dj) : labels.shape[1] - max(0, dj)]
        b = np.s_[di:, max(0, dj) : labels.shape[1] + min(0, dj)]
        assert (wall[a] | wall[b] | (labels[a] == labels[b])).all()
