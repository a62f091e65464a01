"""The polar encoder: turning the robot turns S, whatever the lidar."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from dsom_jax.lidar import LidarConfig
from dsom_jax.nn.config import DSOMConfig
from dsom_jax.nn.encoders import PolarScanEncoder, roll_to_headings
from dsom_jax.nn.polar import polar_channels, polar_features, radial_basis

CONFIG = DSOMConfig(width=4, headings=8)
TURN = LidarConfig(beams=64, angle_increment=2 * math.pi / 64)


def scan(seed: int = 0) -> jax.Array:
    ranges = jax.random.uniform(jax.random.key(seed), (64,), minval=0.5, maxval=12.0)
    return jnp.where(ranges > 10.0, jnp.inf, ranges)


def test_turning_the_robot_by_one_heading_rolls_s_by_one():
    encoder = nnx.view(PolarScanEncoder(CONFIG, np.random.default_rng(0)), use_running_average=True)
    features = polar_features(scan(), TURN, CONFIG)
    # The robot turned left by one heading sees everything one heading further to the right.
    turned = polar_features(jnp.roll(scan(), -64 // 8), TURN, CONFIG)
    s, s_turned = jax.jit(lambda x: encoder(x))(jnp.stack([features, turned]))
    np.testing.assert_allclose(jnp.roll(s, 1, axis=0), s_turned, rtol=1e-4, atol=1e-4)


def test_heading_zero_leaves_the_features_in_place():
    x = jax.random.normal(jax.random.key(0), (1, 8, 3))
    np.testing.assert_array_equal(roll_to_headings(x)[0, 4], x[0].ravel())  # theta_4 = -pi + 4 * pi/4 = 0


def test_beam_count_hardly_matters():
    def wall(lidar):
        return polar_features(2.0 / jnp.maximum(jnp.abs(jnp.cos(jnp.asarray(lidar.angles()))), 0.2), lidar, CONFIG)

    fine = LidarConfig(beams=512, angle_increment=2 * math.pi / 512)
    # A beam may lie half a gap of 5.6 deg from the other lidar's: at 5 m along a slanted wall that is under 2 m of 10.
    assert jnp.abs(wall(fine) - wall(TURN))[:, :3].max() < 0.2


def test_partial_view_is_visible_only_where_it_looks():
    half = LidarConfig(beams=90, angle_min=-math.pi / 2, angle_increment=math.pi / 90)
    features = polar_features(jnp.full(90, 3.0), half, CONFIG)
    bins = np.abs(-math.pi + (np.arange(32) + 0.5) * 2 * math.pi / 32)
    margin = 2 * math.pi / 32  # a bin takes beams up to its own width away
    assert (features[bins < math.pi / 2 - margin, 0] == 1).all()
    assert (features[bins > math.pi / 2 + margin, 0] == 0).all()
    assert (features[features[:, 0] == 0] == 0).all()


def test_invalid_beams_are_not_seen_and_no_return_is_information():
    ranges = jnp.full(64, 3.0).at[:16].set(jnp.nan).at[16:32].set(-jnp.inf).at[32:48].set(jnp.inf)
    features = polar_features(ranges, TURN, CONFIG)
    assert (features[1:15, 0] == 0).all() and (features[17:31, 0] > 0).all()
    np.testing.assert_allclose(features[17:23, 1], 1.0, rtol=1e-5)
    np.testing.assert_allclose(features[25:31, 1], 0.0)
    assert jnp.isfinite(features).all() and features.shape == (32, polar_channels(CONFIG))


def test_mounting_offset_moves_the_bearings():
    forward = LidarConfig(beams=64, angle_increment=2 * math.pi / 64, mount=(0.0, 0.0, math.pi / 2))
    features = polar_features(scan(), TURN, CONFIG)
    np.testing.assert_allclose(
        polar_features(scan(), forward, CONFIG), jnp.roll(features, 8, axis=0), rtol=1e-3, atol=2e-3
    )


def test_radial_basis_shares_a_range_between_neighbours():
    np.testing.assert_allclose(radial_basis(jnp.linspace(0.3, 9.7, 50), CONFIG).sum(-1), 1.0, rtol=1e-5)


@pytest.mark.parametrize(
    "change",
    [{"width": 0}, {"headings": 7}, {"encoder": "x"}, {"encoder": "paper", "scan_size": 60}, {"resolution": 0.0}],
)
def test_config_refuses_nonsense(change):
    with pytest.raises(ValueError, match=next(reversed(change))):
        DSOMConfig(**change)


def test_misfit_names_the_reason():
    config = DSOMConfig(fov_min=math.pi)
    assert config.misfit(LidarConfig()) is None
    assert "field of view" in config.misfit(LidarConfig(beams=90))
    assert "range_max" in config.misfit(LidarConfig(range_max=4.0))
    assert "beams" in config.misfit(LidarConfig(beams=8, angle_increment=math.pi / 4))
