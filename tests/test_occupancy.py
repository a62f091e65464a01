"""Grid frames by hand and by matrices, resampling by area, distances against scipy."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import ndimage

from dsom_jax import occupancy
from dsom_jax.occupancy import cell_index, from_cells, is_free
from reference import se2

L_SHAPE = np.array([[1, 0, 0, 0], [1, 0, 0, 0], [1, 1, 1, 0]], bool)  # row 0 is the lowest

euclidean_to_9 = jax.jit(lambda cells: occupancy.euclidean_distance(cells, 9))


def random_cells(seed: int, shape: tuple[int, int], density: float) -> np.ndarray:
    return np.random.default_rng(seed).random(shape) < density


def test_cells_run_along_y_then_x():
    grid = from_cells(L_SHAPE, resolution=0.5)
    assert grid.shape == (3, 4) and grid.size == (2.0, 1.5)
    i, j = cell_index(grid, jnp.array([[0.1, 0.1, 0.0], [1.9, 0.1, 0.0], [0.6, 1.4, 0.0]]))
    np.testing.assert_array_equal(i, [0, 0, 2])
    np.testing.assert_array_equal(j, [0, 3, 1])
    np.testing.assert_array_equal(
        is_free(grid, jnp.array([[0.1, 0.1, 0.0], [1.9, 0.1, 0.0], [0.6, 1.4, 0.0]])), [False, True, False]
    )


def test_origin_with_yaw_by_hand():
    # The building is turned a quarter left: its x runs along +y of the map, its y along -x.
    grid = from_cells(L_SHAPE, resolution=0.5, origin=(10.0, 20.0, np.pi / 2))
    standing_on_cell_0_3 = jnp.array([10.0 - 0.25, 20.0 + 1.75, np.pi])
    i, j = cell_index(grid, standing_on_cell_0_3)
    assert (int(i), int(j)) == (0, 3)
    np.testing.assert_allclose(grid.to_grid(standing_on_cell_0_3), [1.75, 0.25, np.pi / 2], atol=1e-5)


@given(st.integers(0, 10_000), st.floats(-3.1, 3.1))
def test_frames_are_the_matrices_of_the_origin(seed, yaw):
    rng = np.random.default_rng(seed)
    origin = (*rng.uniform(-20, 20, 2), yaw)
    grid = from_cells(L_SHAPE, resolution=0.1, origin=origin)
    local = np.concatenate([rng.uniform(-5, 30, (6, 2)), rng.uniform(-3, 3, (6, 1))], -1)
    expected = se2.compose(np.array(origin), local)
    poses = np.asarray(grid.from_grid(jnp.asarray(local, jnp.float32)))
    np.testing.assert_allclose(poses[:, :2], expected[:, :2], atol=5e-5)
    assert se2.angle_gap(poses[:, 2], expected[:, 2]).max() < 1e-5
    np.testing.assert_allclose(grid.to_grid(jnp.asarray(poses))[:, :2], local[:, :2], atol=1e-4)


def test_nothing_is_free_outside_or_nowhere():
    grid = from_cells(np.zeros((3, 4), bool), resolution=0.5)
    outside = [[-0.01, 0.1, 0], [0.1, -0.01, 0], [2.01, 0.1, 0], [0.1, 1.51, 0], [1e12, 0, 0], [-1e12, 0, 0]]
    assert not is_free(grid, jnp.array(outside)).any()
    assert not is_free(grid, jnp.array([[np.nan, 0.1, 0.0], [0.1, np.nan, 0.0], [np.inf, 0.1, 0.0]])).any()


def test_unknown_is_neither_free_nor_occupied_and_walls_win():
    free = np.array([[1, 0, 1, 1], [1, 1, 1, 1], [1, 1, 1, 0]], bool)
    grid = from_cells(L_SHAPE, free, resolution=1.0)
    np.testing.assert_array_equal(grid.free, free & ~L_SHAPE)
    assert not grid.free[0, 1] and not grid.occupied[0, 1]


def test_padding_adds_unknown_cells():
    grid = occupancy.pad(from_cells(L_SHAPE, resolution=1.0), (8, 8))
    np.testing.assert_array_equal(grid.occupied[:3, :4], L_SHAPE)
    assert grid.occupied.sum() == L_SHAPE.sum() and grid.free.sum() == (~L_SHAPE).sum() and grid.shape == (8, 8)


@pytest.mark.parametrize(("old", "new"), [(0.05, 0.1), (0.05, 1 / 3), (0.1, 0.3), (0.1, 0.25), (0.2, 0.1), (0.1, 0.1)])
def test_resampled_cells_are_occupied_where_their_area_meets_a_wall(old, new):
    occupied = random_cells(1, (42, 60), 0.02)
    grid = occupancy.resample(from_cells(occupied, resolution=old), new)
    ratio = new / old
    rows, cols = (int(np.ceil(n / ratio - 1e-6)) for n in occupied.shape)
    assert grid.shape == (rows, cols) and grid.resolution == pytest.approx(new)
    new_occupied, new_free = np.asarray(grid.occupied), np.asarray(grid.free)
    for i in range(rows):
        for j in range(cols):
            ys = slice(int(np.floor(i * ratio + 1e-6)), int(np.ceil((i + 1) * ratio - 1e-6)))
            xs = slice(int(np.floor(j * ratio + 1e-6)), int(np.ceil((j + 1) * ratio - 1e-6)))
            assert new_occupied[i, j] == occupied[ys, xs].any(), (i, j)
            centre = [min(int((k + 0.5) * ratio + 1e-6), n - 1) for k, n in zip((i, j), occupied.shape, strict=True)]
            assert new_free[i, j] == (not occupied[centre[0], centre[1]] and not new_occupied[i, j])


@pytest.mark.parametrize("ratio", [1.7, 2.0, 3.0, 6.6])
def test_a_thin_wall_still_divides_the_room(ratio):
    occupied = np.zeros((60, 60), bool)
    occupied[:, 31] = True  # one cell thick
    grid = occupancy.resample(from_cells(occupied, resolution=0.05), 0.05 * ratio)
    rooms, count = ndimage.label(np.asarray(grid.free))
    assert count == 2 and rooms[0, 0] != rooms[0, -1] > 0


def test_resampling_a_large_map_keeps_every_cell_in_its_place():
    # 4,000 cells: a float32 running position would be off by a cell.
    occupied = np.zeros((1, 4000), bool)
    occupied[0, ::7] = True
    grid = occupancy.resample(from_cells(occupied, resolution=0.05), 0.05 * 7)
    assert grid.shape[1] == 572 and bool(grid.occupied.all())
    occupied[0] = False
    occupied[0, 6::7] = True  # the last cell of each window, none in the last, cut one
    grid = occupancy.resample(from_cells(occupied, resolution=0.1), 0.7)
    np.testing.assert_array_equal(np.asarray(grid.occupied[0]), np.arange(572) < 571)


@given(st.integers(0, 10_000), st.sampled_from([0.0, 0.01, 0.1, 0.5, 1.0]))
def test_distances_against_scipy(seed, density):
    occupied = random_cells(seed, (17, 23), density)
    if occupied.any():
        euclidean = np.minimum(ndimage.distance_transform_edt(~occupied), 9)
    else:
        euclidean = np.full(occupied.shape, 9)
    np.testing.assert_allclose(euclidean_to_9(occupied), euclidean, rtol=1e-6)


@pytest.mark.parametrize("steps", [1, 3])
def test_dilation_is_scipys_and_maps_over_batches(steps):
    cells = np.stack([random_cells(seed, (13, 11), 0.05) for seed in range(4)])
    expected = [ndimage.binary_dilation(c, np.ones((3, 3)), iterations=steps) for c in cells]
    np.testing.assert_array_equal(occupancy.dilate(jnp.asarray(cells), steps), expected)


def test_lookup_has_a_value_outside():
    cells = jnp.arange(6).reshape(2, 3)
    i, j = jnp.array([0, 1, -1, 0, 2]), jnp.array([2, 0, 0, 3, 1])
    np.testing.assert_array_equal(occupancy.lookup(cells, i, j, outside=-7), [2, 3, -7, -7, -7])
