"""Batches: poses on free cells, scans that agree with them, crops of given maps."""

from __future__ import annotations

import math
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dsom_jax.occupancy import from_cells
from dsom_jax.simulate.worlds import WorldConfig
from dsom_jax.training.batches import (
    PLAIN,
    Building,
    ScanConfig,
    crop_source,
    make_batch,
    make_pool,
    mixed_source,
    procedural_source,
    random_poses,
    spoil_scan,
    turned,
)
from dsom_jax.training.evaluation import score_map, summarise

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
    shown, seen = jax.jit(procedural_source(world, bare=1.0))(jax.random.key(3))
    assert shown.occupied.sum() < seen.occupied.sum()
    assert not (seen.free & ~shown.free).any()
    shown, seen = jax.jit(procedural_source(world, bare=0.0))(jax.random.key(3))
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
    assert len({np.asarray(turned(square, jnp.int32(n))).tobytes() for n in range(8)}) == 8


@pytest.mark.parametrize(
    ("offset", "mass", "top"), [(0.0, 1.0, True), (0.9, 1.0, True), (1.6, 0.0, True), (3.0, 0.0, False)]
)
def test_score_counts_probability_near_the_truth(offset, mass, top):
    # All probability in cell (4, 4), centre (2.25, 2.25) m, heading theta_4 = 0.
    log_pm = jnp.full((16, 16, 8), -jnp.inf).at[4, 4, 4].set(0.0)
    score = score_map(log_pm, jnp.asarray([2.25 + offset, 2.25, 0.1]), 0.5)
    assert float(score.mass) == mass and bool(score.top1) == top
    turned_away = score_map(log_pm, jnp.asarray([2.25, 2.25, 0.4]), 0.5)
    assert float(turned_away.mass) == 0.0 and not bool(turned_away.top1)
    assert summarise(score)["mass_gt_1pct"] == float(mass > 0)
