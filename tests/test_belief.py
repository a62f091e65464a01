"""Which place: the belief over the grid against slow references, and the focus against the whole grid."""

from __future__ import annotations

import math
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import tiny_world
from dsom_jax.belief.focus import first_set, rows_ahead
from dsom_jax.belief.grid_belief import grid_belief, novelty
from dsom_jax.belief.grid_memory import GridBeliefConfig
from dsom_jax.belief.moving import moved_everywhere
from dsom_jax.geometry import relative
from dsom_jax.lidar import LidarConfig
from dsom_jax.occupancy import from_cells
from dsom_jax.pose_grid import cell_pose
from dsom_jax.proposals.likelihood_grid import LikelihoodGridConfig, likelihood_grid
from dsom_jax.raycast import RaycastConfig, cast_rays, make_tables
from dsom_jax.sensor import beam_log_likelihood
from dsom_jax.types import Inputs
from filters_kit import BEAM, GRID, LIDAR
from reference import markov

ROOM = np.ones((7, 9), bool)
ROOM[1:6, 1:8] = False
ROOM[2, 4] = True
SMALL = LikelihoodGridConfig(resolution=0.5, headings=8, angles_per_heading=2, beams=8, model=BEAM)
PLAIN = GridBeliefConfig(beams=8, rows=64, pool=256, samples=64, slip=0.2, fits=-1e3)
NEVER = replace(PLAIN, fits=1e3)
"""Never focuses."""


@pytest.fixture(scope="module")
def room():
    """Belief in a room of 7 x 9 cells of 0.5 m with a pillar, turned by 0.4 rad."""
    grid = from_cells(ROOM, resolution=0.5, origin=(3.0, -1.0, 0.4))
    return grid_belief(likelihood_grid(grid, LIDAR, SMALL), grid, NEVER)


@pytest.fixture(scope="module")
def tiny():
    grid = tiny_world.grid()
    return grid_belief(likelihood_grid(grid, tiny_world.LIDAR, GRID), grid, replace(PLAIN, beams=32, rows=200))


def dense(belief, mass):
    """(C, K) at the free cells -> (H, W, K)."""
    likelihood = belief.likelihood
    full = np.zeros((likelihood.free.size + 1, likelihood.config.headings))
    full[np.asarray(likelihood.cells)] = np.asarray(mass)
    return full[:-1].reshape(likelihood.pose_grid.shape)


def on_map(belief, memory):
    """(H, W, K) whichever way the memory holds it."""
    mass = belief._spread(memory.rows, memory.focus) if bool(memory.held) else memory.mass
    return dense(belief, mass)


def slow_move(belief, mass, odometry):
    """The slow reference; slips take the nearest cell, so the shares are put together one by one."""
    moved = (1 - belief.config.slip) * markov.predict(mass, np.ones(mass.shape[:2], bool), odometry, 0.5, slip=0.0)
    headings = mass.shape[2]
    rolled = np.zeros_like(mass)
    for i, j, k in np.argwhere(mass > 0):
        theta = -math.pi + k * 2 * math.pi / headings
        x = math.cos(theta) * odometry[0] - math.sin(theta) * odometry[1]
        y = math.sin(theta) * odometry[0] + math.cos(theta) * odometry[1]
        for step in (-1.0, 0.0):
            a, b = i + round(step * y / 0.5), j + round(step * x / 0.5)
            if 0 <= a < mass.shape[0] and 0 <= b < mass.shape[1]:
                rolled[a, b, k] += belief.config.slip / 2 * mass[i, j, k]
    turned = np.zeros_like(mass)
    for c in range(headings):
        for k in range(headings):
            gap = (c - k - odometry[2] / (2 * math.pi / headings) + headings / 2) % headings - headings / 2
            turned[..., c] += rolled[..., k] * markov.hat(gap)
    return (moved + turned) * ~ROOM[..., None]


@pytest.mark.parametrize("odometry", [(0.7, 0.0, 0.0), (0.33, -0.2, 0.9), (-0.6, 0.1, -2.5)])
def test_motion_against_the_slow_reference(room, odometry):
    rng = np.random.default_rng(1)
    mass = np.asarray(room.begin().mass) * rng.random(room.begin().mass.shape)
    told = jnp.asarray(odometry, jnp.float32)
    moved = moved_everywhere(room.likelihood, jnp.asarray(mass, jnp.float32), told, room.config.slip) * room._real()
    expected = slow_move(room, dense(room, mass), odometry)
    # Sums of some 30 products of float32 numbers, each with a relative error of 1e-7 times a few.
    np.testing.assert_allclose(dense(room, moved), expected, rtol=2e-5, atol=1e-6 * expected.max())


def test_an_update_is_bayes_rule_with_a_place_off_the_map(room):
    rng = np.random.default_rng(0)
    mass = np.asarray(room.begin().mass) * rng.random(room.begin().mass.shape)
    mass *= 0.7 / mass.sum()
    memory = room.begin()._replace(mass=jnp.asarray(mass, jnp.float32), off=jnp.float32(0.3))
    inputs = Inputs(jnp.full(LIDAR.beams, 1.1), jnp.array([0.3, 0.0, 0.2]), jnp.int32(4))
    _, after = room.prepare(memory, inputs)
    config, real = room.config, ~ROOM
    moved = slow_move(room, dense(room, mass), (0.3, 0.0, 0.2))
    away = 0.3 * (1 - config.enter) + 0.7 * config.leave
    even = np.broadcast_to(real[..., None], moved.shape) / (8 * real.sum())
    # No cell of this map is unknown: who comes back comes down anywhere.
    prior = 0.7 * moved / moved.sum() + 0.3 * config.enter / 2 * even + config.kidnap * even
    prior *= (1 - away) / prior.sum()
    evidence = dense(room, room.likelihood.tempered(1.0).log_likelihood(inputs.ranges))
    posterior = prior * np.exp(config.temper * evidence) * real[..., None]
    lost = away * math.exp(config.temper * room._unmapped() * 8)
    total = posterior.sum() + lost
    np.testing.assert_allclose(on_map(room, after), posterior / total, rtol=2e-4, atol=1e-9)
    assert float(after.off) == pytest.approx(lost / total, rel=1e-4)


def test_evidence_is_that_of_the_beam_model_at_the_cells(tiny):
    likelihood = tiny.likelihood
    episode = tiny_world.drive(2)
    evidence = np.asarray(likelihood.evidence(episode.ranges[0], 32))
    rows = jnp.array([5, 40, 77])
    some = np.asarray(likelihood.evidence(episode.ranges[0], 32, rows))
    np.testing.assert_allclose(some, evidence[np.asarray(rows)], rtol=1e-6)
    i, j = jnp.divmod(likelihood.cells[rows], likelihood.pose_grid.width)
    poses = cell_pose(likelihood.pose_grid, i, j, jnp.array([3, 8, 12]))
    tables = make_tables(tiny_world.grid(), GRID.raycast, likelihood.config.model.range_max)
    expected = cast_rays(tables, poses, tiny_world.LIDAR)
    exact = beam_log_likelihood(episode.ranges[0], expected, replace(BEAM, temper=1.0))
    # Directions are rounded to a quarter of a heading bin, ranges to a 1023rd: some of the 32 beams meet another wall.
    assert np.abs(np.asarray(exact) - evidence[np.asarray(rows), [3, 8, 12]]).max() < 0.4 * 32


@pytest.mark.parametrize("odometry", [(0.3, 0.0, 0.9), (-0.4, 0.2, -0.7), (0.0, 0.0, 0.0)])
def test_all_that_a_cell_can_reach_is_ahead(odometry):
    # A lidar that a turn of the base swings by two cells and more.
    hall = np.pad(np.zeros((22, 22), bool), 1, constant_values=True)
    grid, lidar = from_cells(hall, resolution=0.5), replace(LIDAR, mount=(1.2, 0.4, 0.3))
    belief = grid_belief(likelihood_grid(grid, lidar, SMALL), grid, NEVER)
    told, count = jnp.asarray(odometry, jnp.float32), belief.config.rows
    centre = int(belief.row_of[12 * 24 + 11])
    rows = jnp.full(count, len(belief.row_of)).at[0].set(centre)
    for heading in range(8):
        mass = jnp.zeros((belief.likelihood.cells.size, 8)).at[centre, heading].set(1.0)
        moved = moved_everywhere(belief.likelihood, mass, told, belief.config.slip) * belief._real()
        focus = jnp.zeros((count, 8)).at[0, heading].set(1.0)
        found, fits = rows_ahead(belief.likelihood, belief.row_of, rows, focus, told, belief.config.reach)
        assert bool(fits) and set(np.flatnonzero(moved.sum(-1) > 1e-6)) <= set(np.asarray(found).tolist())
        assert len(set(np.asarray(found).tolist())) < 80  # three squares of five cells a side, not the whole hall


def test_a_focus_gives_what_the_whole_grid_gives(tiny):
    episode = tiny_world.drive(10)
    whole = replace(tiny, config=replace(tiny.config, fits=1e3))
    step = jax.jit(lambda belief, memory, inputs: belief.prepare(memory, inputs))
    near, full = tiny.begin(), whole.begin()
    looked = []
    for t in range(10):
        inputs = jax.tree.map(lambda v, t=t: v[t], episode.inputs)
        _, near = step(tiny, near, inputs)
        _, full = step(whole, full, inputs)
        looked.append(bool(near.focused))
        # What is left out is 1e-4 of the mass at a time, and what leaves the reach of a cell whose share is below 1e-7.
        assert np.abs(on_map(tiny, near) - on_map(whole, full)).sum() < 2e-3 * (t + 1)
        assert float(near.off) == pytest.approx(float(full.off), abs=1e-3)
    assert sum(looked[:-1]) > 4 and not bool(full.focused)


@pytest.mark.parametrize("n", [5, 64, 1000])
@pytest.mark.parametrize("share", [0.0, 0.01, 0.5, 1.0])
def test_first_set_is_flatnonzero(n, share):
    flags = np.random.default_rng(n).random(n) < share
    for count in (3, 70):
        found = np.full(count, n)
        where = np.flatnonzero(flags)[:count]
        found[: len(where)] = where
        np.testing.assert_array_equal(first_set(jnp.asarray(flags), count), found)


def test_the_pool_stands_for_the_belief(tiny):
    episode = tiny_world.drive(3)
    memory = tiny.begin()
    for t in range(3):
        places, memory = tiny.prepare(memory, jax.tree.map(lambda v, t=t: v[t], episode.inputs))
    mass = on_map(tiny, memory)
    mass = mass.reshape(-1, mass.shape[2]) / mass.sum()
    counted = np.bincount(np.asarray(places.pool.cell), minlength=len(mass)) / tiny.config.pool
    # One stratum each along the cells: no cell's share is more than one draw off on either side.
    assert np.abs(counted - mass.sum(1)).max() <= 2 / tiny.config.pool
    at = np.asarray(places.pool.cell), np.asarray(places.pool.heading)
    volume = 0.25**2 * 2 * math.pi / mass.shape[1]
    density = np.asarray(tiny.likelihood.parts)[at[0], -1] / tiny.likelihood.parts.shape[1] * volume
    np.testing.assert_allclose(np.exp(np.asarray(places.pool.log_posterior)), mass[at] / density, rtol=1e-4)


def test_the_same_scan_again_says_nothing_new(tiny):
    episode = tiny_world.drive(2)
    inputs = jax.tree.map(lambda v: v[0], episode.inputs)
    step = jax.jit(lambda memory, index: tiny.prepare(memory, inputs._replace(index=index, odometry=jnp.zeros(3))))
    _, once = step(tiny.begin(), 0)
    memory = once
    for t in range(1, 30):
        places, memory = step(memory, t)
        assert float(places.novelty) == 0.0
    np.testing.assert_array_equal(on_map(tiny, memory), on_map(tiny, once))


def test_small_steps_add_up_to_one_that_counts(tiny):
    episode = tiny_world.drive(2)
    memory = tiny.begin()
    _, memory = tiny.prepare(memory, jax.tree.map(lambda v: v[0], episode.inputs))
    creep = Inputs(episode.ranges[0], jnp.array([0.02, 0.0, 0.0]), jnp.int32(1))
    moved = []
    for _ in range(5):
        _, memory = tiny.prepare(memory, creep)
        moved.append(float(memory.pending[0]))
    # 0.06 m is less than a quarter of 0.25 m, 0.08 m is more.
    assert moved == pytest.approx([0.02, 0.04, 0.06, 0.0, 0.02], abs=1e-6)


@pytest.mark.parametrize(
    ("odometry", "changed", "expected"),
    [((0, 0, 0), 0.0, 0.0), ((0.25, 0, 0), 0.0, 1.0), ((0.1, 0, 0.04), 0.0, 0.6), ((0, 0, 0), 0.35, 0.5),
     ((0, 0, 0), 1.0, 1.0)],
)  # fmt: skip
def test_novelty_by_hand(odometry, changed, expected):
    before = jnp.full(100, 2.0)
    now = before.at[: round(100 * changed)].add(1.0)
    assert float(novelty(before, now, jnp.array(odometry))) == pytest.approx(expected, abs=1e-6)


def twofold():
    """A hall that looks the same after half a turn, 6 m x 4 m."""
    walls = np.zeros((40, 60), bool)
    walls[[0, 1, -1, -2]] = walls[:, [0, 1, -1, -2]] = True
    walls[8:16, 10:14] = True
    walls[28:32, 20:26] = True
    return walls | walls[::-1, ::-1]


def test_two_equal_places_stay_equal():
    """Cells of 0.2 m over a map of 0.1 m: the viewpoint of a cell must not favour one end."""
    grid = from_cells(twofold(), resolution=0.1)
    lidar = LidarConfig(beams=60, angle_min=-np.pi, angle_increment=2 * np.pi / 60, range_max=8.0)
    config = LikelihoodGridConfig(resolution=0.2, headings=32, raycast=RaycastConfig("exact"), beams=60)
    config = replace(config, model=replace(config.model, range_max=8.0))
    belief = grid_belief(likelihood_grid(grid, lidar, config), grid, GridBeliefConfig(rows=200, pool=1024, fits=-1e3))
    tables = make_tables(grid, RaycastConfig("exact"), 8.0)
    x = np.linspace(0.7, 5.3, 24)
    poses = jnp.asarray(np.stack([x, 2.0 + 0.25 * np.sin(3 * x), 0.5 * np.cos(3 * x)], -1), jnp.float32)
    odometry = jnp.concatenate([jnp.zeros((1, 3)), relative(poses[:-1], poses[1:])])
    scans = cast_rays(tables, poses, lidar)
    step = jax.jit(lambda memory, inputs: belief.prepare(memory, inputs))
    memory = belief.begin()
    for t in range(len(x)):
        _, memory = step(memory, Inputs(scans[t], odometry[t], jnp.int32(t)))
        mass = on_map(belief, memory)
        mirrored = np.roll(mass[::-1, ::-1], mass.shape[2] // 2, axis=2)
        # Rays that graze a corner may miss it on one side: equal to a few per cent, not to the last bit.
        assert np.abs(mass - mirrored).sum() < 0.1


def test_a_map_that_explains_nothing_loses_to_no_map(tiny):
    rng = np.random.default_rng(0)
    step = jax.jit(lambda memory, inputs: tiny.prepare(memory, inputs))
    memory = tiny.begin()
    for t in range(12):
        scan = jnp.asarray(rng.uniform(0.3, 4.9, 32), jnp.float32)
        _, memory = step(memory, Inputs(scan, jnp.array([0.3, 0.0, 0.0]), jnp.int32(t)))
    assert float(memory.off) > 0.9
