"""Batches: poses on free cells, scans that agree with them, crops of given maps."""

from __future__ import annotations

import math
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dsom_jax.judging.quality import mass_totals, of_logits
from dsom_jax.nn import DSOMConfig
from dsom_jax.nn.panorama import finer_ranges
from dsom_jax.occupancy import from_cells
from dsom_jax.raycast import RaycastConfig, cast_rays, make_tables
from dsom_jax.simulate.worlds import WorldConfig
from dsom_jax.training.batches import PLAIN, ScanConfig, disturbed, make_batch, misplace, spoil_scan
from dsom_jax.training.buildings import (
    Building,
    crop_side,
    crop_source,
    make_pool,
    mixed_source,
    procedural_source,
    random_poses,
    turned_square,
)

ROOM = jnp.zeros((40, 48), bool).at[::39].set(True).at[:, ::47].set(True).at[10:14, 20:24].set(True)


def test_random_poses_are_uniform_over_free_cells():
    free = jnp.zeros((6, 5), bool).at[1, 2].set(True).at[4, 0].set(True).at[5, 4].set(True)
    poses = np.asarray(random_poses(jax.random.key(0), free, 0.5, 6000))
    cells = np.floor(poses[:, 1::-1] / 0.5).astype(int)
    counts = {cell: (cells == cell).all(1).sum() for cell in [(1, 2), (4, 0), (5, 4)]}
    assert sum(counts.values()) == 6000
    # Five standard deviations of a binomial with p = 1/3.
    assert all(abs(n - 2000) < 5 * math.sqrt(6000 * 2 / 9) for n in counts.values())
    assert np.abs(poses[:, 2]).max() <= math.pi


def test_batch_from_given_maps():
    pool = make_pool([from_cells(ROOM, resolution=0.5), from_cells(ROOM[:20, :20], resolution=0.5)], 32)
    scans = ScanConfig(beams=36, obstacles=(0, 8))
    batch = jax.jit(lambda k: make_batch(k, crop_source(pool, 32, 0.5), scans, 3, 4))(jax.random.key(0))
    assert batch.occupied.shape == (3, 32, 32) and batch.ranges.shape == (3, 4, 36)
    i, j = (np.floor(np.asarray(batch.poses[..., axis]) / 0.5).astype(int) for axis in (1, 0))
    assert np.asarray(batch.free)[np.arange(3)[:, None], i, j].all()
    again = jax.jit(lambda k: make_batch(k, crop_source(pool, 32, 0.5), scans, 3, 4))(jax.random.key(0))
    jax.tree.map(np.testing.assert_array_equal, batch, again)


def test_fine_maps_are_shown_coarse_and_cast_fine():
    """The room of 0.5 m cells, its cells cut into 5 x 5: a crop shows it as it is and casts scans and views in it."""
    fine = ROOM.repeat(5, 0).repeat(5, 1)
    # A gap of 0.1 m in the lower wall, which no coarse cell shows.
    fine = fine.at[0:5, 100].set(False)
    model = DSOMConfig(width=2, headings=8, channels=2, panorama=True, resolution=0.5, range_max=30.0)
    side = crop_side(40, 0.5, 0.1)
    pool = make_pool([from_cells(fine, resolution=0.1)], side)
    scans = replace(PLAIN, beams=90, obstacles=(0, 0), sigma=0.0, range_max=30.0)
    source = crop_source(pool, 40, 0.5, 0.1)
    batch = jax.jit(lambda k: make_batch(k, source, scans, 2, 8, model))(jax.random.key(1))
    assert side == 200 and batch.occupied.shape == (2, 40, 40) and batch.views.shape == (2, 20, 20, 32)
    i, j = (np.floor(np.asarray(batch.poses[..., axis]) / 0.5).astype(int) for axis in (1, 0))
    assert np.asarray(batch.free)[np.arange(2)[:, None], i, j].all()
    for shown, free in zip(batch.occupied, batch.free, strict=True):
        assert not (shown & free).any()
    # Views and scans of a crop, turned or not, are those of the fine crop that it was made from.
    keys = [jax.random.split(key)[0] for key in jax.random.split(jax.random.key(1), 2)]
    for n, key in enumerate(keys):
        building = source(key)
        assert building.given.shape == (200, 200) and building.given.resolution == 0.1
        np.testing.assert_array_equal(building.shown.occupied, batch.occupied[n])
        np.testing.assert_array_equal(batch.views[n], finer_ranges(building.given.occupied, model, (40, 40), 0.1))
        tables = make_tables(building.given, RaycastConfig("exact"), 30.0)
        # The coarse wall closes the gap and is up to a cell nearer.
        np.testing.assert_allclose(batch.ranges[n], cast_rays(tables, batch.poses[n], scans.lidar), atol=1e-3)


def test_disturbances_of_floor_plans():
    config = replace(PLAIN, removed=(40, 40), obstacles=(0, 0))
    grid = from_cells(ROOM, resolution=0.5)
    keys = jax.random.split(jax.random.key(0))
    spoilt = disturbed(keys, grid, config)
    assert (spoilt.occupied <= grid.occupied).all() and spoilt.occupied.sum() < grid.occupied.sum()
    jax.tree.map(np.testing.assert_array_equal, disturbed(keys, grid, replace(config, removed=(0, 0))), grid)
    shifts = np.stack([misplace(key, jnp.full(360, 9.0), 0.3) - 9 for key in jax.random.split(jax.random.key(1), 300)])
    # At its own bearings a shift has the variance asked for, 360 / 24 beams apart it is another one.
    at = shifts[:, ::15]
    assert abs(at.std() - 0.3) < 5 * 0.3 / math.sqrt(2 * at.size)
    assert abs((at[:, 1:] * at[:, :-1]).mean()) < 5 * 0.09 / math.sqrt(at.size)
    assert np.abs(np.diff(shifts, axis=1)).max() < 0.3 * 10 / 15
    assert (misplace(jax.random.key(2), jnp.full(360, 0.1), 1.0) >= 0).all()


def test_spoiled_scans_keep_to_their_conditions():
    config = ScanConfig(beams=60, limited=1.0, fov_min=math.pi, reach_min=4.0, thinning=3, dropout=0.2, short=0.2)
    clean = jnp.linspace(0.5, 12.0, 60)
    for seed in range(5):
        ranges, conditions = spoil_scan(jax.random.key(seed), clean, config)
        finite = np.asarray(ranges)[np.isfinite(ranges)]
        assert (finite < float(conditions.reach)).all()
        step = round(float(conditions.gap) / (2 * math.pi / 60))
        assert step in (1, 2, 3) and np.isnan(ranges).sum() >= 60 * (1 - 1 / step)


def test_plain_scans_are_whole():
    ranges, _ = spoil_scan(jax.random.key(0), jnp.full(360, 3.0), PLAIN)
    assert jnp.isfinite(ranges).all() and jnp.abs(ranges - 3.0).max() < 6 * PLAIN.sigma


def test_floor_plans_show_part_of_what_the_lidar_sees():
    world = WorldConfig(cells=48)
    shown, seen, _ = jax.jit(procedural_source(world, bare=1.0))(jax.random.key(3))
    assert shown.occupied.sum() < seen.occupied.sum()
    assert not (seen.free & ~shown.free).any()
    shown, seen, _ = jax.jit(procedural_source(world, bare=0.0))(jax.random.key(3))
    jax.tree.map(np.testing.assert_array_equal, shown, seen)


def test_mixed_source_draws_from_both_as_often_as_asked():
    def constant(value):
        grid = from_cells(jnp.full((2, 2), value), resolution=0.5)
        return lambda key: Building(grid, grid)

    draw = jax.jit(jax.vmap(lambda key: mixed_source(constant(True), constant(False), 0.25)(key).shown.occupied.all()))
    drawn = int(draw(jax.random.split(jax.random.key(0), 2000)).sum())
    # Five standard deviations of a binomial with p = 1/4.
    assert abs(drawn - 500) < 5 * math.sqrt(2000 * 3 / 16)


def test_depth_behind_walls_is_one_number_for_a_scan():
    config = replace(PLAIN, sigma=0.0, deep=1.0, depth=(0.1, 0.3))
    for seed in range(4):
        ranges, _ = spoil_scan(jax.random.key(seed), jnp.full(360, 3.0), config)
        assert 3.1 - 1e-5 <= float(ranges[0]) <= 3.3 + 1e-5
        np.testing.assert_allclose(ranges, ranges[0], atol=1e-6)


def test_eight_symmetries():
    square = jnp.arange(9).reshape(3, 3)
    assert len({np.asarray(turned_square(square, jnp.int32(n))).tobytes() for n in range(8)}) == 8


@pytest.mark.parametrize(
    ("offset", "mass", "top"), [(0.0, 1.0, True), (0.9, 1.0, True), (1.6, 0.0, True), (3.0, 0.0, False)]
)
def test_score_counts_probability_near_the_truth(offset, mass, top):
    # All probability in cell (4, 4), centre (2.25, 2.25) m, heading theta_4 = 0.
    log_pm = jnp.full((16, 16, 8), -jnp.inf).at[4, 4, 4].set(0.0)
    mass_here, right = of_logits(log_pm, 0.5, jnp.asarray([2.25 + offset, 2.25, 0.1]))
    assert float(mass_here) == mass and bool(right) == top
    turned_away = of_logits(log_pm, 0.5, jnp.asarray([2.25, 2.25, 0.4]))
    assert float(turned_away[0]) == 0.0 and not bool(turned_away[1])
    assert mass_totals(mass_here, right)["mass_gt_1pct"] == float(mass > 0)
