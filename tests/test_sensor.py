"""Eq 15 by hand, the beam model beam by beam, the likelihood field on a literal grid."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import tiny_world
from dsom_jax.lidar import LidarConfig, scan_points
from dsom_jax.occupancy import from_cells
from dsom_jax.sensor import (
    BeamModel,
    LikelihoodField,
    RayTables,
    ScoreModel,
    beam_log_likelihood,
    beam_log_terms,
    beam_score,
    distance_field,
    field_log_likelihood,
    interpolate_cells,
    perfect_score,
)
from reference import sensor as slow

INF, NAN = np.inf, np.nan
MODEL = ScoreModel(sigma=2.0, alpha=0.9, beta=0.1, range_max=10.0)
PEAK = 0.9 / (2.0 * math.sqrt(2 * math.pi))  # 0.17952
FLOOR = 0.01


def score(observed, expected, model=MODEL):
    return float(beam_score(jnp.array(observed, jnp.float32), jnp.array(expected, jnp.float32), model))


@pytest.mark.parametrize(
    ("observed", "expected", "by_hand"),
    [
        ([4.0], [4.0], (PEAK + FLOOR) ** 3),
        ([4.0], [6.0], (PEAK * math.exp(-0.5) + FLOOR) ** 3),  # one sigma short
        ([8.0], [4.0], (PEAK * math.exp(-2.0) + FLOOR) ** 3),  # two sigma long
        ([INF], [INF], (PEAK + FLOOR) ** 3),  # both without return: no difference
        ([INF], [4.0], FLOOR**3),  # exactly one: the constant alone
        ([4.0], [INF], FLOOR**3),
        ([NAN], [4.0], 0.0),  # invalid is no evidence
        ([-INF], [4.0], 0.0),
        ([-INF], [INF], 0.0),
        ([NAN, 4.0], [1.0, 4.0], (PEAK + FLOOR) ** 3),
        ([4.0, 4.0, INF], [4.0, 6.0, 1.0], (PEAK + FLOOR) ** 3 + (PEAK * math.exp(-0.5) + FLOOR) ** 3 + FLOOR**3),
    ],
)
def test_score_by_hand(observed, expected, by_hand):
    assert score(observed, expected) == pytest.approx(by_hand, rel=1e-5)


def test_numbers_of_equation_15():
    # alpha / (sigma sqrt(2 pi)) + beta / L_max = 0.179524 + 0.01, cubed.
    assert score([3.0], [3.0]) == pytest.approx(0.0068076, abs=1e-7)


def readings(rng, shape):
    values = rng.uniform(0.05, 9.9, shape)
    kind = rng.random(shape)
    return np.where(kind < 0.15, INF, np.where(kind < 0.2, -INF, np.where(kind < 0.25, NAN, values)))


def expectations(rng, shape):
    return np.where(rng.random(shape) < 0.15, INF, rng.uniform(0.0, 9.99, shape))


fast_score = jax.jit(beam_score, static_argnums=2)


@given(st.integers(0, 100_000), st.sampled_from([5 / 3, 0.3]))
def test_score_beam_by_beam(seed, sigma):
    rng = np.random.default_rng(seed)
    observed, expected = readings(rng, 20).astype(np.float32), expectations(rng, (3, 20)).astype(np.float32)
    by_beam = [slow.score(list(observed), list(row), 0.9, 0.1, sigma, 10.0) for row in expected.astype(float)]
    np.testing.assert_allclose(fast_score(observed, expected, ScoreModel(sigma=sigma)), by_beam, rtol=2e-4, atol=1e-9)


@given(st.integers(0, 100_000))
def test_perfect_score_is_the_score_of_the_scan_itself(seed):
    observed = readings(np.random.default_rng(seed), 30).astype(np.float32)
    itself = np.where(observed > -INF, observed, 1.0)
    best = float(perfect_score(jnp.asarray(observed), MODEL))
    assert best == pytest.approx(score(observed, itself), rel=1e-5)
    assert score(observed, expectations(np.random.default_rng(seed + 1), 30)) <= best * (1 + 1e-6)


def test_an_invalid_scan_scores_nothing():
    assert float(perfect_score(jnp.full(5, NAN), MODEL)) == 0 and score([NAN] * 5, [1.0] * 5) == 0


def test_power_one_is_the_authors_code():
    model = ScoreModel(sigma=2.0, power=1)
    assert score([4.0, 4.0], [4.0, 6.0], model) == pytest.approx(PEAK * (1 + math.exp(-0.5)) + 2 * FLOOR, rel=1e-5)


BEAM = dict(z_hit=0.6, z_short=0.2, z_max=0.05, z_rand=0.15)
beam_model = BeamModel(**BEAM, sigma_hit=0.25, temper=0.5)
fast_terms = jax.jit(beam_log_terms, static_argnums=2)


@given(st.integers(0, 100_000))
def test_beam_model_beam_by_beam(seed):
    rng = np.random.default_rng(seed)
    observed, expected = readings(rng, 25).astype(np.float32), expectations(rng, 25).astype(np.float32)
    by_beam = [
        slow.beam_log(float(o), float(p), **BEAM, sigma=0.25, top=10.0) for o, p in zip(observed, expected, strict=True)
    ]
    np.testing.assert_allclose(fast_terms(observed, expected, beam_model), by_beam, rtol=1e-4, atol=1e-4)
    total = beam_log_likelihood(jnp.asarray(observed), jnp.asarray(expected), beam_model)
    assert float(total) == pytest.approx(0.5 * sum(by_beam), rel=1e-4, abs=1e-3)


@pytest.mark.parametrize("expected", [1.0, 4.0, 9.0, INF])
def test_beam_model_is_a_density_over_readings(expected):
    """All readings up to range_max and the lack of one make up the whole, but for what the mixture spends twice."""
    edges = np.linspace(0.0, 10.0, 40_001)
    middle = jnp.asarray((edges[1:] + edges[:-1]) / 2, jnp.float32)
    returned = np.exp(np.asarray(fast_terms(middle, jnp.full_like(middle, expected), beam_model), float)).mean() * 10.0
    missing = math.exp(float(fast_terms(jnp.float32(INF), jnp.float32(expected), beam_model)))
    # Without a return there is also z_rand / range_max, the density of a metre: 0.015 here.
    assert returned + missing == pytest.approx(1.0, abs=0.02)


def test_beam_model_prefers_the_truth_and_forgives_furniture():
    def log_of(o, p):
        return float(fast_terms(jnp.float32(o), jnp.float32(p), beam_model))

    assert log_of(4.0, 4.0) > log_of(4.0, 4.5) > log_of(4.0, 3.0)  # something in the way beats a wall gone
    assert log_of(INF, INF) > log_of(INF, 4.0)


@pytest.mark.parametrize(
    ("fields", "said"),
    [(dict(z_hit=0.5), "must be 1"), (dict(sigma_hit=0.0), "positive"), (dict(temper=0.0), "positive")],
)
def test_bad_beam_models_are_refused(fields, said):
    with pytest.raises(ValueError, match=said):
        BeamModel(**fields)


WALLS = np.array(
    [
        [0, 0, 0, 0, 0],
        [0, 0, 0, 0, 1],
        [0, 0, 0, 0, 0],
        [1, 0, 0, 0, 0],
        [0, 0, 0, 0, 0],
    ],
    bool,
)
FIELD = LikelihoodField(z_hit=0.8, z_rand=0.2, sigma_hit=0.5, max_distance=2.0, temper=0.5)
FOUR = LidarConfig(beams=4, angle_min=-math.pi, angle_increment=math.pi / 2)  # back, right, ahead, left


def test_distances_of_the_field_by_hand():
    grid = from_cells(WALLS, resolution=0.5)
    distance = np.asarray(distance_field(grid, FIELD))
    by_hand = {(1, 4): 0.0, (3, 0): 0.0, (2, 4): 0.5, (0, 3): math.sqrt(0.5), (1, 2): 1.0, (3, 2): 1.0, (4, 4): 1.5}
    for cell, metres in by_hand.items():
        assert distance[cell] == pytest.approx(metres, abs=1e-5)
    near = distance_field(grid, LikelihoodField(max_distance=0.7))
    assert float(near.max()) == pytest.approx(0.7)


@pytest.mark.parametrize("yaw", [0.0, 0.9])
def test_likelihood_field_by_hand(yaw):
    grid = from_cells(WALLS, resolution=0.5, origin=(3.0, -1.0, yaw))
    # In the middle of cell (1, 2), facing along the grid's x; every end point is the centre of a cell.
    pose = grid.from_grid(jnp.array([1.25, 0.75, 0.0]))
    ranges = jnp.array([0.5, INF, 1.0, 1.5])
    ends = [(0.75, 0.75), (2.25, 0.75), (1.25, 2.25)]
    by_hand = slow.field_log(WALLS, 0.5, ends, z_hit=0.8, z_rand=0.2, sigma=0.5, cut=2.0, top=10.0)
    value = field_log_likelihood(distance_field(grid, FIELD), grid, pose, ranges, FOUR, FIELD)
    assert float(value) == pytest.approx(0.5 * by_hand, rel=1e-4)
    many = field_log_likelihood(distance_field(grid, FIELD), grid, jnp.stack([pose] * 3), ranges, FOUR, FIELD)
    np.testing.assert_allclose(many, float(value), rtol=1e-5)


def test_bilinear_interpolation():
    field = jnp.array([[0.0, 1.0], [2.0, 5.0]])
    i, j = jnp.array([0.0, 0.5, 1.0, 0.25, -3.0, 9.0]), jnp.array([0.5, 0.5, 0.0, 1.0, 0.0, 9.0])
    np.testing.assert_allclose(interpolate_cells(field, i, j), [0.5, 2.0, 2.0, 2.0, 0.0, 5.0], atol=1e-6)


def test_an_invalid_scan_says_nothing():
    grid = from_cells(WALLS, resolution=0.5)
    poses = jnp.array([[1.0, 1.0, 0.0], [2.0, 2.0, 1.0]])
    nothing = jnp.full(4, NAN)
    np.testing.assert_array_equal(beam_log_likelihood(nothing, jnp.ones((2, 4)), beam_model), 0.0)
    np.testing.assert_array_equal(
        field_log_likelihood(distance_field(grid, FIELD), grid, poses, nothing, FOUR, FIELD), 0.0
    )


MODELS = {
    "score": ScoreModel(sigma=0.5, temper=2.0, range_max=5.0),
    "beam": BeamModel(**BEAM, sigma_hit=0.25, temper=0.5, range_max=5.0),
    "likelihood_field": LikelihoodField(z_hit=0.8, z_rand=0.2, sigma_hit=0.5, temper=0.5, range_max=5.0),
}


def slowly(name, ranges, expected, ends):
    """Log-likelihood of one scan by the slow references, untempered."""
    if name == "score":
        best = slow.score(ranges, ranges, 0.9, 0.1, 0.5, 5.0)
        return math.log(slow.score(ranges, expected, 0.9, 0.1, 0.5, 5.0) / best)
    if name == "beam":
        return sum(slow.beam_log(o, p, **BEAM, sigma=0.25, top=5.0) for o, p in zip(ranges, expected, strict=True))
    return slow.field_log(tiny_world.cells(), 0.25, ends, z_hit=0.8, z_rand=0.2, sigma=0.5, cut=2.0, top=5.0)


@pytest.mark.parametrize("name", MODELS)
def test_models_behind_one_interface_against_the_slow_references(name):
    episode, model = tiny_world.drive(), MODELS[name]
    poses = episode.poses[:4]
    # A little off: a reading that is the expected one but for rounding is short or not by chance.
    ranges = (episode.ranges[1] + 0.013).at[3].set(INF).at[7].set(NAN).at[11].add(0.4)
    rays = RayTables(tiny_world.tables(), tiny_world.LIDAR)
    found = model.log_likelihood(model.tables(rays), poses, ranges)
    expected = np.asarray(tiny_world.cast(tiny_world.tables(), poses, tiny_world.LIDAR), float)
    points, hit = (np.asarray(x) for x in scan_points(ranges, tiny_world.LIDAR))
    for pose, row, value in zip(np.asarray(tiny_world.grid().to_grid(poses), float), expected, found, strict=True):
        c, s = math.cos(pose[2]), math.sin(pose[2])
        ends = [(pose[0] + c * x - s * y, pose[1] + s * x + c * y) for x, y in points[hit]]
        by_hand = model.temper * slowly(name, [float(r) for r in ranges], [float(r) for r in row], ends)
        # A term of a far beam is a product of numbers that float32 rounds; and rays may meet another cell's corner.
        assert float(value) == pytest.approx(by_hand, rel=1e-3, abs=5e-3)
    weights = np.asarray(model.weigh(model.tables(rays), poses, ranges))
    if name == "score":  # in units of a scan without any difference
        np.testing.assert_allclose(np.log(weights), found / 2.0, atol=1e-5)
    else:  # in units of the best of these poses
        np.testing.assert_allclose(weights, np.exp(found - np.max(found)), rtol=1e-5)
    assert np.argmax(weights) == 1 and weights.max() <= 1.0


def test_without_a_valid_beam_all_poses_weigh_the_same():
    rays = RayTables(tiny_world.tables(), tiny_world.LIDAR)
    for model in MODELS.values():
        nothing = jnp.full(tiny_world.LIDAR.beams, NAN)
        np.testing.assert_array_equal(model.weigh(model.tables(rays), tiny_world.drive().poses[:4], nothing), 1.0)
