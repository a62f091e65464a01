"""The discretised pose space: frames, sampling frequencies, densities that integrate to one."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from dsom_jax import pose_grid as pg
from dsom_jax.occupancy import from_cells, is_free
from reference import se2

ORIGIN = (-2.0, 3.0, 0.7)
GRID = pg.PoseGrid(jnp.array(ORIGIN, jnp.float32), 4, 6, 8, 0.5)
CELL = 0.5**2 * 2 * math.pi / 8  # m^2 rad
sample = jax.jit(pg.sample, static_argnums=2)


def some_mass(seed: int = 0) -> np.ndarray:
    mass = np.random.default_rng(seed).exponential(size=GRID.shape)
    mass[1] = 0.0
    mass[2, 3, ::2] = 0.0
    return mass.astype(np.float32)


def test_headings_are_k_turns_from_minus_pi():
    headings = np.asarray(pg.heading(GRID, jnp.arange(8)))
    np.testing.assert_allclose(np.degrees(headings), [-180, -135, -90, -45, 0, 45, 90, 135], atol=1e-4)


def test_cell_centre_by_hand():
    grid = pg.PoseGrid(jnp.array([10.0, 20.0, np.pi / 2], jnp.float32), 4, 6, 8, 0.5)
    # Cell (1, 2): 1.25 m along the grid's x, which is the map's y; 0.75 m along its y, the map's -x; facing k = 4.
    np.testing.assert_allclose(pg.cell_pose(grid, 1, 2, 4), [10 - 0.75, 20 + 1.25, np.pi / 2], atol=1e-5)


@given(st.integers(0, 100_000))
def test_cells_and_poses_are_inverse(seed):
    rng = np.random.default_rng(seed)
    i, j, k = rng.uniform(-0.5, 3.5, 9), rng.uniform(-0.5, 5.5, 9), rng.uniform(0, 8, 9)
    poses = pg.cell_pose(GRID, *(jnp.asarray(v, jnp.float32) for v in (i, j, k)))
    local = np.stack([(j + 0.5) * 0.5, (i + 0.5) * 0.5, -np.pi + k * np.pi / 4], -1)
    expected = se2.compose(np.array(ORIGIN), local)
    np.testing.assert_allclose(poses[:, :2], expected[:, :2], atol=1e-5)
    assert se2.angle_gap(poses[:, 2], expected[:, 2]).max() < 1e-5
    back = pg.pose_cell(GRID, poses)
    np.testing.assert_allclose(np.stack(back[:2]), [i, j], atol=1e-4)
    assert (np.abs((np.asarray(back[2]) - k + 4) % 8 - 4) < 1e-4).all()
    assert (np.asarray(back[2]) >= 0).all() and (np.asarray(back[2]) <= 8).all()


def test_pose_grid_over_a_map_shares_its_cells():
    grid = from_cells(np.eye(5, dtype=bool), resolution=0.2, origin=(1.0, 2.0, 0.3))
    over = pg.over(grid, 16)
    assert over.shape == (5, 5, 16) and over.resolution == pytest.approx(0.2)
    centres = pg.cell_pose(over, *np.indices((5, 5)), np.zeros((5, 5)))
    np.testing.assert_array_equal(is_free(grid, centres), grid.free)


def test_samples_follow_the_mass():
    mass = some_mass()
    n = 60_000
    poses, _ = sample(jax.random.key(0), pg.probability_map(GRID, jnp.asarray(mass)), n)
    i, j, k = (np.round(np.asarray(v)).astype(int) for v in pg.pose_cell(GRID, poses))
    assert i.min() >= 0 and i.max() < 4 and j.min() >= 0 and j.max() < 6
    counts = np.zeros(GRID.shape)
    np.add.at(counts, (i, j, k % 8), 1)
    expected = mass.astype(float) / mass.sum() * n
    assert counts[mass == 0].sum() <= 5  # a jitter on the very edge of a cell
    kept = expected > 5
    assert stats.chisquare(counts[kept], expected[kept] * counts[kept].sum() / expected[kept].sum()).pvalue > 1e-3


def test_samples_are_uniform_within_a_cell():
    mass = np.zeros(GRID.shape, np.float32)
    mass[2, 4, 0] = 3.0
    poses, _ = sample(jax.random.key(1), pg.probability_map(GRID, jnp.asarray(mass)), 20_000)
    i, j, k = (np.asarray(v) for v in pg.pose_cell(GRID, poses))
    for offset in (i - 2, j - 4, (k + 4) % 8 - 4):
        assert stats.kstest(offset, stats.uniform(-0.5, 1.0).cdf).pvalue > 1e-3
    # The bin k = 0 lies across the seam at -pi.
    assert (np.asarray(poses[:, 2]) >= -np.pi - 1e-6).all()


def test_density_integrates_to_one_and_is_that_of_the_samples():
    pm = pg.probability_map(GRID, jnp.asarray(some_mass(2)))
    i, j, k = np.indices(GRID.shape)
    at_centres = np.asarray(pg.log_density(pm, pg.cell_pose(GRID, i, j, k)))
    assert np.exp(at_centres).sum() * CELL == pytest.approx(1.0, rel=1e-5)
    np.testing.assert_allclose(np.exp(at_centres) * CELL, some_mass(2) / some_mass(2).sum(), rtol=1e-4, atol=1e-9)
    poses, log_q = sample(jax.random.key(3), pm, 2_000)
    # Samples within rounding of a cell's edge may be looked up in its neighbour.
    assert (np.abs(np.asarray(pg.log_density(pm, poses)) - log_q) < 1e-4).mean() > 0.995


def test_nothing_off_the_grid():
    pm = pg.probability_map(GRID, jnp.asarray(some_mass()))
    outside = pg.cell_pose(GRID, jnp.array([-0.6, 4.0, 2.0]), jnp.array([2.0, 2.0, 5.6]), jnp.zeros(3))
    unknown = jnp.array([[np.nan, 4.0, 0.0], [-1.0, np.nan, 0.0], [-1.0, 4.0, np.nan]])
    assert np.isneginf(pg.log_density(pm, jnp.concatenate([outside, unknown]))).all()


def test_logarithms_lose_their_scale_and_cells_that_are_not_free():
    log_mass = np.log(np.maximum(some_mass(4), 1e-30)) - 5_000.0  # far below what float32 can exponentiate
    free = np.ones((4, 6), bool)
    free[0, :3] = False
    pm = pg.from_log(GRID, jnp.asarray(log_mass, jnp.float32), jnp.asarray(free))
    expected = some_mass(4) * free[..., None]
    # float32 logarithms at 5,000 are good to 2.4e-4.
    np.testing.assert_allclose(pm.mass / pm.mass.sum(), expected / expected.sum(), rtol=2e-3, atol=1e-9)


@pytest.mark.parametrize("nothing", [-np.inf, np.nan])
def test_without_any_mass_it_is_uniform_over_free(nothing):
    free = np.ones((4, 6), bool)
    free[2:] = False
    pm = pg.from_log(GRID, jnp.full(GRID.shape, nothing), jnp.asarray(free))
    np.testing.assert_allclose(pm.mass / pm.mass.sum(), np.repeat(free[..., None], 8, -1) / (12 * 8), rtol=1e-5)
    poses, log_q = sample(jax.random.key(0), pm, 1_000)
    assert bool(jnp.isfinite(poses).all())
    np.testing.assert_allclose(log_q, -math.log(12 * 8 * CELL), rtol=1e-5)


def test_mass_near_by_brute_force():
    mass = some_mass(6)
    pm = pg.probability_map(GRID, jnp.asarray(mass))
    pose = np.array([-1.2, 4.4, -2.0])
    centres = np.asarray(pg.cell_pose(GRID, *np.indices(GRID.shape)))
    near = np.hypot(*(centres[..., :2] - pose[:2]).transpose(3, 0, 1, 2)) <= 0.8
    near &= se2.angle_gap(centres[..., 2], pose[2]) <= 1.0
    assert 0 < near.sum() < near.size
    assert pg.mass_near(pm, jnp.asarray(pose, jnp.float32), 0.8, 1.0) == pytest.approx(
        mass[near].sum() / mass.sum(), rel=1e-5
    )
