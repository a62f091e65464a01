"""Proposals: the likelihood grid against brute force, features in the right place, and what is uniform."""

from __future__ import annotations

import math
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import ndimage, stats

import tiny_world
from dsom_jax import pose_grid as pg
from dsom_jax.geometry import compose
from dsom_jax.lidar import LidarConfig
from dsom_jax.occupancy import cell_index, from_cells, is_free
from dsom_jax.proposals.dual_features import DualFeaturesConfig, dual_features, scan_features, with_episode
from dsom_jax.proposals.likelihood_grid import LikelihoodGridConfig, likelihood_grid, resample_free
from dsom_jax.proposals.uniform import free_space
from dsom_jax.raycast import RaycastConfig, make_tables
from dsom_jax.sensor import BeamModel
from dsom_jax.types import Inputs, prepare_alone
from reference import beam_grid, se2

LIDAR = tiny_world.LIDAR
MODEL = BeamModel(sigma_hit=0.2, temper=0.5, range_max=LIDAR.range_max)
CONFIG = LikelihoodGridConfig(resolution=0.25, headings=16, angles_per_heading=2, beams=32, model=MODEL)
prepare = jax.jit(prepare_alone)
sample = jax.jit(lambda proposal, key, prepared, n: proposal.sample(key, prepared, n), static_argnums=3)
log_density = jax.jit(lambda proposal, pm, poses: proposal.log_density(pm, poses))


def inputs(ranges, index=0):
    return Inputs(jnp.asarray(ranges, jnp.float32), jnp.zeros(3), jnp.int32(index))


@pytest.fixture(scope="module", autouse=True)
def _true_blocks():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("dsom_jax.proposals.likelihood_grid._BLOCK", 4096)
        yield


@pytest.fixture(scope="module")
def grid():
    return tiny_world.grid()


@pytest.fixture(scope="module")
def proposal(grid):
    return likelihood_grid(grid, LIDAR, CONFIG)


@pytest.fixture(scope="module")
def episode():
    return tiny_world.drive()


def test_uniform_is_uniform_over_free(grid):
    n = 30_000
    poses, log_q = sample(free_space(grid), jax.random.key(0), None, n)
    i, j = (np.asarray(v) for v in cell_index(grid, poses))
    counts = np.zeros(grid.shape)
    np.add.at(counts, (i, j), 1)
    free = ~tiny_world.cells()
    assert counts[~free].sum() <= 3  # rounding at the edge of a cell
    assert stats.chisquare(counts[free] * n / counts[free].sum(), np.full(free.sum(), n / free.sum())).pvalue > 1e-3
    assert stats.kstest(poses[:, 2], stats.uniform(-np.pi, 2 * np.pi).cdf).pvalue > 1e-3
    np.testing.assert_allclose(log_q, -math.log(free.sum() * 0.25**2 * 2 * math.pi), rtol=1e-5)


def test_likelihood_grid_is_the_brute_force_likelihood(proposal):
    """Rounding of expected ranges is half of a 1023rd of range_max; everything else has to be the same."""
    rng = np.random.default_rng(0)
    readings = rng.uniform(0.3, 4.0, LIDAR.beams)
    readings[::2] = np.nan  # from the centre of a cell these beams, of all headings, run into corners
    readings[1:12:2] = [np.inf, np.inf, np.inf, -np.inf, 0.1, 4.99]
    pm = prepare(proposal, inputs(readings))
    free = np.argwhere(~tiny_world.cells())
    chosen = free[rng.choice(len(free), 40, replace=False)]
    directions = np.arange(32) * 2 * np.pi / 32
    columns = (2 * np.arange(16) - 16 + np.arange(32)[:, None] - 16) % 32  # theta_k + bearing_b, both from -pi on
    model = dict(z_hit=0.7, z_short=0.15, z_max=0.05, z_rand=0.1, sigma=0.2, top=5.0)
    rounding = 0.5 * 5.0 / 1023 + 2e-3 * 0.25
    lower, upper, got = [], [], []
    for i, j in chosen:
        place = (j + 0.5, i + 0.5)
        limits = 0.5 * beam_grid.bounds(tiny_world.cells(), 0.25, place, directions, columns, readings, rounding, model)
        lower.append(limits[:, 0])
        upper.append(limits[:, 1])
        got.append(np.log(np.asarray(pm.mass[i, j])))
    lower, upper, got = map(np.array, (lower, upper, got))
    # PM is normalised, so there is one constant; it has to fit between the bounds of all poses at once.
    assert (got - upper).max() <= (got - lower).min() + 1e-3
    # The bounds mean something: they are much closer to each other than poses are.
    assert np.median(upper - lower) < 0.3 and np.std(got) > 1.0


def test_likelihood_grid_has_mass_on_free_cells_only(proposal, episode, grid):
    pm = prepare(proposal, inputs(episode.ranges[0]))
    assert not np.asarray(pm.mass)[tiny_world.cells()].any()
    poses, log_q = sample(proposal, jax.random.key(0), pm, 4_000)
    assert np.asarray(is_free(grid, poses)).mean() > 0.999
    assert (np.abs(np.asarray(pg.log_density(pm, poses)) - log_q) < 1e-3).mean() > 0.99


def test_mass_concentrates_at_the_truth(proposal, episode):
    for t in (0, 4, 8):
        pm = prepare(proposal, inputs(episode.ranges[t]))
        assert float(pg.mass_near(pm, episode.poses[t], 0.5, 0.5)) > 0.9


def test_samples_are_poses_of_the_base_whatever_the_mount(episode):
    mount = (0.4, -0.2, 1.0)
    lidar = replace(LIDAR, mount=mount)
    base = episode.poses[3]
    ranges = tiny_world.cast(tiny_world.tables(), base, lidar)
    mounted = likelihood_grid(tiny_world.grid(), lidar, CONFIG)
    poses, _ = sample(mounted, jax.random.key(0), prepare(mounted, inputs(ranges)), 2_000)
    near = np.hypot(*(np.asarray(poses) - np.asarray(base))[:, :2].T) < 0.5
    near &= se2.angle_gap(np.asarray(poses)[:, 2], float(base[2])) < 0.5
    assert near.mean() > 0.9


@pytest.mark.parametrize(("shape", "peaks"), [((21, 21), 4), ((17, 25), 2)])
def test_a_symmetric_room_has_as_many_equal_peaks_as_it_looks_alike(shape, peaks):
    occupied = np.zeros(shape, bool)
    occupied[[0, -1]] = occupied[:, [0, -1]] = True
    room = from_cells(occupied, resolution=0.25)
    whole = likelihood_grid(room, LIDAR, CONFIG)
    truth = pg.cell_pose(whole.pose_grid, 4, 6, 9)
    mass = np.asarray(
        prepare(whole, inputs(tiny_world.cast(make_tables(room, RaycastConfig("exact"), 5.0), truth, LIDAR))).mass
    )
    # Headings are a circle: three copies, of which the middle one counts.
    high = np.concatenate([mass > 0.5 * mass.max()] * 3, -1)
    labels, _ = ndimage.label(high, np.ones((3, 3, 3)))
    found = {label for label in np.unique(labels[..., 16:32]) if label}
    tops = sorted(mass.ravel())[-peaks - 1 :]
    assert len(found) == peaks
    np.testing.assert_allclose(tops[1:], tops[-1], rtol=0.05)  # half a level of range per beam
    assert tops[0] < 0.9 * tops[-1]
    for turn in range(4 if peaks == 4 else 2):
        quarter = turn if peaks == 4 else 2 * turn
        turned = np.roll(np.rot90(mass, quarter), -4 * quarter, -1) if quarter else mass
        assert np.abs(turned - mass).max() < 0.1 * mass.max()


def test_coarser_cells_keep_every_free_place(grid):
    coarse = resample_free(grid, 0.5)
    np.testing.assert_array_equal(coarse.free, (~tiny_world.cells()).reshape(10, 2, 12, 2).any((1, 3)))
    assert coarse.resolution == pytest.approx(0.5)
    assert resample_free(grid, 0.1).resolution == pytest.approx(0.25)  # no finer than the map


def ragged(seed, resolution=0.1, origin=(-3.0, 40.0, 0.7)):
    """A map of which any cell may be free, occupied or unknown."""
    kind = np.random.default_rng(seed).choice(3, (19, 23), p=[0.6, 0.2, 0.2])
    return from_cells(kind == 1, kind == 0, resolution=resolution, origin=origin)


def stands(grid, poses, slack=1e-4):
    """Whether poses lie on free cells, but for rounding (``slack`` metres) at their edges."""
    steps = slack * np.array([[0, 0, 0], [1, 1, 0], [1, -1, 0], [-1, 1, 0], [-1, -1, 0]])
    return np.asarray(is_free(grid, jnp.asarray(poses)[:, None] + jnp.asarray(steps, jnp.float32))).any(-1)


@pytest.mark.parametrize("resolution", [0.1, 0.2, 0.5])
@pytest.mark.parametrize("offset", [0.0, 0.4])
@pytest.mark.parametrize("seed", range(3))
def test_every_pose_drawn_is_on_free_space(resolution, offset, seed):
    """Whatever the ratio of cells; with a mounting offset it is the sensor that stands there."""
    grid, lidar = ragged(seed), replace(LIDAR, mount=(offset, -offset, 0.5))
    coarse = likelihood_grid(grid, lidar, replace(CONFIG, resolution=resolution))
    pm = prepare(coarse, inputs(np.random.default_rng(seed).uniform(0.1, 4.0, LIDAR.beams)))
    poses, log_q = sample(coarse, jax.random.key(seed), pm, 2_000)
    assert stands(grid, compose(poses, jnp.array([offset, -offset, 0.0]))).all()
    same = np.abs(np.asarray(log_density(coarse, pm, poses)) - log_q) < 1e-3
    assert same.mean() > 0.995  # but for rounding at the edges of cells


@pytest.mark.parametrize("resolution", [0.1, 0.3])
def test_log_densities_are_those_that_poses_are_drawn_from(resolution):
    grid, n = ragged(5), 40_000
    coarse = likelihood_grid(grid, LIDAR, replace(CONFIG, resolution=resolution))
    volume = np.asarray(grid.free).sum() * 0.1**2 * 2 * np.pi
    _, log_q = sample(coarse, jax.random.key(0), prepare(coarse, inputs(np.full(LIDAR.beams, np.nan))), n)
    np.testing.assert_allclose(np.exp(-np.asarray(log_q, np.float64)), volume, rtol=1e-3)
    # With some evidence, so that every cell keeps some mass: E_q[1 / q] is the volume of free space.
    pm = prepare(coarse, inputs(np.where(np.arange(LIDAR.beams) % 8, np.nan, 0.7)))
    poses, log_q = sample(coarse, jax.random.key(1), pm, n)
    inverse = np.exp(-np.asarray(log_q, np.float64))
    assert abs(inverse.mean() - volume) < 5 * inverse.std() / math.sqrt(n)
    # The map's own cells are met as often as the density at their centres says.
    share = densities(coarse, pm, grid, np.asarray(grid.free)).sum(-1) * 0.1**2 * 2 * np.pi / CONFIG.headings
    assert share.sum() == pytest.approx(1.0, abs=1e-3)
    counts = np.zeros(grid.shape)
    np.add.at(counts, tuple(np.asarray(v) for v in cell_index(grid, poses)), 1)
    seen, expected = counts[np.asarray(grid.free)], n * share / share.sum()
    assert seen.sum() > 0.999 * n and expected.min() > 5
    assert stats.chisquare(seen * n / seen.sum(), expected).pvalue > 1e-3


def densities(proposal, pm, grid, chosen):
    """(C, K) densities at the centres of the chosen cells (H, W) of the map."""
    i, j = (v[:, None] for v in np.nonzero(chosen))
    cells = np.broadcast_arrays(i, j, np.arange(CONFIG.headings))
    centres = pg.cell_pose(pg.over(grid, CONFIG.headings), *map(jnp.asarray, cells))
    return np.exp(np.asarray(log_density(proposal, pm, centres), np.float64))


def test_there_is_no_density_where_nobody_can_stand():
    grid = ragged(5)
    coarse = likelihood_grid(grid, LIDAR, replace(CONFIG, resolution=0.3))
    pm = prepare(coarse, inputs(np.full(LIDAR.beams, np.nan)))
    assert not densities(coarse, pm, grid, ~np.asarray(grid.free)).any()
    assert np.isneginf(log_density(coarse, pm, jnp.array([[500.0, 0.0, 0.0], [np.nan, 0.0, 0.0]]))).all()


@pytest.mark.parametrize("reading", [np.nan, -np.inf])
def test_a_scan_without_evidence_is_uniform(proposal, reading):
    pm = prepare(proposal, inputs(np.full(LIDAR.beams, reading)))
    mass = np.asarray(pm.mass)
    np.testing.assert_allclose(mass[~tiny_world.cells()], mass.max(), rtol=1e-5)


# Three features of Thrun et al. 2001


FEATURES = DualFeaturesConfig(samples=3_000, layouts=1, obstacles=1, headings=16)


@pytest.fixture(scope="module")
def features(grid):
    return dual_features(jax.random.key(0), grid, LIDAR, FEATURES)


def test_scan_features_by_hand():
    lidar = LidarConfig(beams=4, angle_increment=math.pi / 2, range_max=5.0)  # back, right, ahead, left
    by_hand = [(-1.0 + 3.0) / 3, 2.0 / 3, (1.0 + 5.0 + 3.0 + 2.0) / 4]
    np.testing.assert_allclose(scan_features(jnp.array([1.0, np.inf, 3.0, 2.0]), lidar), by_hand, atol=1e-5)
    np.testing.assert_allclose(scan_features(jnp.array([1.0, np.nan, 3.0, -np.inf]), lidar), [1.0, 0.0, 2.0], atol=1e-5)
    np.testing.assert_array_equal(scan_features(jnp.full(4, np.nan), lidar), 0.0)


def test_features_prefer_the_right_place(features, episode):
    gains = []
    for t in range(0, 10, 2):
        pm = prepare(features, inputs(episode.ranges[t], t))
        free = jnp.broadcast_to(jnp.asarray(~tiny_world.cells())[..., None], pm.mass.shape)
        even = pg.probability_map(pm.pose_grid, free)
        near, chance = (float(pg.mass_near(p, episode.poses[t], 1.0, 0.6)) for p in (pm, even))
        gains.append(near / chance)
    assert np.median(gains) > 3


def test_star_knows_the_sequence_but_not_the_current_pose(features, episode):
    star = with_episode(features, episode)
    t = 5
    others = episode._replace(poses=episode.poses.at[t].set(jnp.nan))
    without = with_episode(features, others)
    as_it_is, expected = (prepare(p, inputs(episode.ranges[t], n)).mass for p, n in ((star, t), (without, 77)))
    np.testing.assert_allclose(as_it_is / as_it_is.sum(), expected / expected.sum(), rtol=1e-4, atol=1e-7)
    # At any other time the same scan finds its own pose among the samples.
    i, j, k = (round(float(v)) for v in pg.pose_cell(star.pose_grid, episode.poses[t]))
    later = prepare(star, inputs(episode.ranges[t], 6))
    assert later.mass[i, j, k % 16] / later.mass.sum() > as_it_is[i, j, k % 16] / as_it_is.sum() + 1e-4


def test_unknown_poses_of_a_sequence_are_no_samples(features, episode):
    unknown = episode._replace(poses=jnp.full_like(episode.poses, jnp.nan))
    star = with_episode(features, unknown)
    # The first ten of the collected samples gave way.
    rest = replace(features, **{name: getattr(features, name)[10:] for name in ("features", "cells", "updates")})
    mass, without = (np.asarray(prepare(p, inputs(episode.ranges[2], 77)).mass) for p in (star, rest))
    np.testing.assert_allclose(mass / mass.sum(), without / without.sum(), atol=1e-6)


def test_features_of_a_scan_without_evidence_are_finite(features):
    pm = prepare(features, inputs(np.full(LIDAR.beams, np.nan)))
    poses, log_q = sample(features, jax.random.key(0), pm, 100)
    assert bool(jnp.isfinite(poses).all()) and bool(jnp.isfinite(log_q).all())
