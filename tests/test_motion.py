"""Motion models: exact without noise, moments by Monte-Carlo, densities that integrate to one and match the samples."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from dsom_jax.motion import OdometryMotion, OmniMotion, omni_like
from reference import se2

QUIET = dict(alpha1=0.0, alpha2=0.0, alpha3=0.0, alpha4=0.0, min_xy=0.0, min_theta=0.0)
SMALL = dict(alpha1=0.01, alpha2=0.002, alpha3=0.003, alpha4=0.001, min_xy=0.005, min_theta=0.004)
STEPS = {
    "ahead": (0.5, 0.0, 0.0),
    "arc": (0.5, 0.1, 0.4),
    "backwards": (-0.5, 0.0, 0.1),
    "sideways": (0.0, -0.4, 0.0),
    "turn": (0.0, 0.0, -1.2),
    "rest": (0.0, 0.0, 0.0),
    "crawl": (0.0, 0.008, 0.3),
    "crawl backwards": (-0.009, 0.0, 0.0),
}
N = 200_000
sample = jax.jit(lambda model, key, poses, odometry: model.sample(key, poses, odometry), static_argnums=0)
log_prob = jax.jit(lambda model, new, poses, odometry: model.log_prob(new, poses, odometry), static_argnums=0)


@pytest.mark.parametrize("step", STEPS)
@pytest.mark.parametrize("model", [OdometryMotion(**QUIET), OmniMotion(**QUIET, alpha5=0.0)], ids=["odometry", "omni"])
def test_without_noise_the_increment_is_composed(model, step):
    poses = np.array([[1.0, 2.0, 0.3], [-4.0, 0.5, 3.1], [0.0, 0.0, -2.0]])
    moved = sample(model, jax.random.key(0), jnp.asarray(poses, jnp.float32), jnp.array(STEPS[step]))
    expected = se2.compose(poses, np.array(STEPS[step]))
    np.testing.assert_allclose(moved[:, :2], expected[:, :2], atol=1e-5)
    assert se2.angle_gap(moved[:, 2], expected[:, 2]).max() < 1e-5


def errors(model, step, start=(3.0, -2.0, 2.5)):
    """(N, 3) sampled successors as seen from the noiseless one."""
    poses = jnp.broadcast_to(jnp.array(start), (N, 3))
    moved = np.asarray(sample(model, jax.random.key(1), poses, jnp.array(step)), np.float64)
    mean = se2.compose(np.array(start), np.array(step))
    seen = np.linalg.inv(se2.matrix(mean)) @ se2.matrix(moved)
    return np.stack([seen[:, 0, 2], seen[:, 1, 2], np.arctan2(seen[:, 1, 0], seen[:, 0, 0])], -1)


def textbook(step):
    """Standard deviations of rotation, translation, rotation of table 5.6, for a robot that may drive backwards."""
    travel = math.hypot(step[0], step[1])
    first = math.atan2(step[1], step[0]) if travel >= 0.01 else 0.0
    turns = [min(abs(se2.angle_gap(a, 0.0)), abs(se2.angle_gap(a, np.pi))) for a in (first, step[2] - first)]
    m = SMALL
    of_turn = [math.sqrt(m["alpha1"] * t**2 + m["alpha2"] * travel**2 + m["min_theta"] ** 2) for t in turns]
    return of_turn[0], math.sqrt(m["alpha3"] * travel**2 + m["alpha4"] * sum(t**2 for t in turns)), of_turn[1]


@pytest.mark.parametrize("step", ["ahead", "backwards", "sideways", "turn", "rest"])
def test_moments_of_the_odometry_model(step):
    first, along, second = textbook(STEPS[step])
    travel = math.hypot(*STEPS[step][:2])
    way = math.atan2(STEPS[step][1], STEPS[step][0]) - STEPS[step][2]
    seen = errors(OdometryMotion(**SMALL), STEPS[step])
    ahead = seen[:, 0] * math.cos(way) + seen[:, 1] * math.sin(way)
    across = seen[:, 1] * math.cos(way) - seen[:, 0] * math.sin(way)
    # min_xy is part of the translation's spread and of the floor that is added to both coordinates.
    expected = [
        math.hypot(along, math.sqrt(2) * SMALL["min_xy"]),
        math.hypot(travel * first, SMALL["min_xy"]),
        math.hypot(first, second),
    ]
    # Second order: a turn of the first rotation shortens the way by first^2 / 2, and by as much its square deviates.
    bend = travel * first**2
    for values, sigma in zip((ahead, across, seen[:, 2]), expected, strict=True):
        assert abs(values.mean()) < 5 * sigma / math.sqrt(N) + bend
        assert abs(values.std() - sigma) < 5 * sigma / math.sqrt(2 * N) + bend
    correlation = np.corrcoef(across, seen[:, 2])[0, 1]
    assert abs(correlation - travel * first**2 / (expected[1] * expected[2])) < 5 / math.sqrt(N) + bend


def test_moments_of_the_omni_model():
    model = OmniMotion(alpha1=0.02, alpha2=0.03, alpha3=0.01, alpha4=0.02, alpha5=0.04, min_xy=0.01, min_theta=0.02)
    step = (0.3, 0.4, 0.2)
    seen = errors(model, step)
    way = math.atan2(0.4, 0.3) - 0.2
    ahead = seen[:, 0] * math.cos(way) + seen[:, 1] * math.sin(way)
    across = seen[:, 1] * math.cos(way) - seen[:, 0] * math.sin(way)
    expected = [
        math.sqrt(0.01 * 0.25 + 0.02 * 0.04 + 1e-4),
        math.sqrt(0.04 * 0.25 + 0.02 * 0.04 + 1e-4),
        math.sqrt(0.03 * 0.25 + 0.02 * 0.04 + 4e-4),
    ]
    for values, sigma in zip((ahead, across, seen[:, 2]), expected, strict=True):
        assert abs(values.mean()) < 5 * sigma / math.sqrt(N)
        assert abs(values.std() - sigma) < 5 * sigma / math.sqrt(2 * N)


MODELS = {
    "odometry": OdometryMotion(**SMALL),
    "omni": OmniMotion(**SMALL, alpha5=0.004),
}


@pytest.mark.parametrize("name", MODELS)
@pytest.mark.parametrize("step", ["arc", "backwards", "rest"])
def test_density_integrates_to_one(name, step):
    pose, odometry = jnp.array([1.0, 2.0, 3.0]), jnp.array(STEPS[step])
    mean = se2.compose(np.array(pose), np.array(STEPS[step]))
    drawn = np.asarray(sample(MODELS[name], jax.random.key(0), jnp.broadcast_to(pose, (N, 3)), odometry)) - mean
    drawn[:, 2] = np.angle(np.exp(1j * drawn[:, 2]))
    axes = [np.linspace(-6, 6, 41) * drawn[:, axis].std() for axis in range(3)]
    offsets = np.stack(np.meshgrid(*axes, indexing="ij"), -1)
    density = np.exp(np.asarray(log_prob(MODELS[name], jnp.asarray(mean + offsets, jnp.float32), pose, odometry)))
    # The sum of a Gaussian over 41 points within 12 standard deviations is exact; float32 coordinates are not.
    assert density.sum() * np.prod([axis[1] - axis[0] for axis in axes]) == pytest.approx(1.0, abs=5e-3)


@pytest.mark.parametrize("name", MODELS)
@pytest.mark.parametrize("step", ["arc", "turn", "crawl"])
def test_density_is_that_of_the_samples(name, step):
    """The entropy of a Gaussian: -E log p = 1/2 log det(2 pi e Sigma), with Sigma that of the samples."""
    pose, odometry = jnp.array([1.0, 2.0, 3.0]), jnp.array(STEPS[step])
    poses = jnp.broadcast_to(pose, (N, 3))
    moved = sample(MODELS[name], jax.random.key(2), poses, odometry)
    values = np.asarray(log_prob(MODELS[name], moved, poses, odometry), np.float64)
    offsets = np.asarray(moved, np.float64) - np.asarray(pose)
    offsets[:, 2] = np.angle(np.exp(1j * (offsets[:, 2] - STEPS[step][2])))
    entropy = 0.5 * np.linalg.slogdet(2 * np.pi * np.e * np.cov(offsets.T))[1]
    assert values.mean() == pytest.approx(-entropy, abs=0.02)  # first order in the noise
    # Twice the drop from the peak is chi-square with three degrees of freedom.
    drop = 2 * (values.max() - values)
    assert abs(np.median(drop) - stats.chi2(3).median()) < 0.05


def test_densities_broadcast_pairwise():
    poses, odometry = jnp.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]), jnp.array([0.3, 0.0, 0.0])
    for model in MODELS.values():
        table = model.log_prob(poses[:, None] + odometry, poses, odometry)
        assert table.shape == (2, 2) and bool(jnp.isfinite(table).all())
        assert table[0, 0] > table[0, 1] and table[1, 1] > table[1, 0]


def test_bad_parameters_are_refused():
    with pytest.raises(ValueError, match=r"alpha3 = -0\.1: must not be negative"):
        OdometryMotion(alpha3=-0.1)
    assert hash(OdometryMotion()) == hash(OdometryMotion())


def test_slips_drive_any_share_of_the_way():
    model = OdometryMotion(**QUIET, slip=0.3)
    x = np.asarray(sample(model, jax.random.key(0), jnp.zeros((N, 3)), jnp.array([0.5, 0.0, 0.0])))[:, 0]
    slipped = np.abs(x - 0.5) > 1e-5
    assert slipped.mean() == pytest.approx(0.3, abs=5 * 0.5 / math.sqrt(N))
    assert stats.kstest(x[slipped], "uniform", (-0.6, 1.2)).statistic < 2 / math.sqrt(0.3 * N)


def test_the_tail_is_wider_noise_for_some():
    plain, heavy = (
        np.asarray(sample(OdometryMotion(**SMALL, **tail), jax.random.key(1), jnp.zeros((N, 3)), jnp.zeros(3)))
        for tail in ({}, {"tail": 0.25, "tail_scale": 4.0})
    )
    # A mixture's variance is the mean of the variances; a sample variance of such tails deviates by about 1 %.
    np.testing.assert_allclose(heavy.var(0) / plain.var(0), 0.75 + 0.25 * 16, rtol=0.06)


def test_an_omnidirectional_drive_like_another_is_as_noisy():
    own = OdometryMotion(0.01, 0.02, 0.03, 0.04, 0.05, 0.06, slip=0.1)
    assert omni_like(own) == OmniMotion(0.01, 0.02, 0.03, 0.04, alpha5=0.03, min_xy=0.05, min_theta=0.06)


@pytest.mark.parametrize(("travel", "counts"), [(0.008, False), (0.012, True), (0.05, True)])
def test_the_direction_of_less_than_a_centimetre_is_no_turn(travel, counts):
    """nav2: a step to the side is a turn of 90 degrees and back, with its noise, from 1 cm on."""
    model = OdometryMotion(0.2, 0.0, 0.0, 0.0, min_xy=0.0, min_theta=0.0)
    _, sigma = model.spread(jnp.array([0.0, travel, 0.0]))
    expected = np.sqrt(0.2) * np.pi / 2 if counts else 0.0
    np.testing.assert_allclose(sigma, [expected, 0.0, expected], atol=1e-6)
