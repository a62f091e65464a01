"""The hybrid proposal: equal to each of its parts where the other has no weight, and a product where both have."""

from __future__ import annotations

import math
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import tiny_world
from dsom_jax import pose_grid as pg
from dsom_jax.filters.methods import LEARNED, METHODS, make_filter, make_proposal, powers_of, sharp
from dsom_jax.filters.settings import EXACT, Settings
from dsom_jax.geometry import compose
from dsom_jax.nn import create, evaluation_view
from dsom_jax.occupancy import is_free, resample
from dsom_jax.proposals.dsom import dsom
from dsom_jax.proposals.hybrid import Hybrid, HybridConfig, interpolate_headings
from dsom_jax.proposals.likelihood_grid import LikelihoodGridConfig, likelihood_grid
from dsom_jax.proposals.markov_grid import MarkovGrid
from dsom_jax.proposals.markov_network import MarkovNetwork
from dsom_jax.proposals.uniform import free_space
from dsom_jax.sensor import BeamModel
from dsom_jax.types import Inputs, prepare_alone
from filters_kit import LIDAR, NETWORK, decided_network

MODEL = BeamModel(sigma_hit=0.2, temper=0.2, range_max=LIDAR.range_max)
GRID = LikelihoodGridConfig(resolution=0.25, headings=16, angles_per_heading=2, beams=32, model=MODEL)
prepare = jax.jit(prepare_alone)


@pytest.fixture(scope="module")
def parts():
    return likelihood_grid(tiny_world.grid(), LIDAR, GRID), decided_network()


@pytest.fixture(scope="module")
def scan():
    episode = tiny_world.drive()
    return Inputs(episode.ranges[3], jnp.zeros(3), jnp.int32(0))


@pytest.mark.parametrize("panorama", [False, True])
def test_a_network_takes_the_same_map_in_finer_cells(scan, panorama):
    config = replace(NETWORK, resolution=0.5, panorama=panorama)
    network = evaluation_view(create(config, seed=3))
    grid = tiny_world.grid()
    coarse = resample(grid, 0.5)
    # Cut into quarters, the cells of the coarse map are what it is resampled from, and what is seen from where.
    fine = replace(
        coarse, occupied=coarse.occupied.repeat(2, 0).repeat(2, 1), free=coarse.free.repeat(2, 0).repeat(2, 1)
    )
    fine = replace(fine, resolution=0.25)
    whole, cut = (prepare(dsom(network, shown, LIDAR), scan) for shown in (coarse, fine))
    np.testing.assert_allclose(shares(cut), shares(whole), atol=1e-6)
    # The map itself has thinner walls than its coarse picture.
    other = prepare(dsom(network, grid, LIDAR), scan)
    assert (np.abs(shares(other) - shares(whole)).max() > 1e-6) == panorama


def shares(pm):
    return np.asarray(pm.mass) / float(pm.mass.sum())


def test_without_weight_the_network_says_nothing(parts, scan):
    pm = prepare(Hybrid(*parts, HybridConfig(evidence=1.0, network=0.0)), scan)
    np.testing.assert_allclose(shares(pm), shares(prepare(parts[0], scan)), atol=1e-6)


def test_without_evidence_pm_is_the_networks_with_a_floor(parts, scan):
    floor = 0.1
    pm = prepare(Hybrid(*parts, HybridConfig(evidence=0.0, floor=floor)), scan)
    own = shares(prepare(parts[1], scan))
    grid = parts[0].pose_grid
    i, j = np.nonzero(np.asarray(parts[0].free))
    even = floor / (int(parts[1].free.sum()) * NETWORK.headings)
    expected = (1 - floor) * own + even
    got = shares(pm)
    for a, b in list(zip(i, j, strict=True))[::37]:
        for k in range(0, GRID.headings, 2):  # every second heading of the finer grid is one of the network's
            place = pg.pose_cell(parts[1].pose_grid, pg.cell_pose(grid, jnp.int32(a), jnp.int32(b), jnp.int32(k)))
            ci, cj, ck = (round(float(v)) for v in place)
            ratio = got[a, b, k] / expected[ci, cj, ck % NETWORK.headings]
            np.testing.assert_allclose(ratio, got[i[0], j[0], 0] / value(expected, parts, i[0], j[0]), rtol=2e-3)


def value(expected, parts, i, j):
    place = pg.pose_cell(parts[1].pose_grid, pg.cell_pose(parts[0].pose_grid, *map(jnp.int32, (i, j, 0))))
    ci, cj, ck = (round(float(v)) for v in place)
    return expected[ci, cj, ck % NETWORK.headings]


def test_headings_are_interpolated_in_between():
    grid = pg.PoseGrid(jnp.zeros(3), 2, 3, 4, 1.0)
    layers = jnp.arange(4.0)[:, None] * jnp.ones((4, 6))
    poses = jnp.asarray([[0.5, 0.5, -math.pi + share * math.pi / 2] for share in (0.0, 0.25, 2.5, 3.5)])
    # Between the last heading and the first one lies the mean of 3 and 0.
    np.testing.assert_allclose(interpolate_headings(layers, grid, poses), [0.0, 0.25, 2.5, 1.5], atol=1e-5)


def test_a_mounted_lidar_still_gives_poses_of_the_base(parts):
    lidar = replace(LIDAR, mount=(0.4, -0.2, 0.0))
    grid, base = tiny_world.grid(), tiny_world.drive().poses[3]
    ranges = tiny_world.cast(tiny_world.tables(), base, lidar)
    mounted = Hybrid(
        likelihood_grid(grid, lidar, GRID), replace(parts[1], lidar=lidar), HybridConfig(evidence=1.0, network=0.1)
    )
    pm = prepare(mounted, Inputs(ranges, jnp.zeros(3), jnp.int32(0)))
    poses, log_density = mounted.sample(jax.random.key(0), pm, 500)
    near = np.hypot(*(np.asarray(poses) - np.asarray(base))[:, :2].T) < 0.5
    assert near.mean() > 0.5 and jnp.isfinite(log_density).all()
    sensor = compose(poses, jnp.asarray([0.4, -0.2, 0.0]))
    assert np.asarray(is_free(grid, sensor)).mean() > 0.9


@pytest.mark.parametrize("change", [{"evidence": -1.0}, {"network": -0.1}, {"floor": 0.0}, {"floor": 1.0}])
def test_weights_that_mean_nothing_are_refused(change):
    with pytest.raises(ValueError, match=next(iter(change))):
        HybridConfig(**change)


def test_a_network_is_sharpened_for_the_papers_filters_and_not_for_robust_ones(scan):
    """PM of the first is the exponent of PM of the second; the proposal itself stays what it was."""
    grid, settings = tiny_world.grid(), Settings(sharpness=2.5, robust_sharpness=1.0, grid=GRID)
    proposal = make_proposal("dsom", grid, LIDAR, settings, evaluation_view(create(NETWORK, seed=3)))
    adam, robust = (make_filter(name, proposal, grid, LIDAR, settings) for name in ("adam", "adam_robust"))
    sharp, plain = (np.asarray(prepare(f.proposal, scan).mass, np.float64) for f in (adam, robust))
    np.testing.assert_allclose(sharp / sharp.sum(), plain**2.5 / (plain**2.5).sum(), rtol=1e-3, atol=1e-9)
    assert proposal.sharpness == 2.5


def test_powers_of_methods_follow_from_their_names():
    found = {name: powers_of(name) for name in METHODS}
    robust = {name for name in METHODS if name.startswith("robust_")}
    assert {name for name, powers in found.items() if powers is None} == {*LEARNED, *robust}
    printed = {name for name, powers in found.items() if powers == (1.0, 1.0)}
    sharpened = {name for name, powers in found.items() if powers and powers != (1.0, 1.0)}
    assert sharpened == {sharp(name) for name in printed} and not any("sharp" in name for name in printed)
    assert {name for name in sharpened if found[name] == (1.0, 8.0)} == {f"adam_sharp_{source}" for source in EXACT}
    assert found["adam_sharp_dsom"] == found["mcl_sharp"] == found["mixture_mcl_sharp_star"] == (8.0, 16.0)
    assert powers_of("adam_sharp_dsom", 1.0) == (1.0, 1.0)
    assert sharp("robust_dsom") == "robust_dsom" and sharp("pf_net") == "pf_net"


@pytest.mark.parametrize(("factor", "expected"), [(1, (1, 360)), (4, (2, 180))])
def test_maps_of_coarse_cells_have_more_viewpoints(factor, expected):
    grid = tiny_world.grid()
    grid = replace(grid, resolution=0.1 * factor)
    tables = make_filter("mcl", free_space(grid), grid, LIDAR, Settings()).world.tables.map
    assert (tables.walls.shape[0] // grid.shape[0], tables.walls.shape[2]) == expected


def test_what_a_filter_weighs_by_follows_from_its_name_and_not_from_its_proposal(parts):
    memories = MarkovGrid(parts[0]), MarkovNetwork(parts[0], network=parts[1])
    for source in (*parts, Hybrid(*parts, HybridConfig()), *memories):
        for name in ("adam", "mixture_mcl", "mcl"):
            for powers in ((8.0, 16.0), (1.0, 8.0)):
                printed, sharpened = (
                    make_filter(own, source, tiny_world.grid(), LIDAR, Settings(powers=powers, grid=GRID)).config
                    for own in (name, f"{name}_sharp")
                )
                assert (printed.weight_power, printed.estimate_power) == (1.0, 1.0)
                assert (sharpened.weight_power, sharpened.estimate_power) == powers
