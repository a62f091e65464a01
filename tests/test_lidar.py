"""Bearings, conventions of REP-117, moments of the noise, and the scan image on literal grids."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dsom_jax.lidar import LidarConfig, LidarNoise, apply_limits, observe, scan_image, scan_points
from reference import se2

FOUR = LidarConfig(beams=4, angle_min=-math.pi, angle_increment=math.pi / 2, range_max=10.0)  # back, right, ahead, left
INF, NAN = np.inf, np.nan
N = 100_000


def test_bearings_start_at_angle_min():
    assert se2.angle_gap(FOUR.angles(), np.radians([-180, -90, 0, 90])).max() < 1e-6
    assert FOUR.fov == pytest.approx(2 * math.pi)


def test_mount_yaw_and_upside_down():
    half = dict(beams=3, angle_min=-0.5, angle_increment=0.5)
    np.testing.assert_allclose(LidarConfig(**half, mount=(0.3, 0.1, 0.2)).angles(), [-0.3, 0.2, 0.7], atol=1e-6)
    # Head down, the first beam of the sensor is the one on the robot's left.
    np.testing.assert_allclose(LidarConfig(**half, upside_down=True).angles(), [0.5, 0.0, -0.5], atol=1e-6)
    np.testing.assert_allclose(
        LidarConfig(**half, upside_down=True, mount=(0.0, 0.0, 0.2)).angles(), [0.7, 0.2, -0.3], atol=1e-6
    )


@pytest.mark.parametrize("step", [1, 3, 5, 7, 400])
def test_every_keeps_the_same_beams(step):
    lidar = LidarConfig(mount=(0.1, 0.2, 0.3))
    np.testing.assert_allclose(lidar.every(step).angles(), lidar.angles()[::step], atol=1e-5)


def test_limits_of_rep_117():
    lidar = LidarConfig(beams=8, angle_increment=0.1, range_min=0.2, range_max=5.0)
    ranges = jnp.array([0.1, 0.2, 4.99, 5.0, 7.0, INF, -INF, NAN])
    expected = [-INF, 0.2, 4.99, INF, INF, INF, -INF, NAN]
    np.testing.assert_array_equal(apply_limits(ranges, lidar), np.array(expected, np.float32))


@pytest.mark.parametrize(
    ("fields", "said"),
    [
        (dict(angle_min=-180.0, angle_increment=1.0), "degrees instead of radians"),
        (dict(angle_min=-90.0, angle_increment=math.pi / 360), "degrees instead of radians"),
        (dict(angle_increment=0.5), "degrees instead of radians"),
        (dict(beams=0), "beams = 0"),
        (dict(range_min=3.0, range_max=2.0), "range_min < range_max"),
        (dict(range_min=-1.0), "range_min < range_max"),
        (dict(range_max=INF), "range_max"),
    ],
)
def test_bad_geometry_is_refused(fields, said):
    with pytest.raises(ValueError, match=said):
        LidarConfig(**fields)


def test_configs_are_static():
    assert hash(LidarConfig()) == hash(LidarConfig()) and LidarConfig() == LidarConfig()
    assert hash(LidarNoise()) == hash(LidarNoise())


def observed(noise: LidarNoise, true: float = 4.0, seed: int = 0) -> np.ndarray:
    return np.asarray(observe(jax.random.key(seed), jnp.full(N, true), FOUR, noise))


def test_without_noise_only_limits_apply():
    ranges = jnp.array([[1.0, 9.99, 10.5, INF], [NAN, 3.0, 0.0, 10.0]])
    expected = np.array([[1.0, 9.99, INF, INF], [NAN, 3.0, 0.0, INF]], np.float32)
    np.testing.assert_array_equal(observe(jax.random.key(0), ranges, FOUR, LidarNoise()), expected)


def test_what_is_no_return_too_close_or_invalid_stays_so_under_noise():
    ranges = jnp.array([INF, -INF, NAN, 0.0])
    noisy = np.asarray(observe(jax.random.key(1), ranges, FOUR, LidarNoise(sigma=0.01, sigma_relative=0.01)))
    assert noisy[0] == INF and noisy[1] == -INF and np.isnan(noisy[2])


def test_moments_of_gaussian_noise():
    values = observed(LidarNoise(sigma=0.03, sigma_relative=0.01))
    sigma = 0.03 + 0.01 * 4.0
    assert abs(values.mean() - 4.0) < 5 * sigma / math.sqrt(N)
    assert abs(values.std() - sigma) < 5 * sigma / math.sqrt(2 * N)


def test_share_of_dropouts():
    lost = np.isposinf(observed(LidarNoise(dropout=0.2))).mean()
    assert abs(lost - 0.2) < 5 * math.sqrt(0.2 * 0.8 / N)


@pytest.mark.parametrize(("true", "reach"), [(4.0, 4.0), (INF, 10.0)])
def test_early_returns_are_uniform_along_the_beam(true, reach):
    values = observed(LidarNoise(short=0.3), true)
    early = values[values < reach]
    assert abs(len(early) / N - 0.3) < 5 * math.sqrt(0.3 * 0.7 / N)
    assert abs(early.mean() - reach / 2) < 5 * reach / math.sqrt(12 * len(early))
    assert (values[values >= reach] == true).all()


def test_a_seed_is_a_scan():
    noise = LidarNoise(sigma=0.1, dropout=0.1, short=0.1)
    np.testing.assert_array_equal(observed(noise, seed=3), observed(noise, seed=3))
    assert (observed(noise, seed=3) != observed(noise, seed=4)).any()


def test_points_of_a_mounted_sensor_by_hand():
    # A sensor half a metre ahead of the base that looks to the left.
    lidar = LidarConfig(beams=4, angle_increment=math.pi / 2, mount=(0.5, 0.0, math.pi / 2))
    points, valid = scan_points(jnp.array([1.0, INF, 2.0, NAN]), lidar)
    np.testing.assert_array_equal(valid, [True, False, True, False])
    np.testing.assert_allclose(points[0], [0.5, -1.0], atol=1e-6)
    np.testing.assert_allclose(points[2], [0.5, 2.0], atol=1e-6)
    assert bool(jnp.isfinite(points).all())


def test_points_are_matrix_products():
    rng = np.random.default_rng(0)
    mount = (0.3, -0.2, 0.7)
    lidar = LidarConfig(beams=19, angle_min=-1.5, angle_increment=0.17, mount=mount, upside_down=True)
    ranges = rng.uniform(0, 9, 19)
    bearing = -(-1.5 + 0.17 * np.arange(19))
    local = np.stack([ranges * np.cos(bearing), ranges * np.sin(bearing), np.ones(19)])
    expected = (se2.matrix(np.array(mount)) @ local)[:2].T
    np.testing.assert_allclose(scan_points(jnp.asarray(ranges), lidar)[0], expected, atol=1e-5)


def test_scan_image_by_hand():
    # Cells of a metre, base in the middle of cell (2, 2); x ahead runs to the right of the picture, y left upwards.
    image = np.asarray(scan_image(jnp.array([1.0, 2.0, 2.0, 1.0]), FOUR, 1.0, 5))
    expected = np.zeros((5, 5))
    expected[2, 1] = 1  # back 1 m
    expected[0, 2] = 1  # right 2 m
    expected[2, 4] = 1  # ahead 2 m
    expected[3, 2] = 1  # left 1 m
    np.testing.assert_array_equal(image, expected)
    assert image.dtype == np.float32


def test_scan_image_leaves_out_what_is_invalid_or_beyond_its_edge():
    assert not scan_image(jnp.array([INF, -INF, NAN, INF]), FOUR, 1.0, 5).any()
    image = np.asarray(scan_image(jnp.array([3.0, 3.0, 1.0, 3.0]), FOUR, 1.0, 5))
    assert image.sum() == 1 and image[2, 3] == 1  # nothing wraps around to the other side


def test_scan_image_of_an_even_size():
    # The base lies on the corner between the four middle cells.
    lidar = LidarConfig(beams=4, angle_min=-3 * math.pi / 4, angle_increment=math.pi / 2)
    image = np.asarray(scan_image(jnp.full(4, 0.5), lidar, 1.0, 4))
    expected = np.zeros((4, 4))
    expected[1:3, 1:3] = 1
    np.testing.assert_array_equal(image, expected)


def test_scan_image_under_vmap():
    ranges = jax.random.uniform(jax.random.key(0), (3, 4), maxval=3.0)
    together = jax.jit(jax.vmap(lambda r: scan_image(r, FOUR, 0.5, 8)))(ranges)
    np.testing.assert_array_equal(together, jnp.stack([scan_image(r, FOUR, 0.5, 8) for r in ranges]))
