"""Views ray-cast from the map: against a slow caster, under rotation, and as one side of Eq 3."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dsom_jax.nn import DSOMConfig
from dsom_jax.nn.panorama import PanoramaEncoder, expected_ranges, finer_ranges, view_features
from dsom_jax.nn.polar import bin_centres
from reference import rays

CONFIG = DSOMConfig(width=2, headings=8, channels=3, panorama=True, resolution=0.5, range_max=4.0, radial_bins=4)
ROOM = np.zeros((16, 16), bool)
ROOM[[0, 15]] = ROOM[:, [0, 15]] = True
ROOM[4:7, 9:11] = True
NO_RETURN, DISTANCE = 0, 1


def expected_views(occupied):
    return np.asarray(view_features(expected_ranges(jnp.asarray(occupied), CONFIG), CONFIG))


def test_views_are_means_of_the_slow_casters_ranges():
    views = expected_views(ROOM)
    assert views.shape == (8, 8, 8, 6)
    angles = np.asarray(bin_centres(CONFIG.angular_bins), np.float64)
    for i, j in [(3, 3), (5, 2), (6, 6), (1, 4)]:
        # One ray per call of the slow caster, from the corner that the four cells of a block share.
        reach = np.array([rays.cast(ROOM, 2 * j + 1.0, 2 * i + 1.0, angle)[0] for angle in angles]) * 0.5
        returned = reach < CONFIG.range_max
        np.testing.assert_allclose(views[i, j, :, NO_RETURN], (~returned).reshape(8, 4).mean(1), atol=1e-6)
        distance = np.minimum(reach, CONFIG.range_max).reshape(8, 4).mean(1) / CONFIG.range_max
        np.testing.assert_allclose(views[i, j, :, DISTANCE], distance, atol=1e-4)


def test_views_of_a_finer_map_are_the_slow_casters_in_it():
    fine = np.zeros((80, 80), bool)
    fine[[0, 79]] = fine[:, [0, 79]] = True
    fine[22:24, 30:61] = True
    fine[22:24, 44:47] = False  # a gap of 0.3 m, which maps of 0.5 m cells close
    surface = 0.05
    views = np.asarray(finer_ranges(jnp.asarray(fine), CONFIG, (16, 16), 0.1, surface))
    assert views.shape == (8, 8, CONFIG.angular_bins)
    angles = np.asarray(bin_centres(CONFIG.angular_bins), np.float64)
    for i, j in [(3, 3), (5, 2), (2, 4), (1, 4)]:
        reach = np.array([rays.cast(fine, 10 * j + 5.0, 10 * i + 5.0, angle)[0] for angle in angles]) * 0.1 + surface
        np.testing.assert_allclose(views[i, j], np.where(reach < CONFIG.range_max, reach, np.inf), atol=1e-4)


def test_cells_cut_into_smaller_ones_are_the_same_map():
    fine = ROOM.repeat(4, 0).repeat(4, 1)
    views = finer_ranges(jnp.asarray(fine), CONFIG, ROOM.shape, CONFIG.resolution / 4)
    # Those inside of walls are at distance zero either way.
    np.testing.assert_allclose(views, expected_ranges(jnp.asarray(ROOM), CONFIG), atol=1e-4)


def test_turning_the_map_turns_the_views():
    views = expected_views(ROOM)
    # A quarter turn counter-clockwise with rows from the bottom up: (i, j) -> (j, H - 1 - i).
    turned = expected_views(ROOM.T[:, ::-1])
    np.testing.assert_allclose(turned, np.roll(views.swapaxes(0, 1)[:, ::-1], 2, axis=2), atol=1e-4)


def test_every_headings_features_have_length_one():
    encoder = PanoramaEncoder(CONFIG, np.random.default_rng(0))
    features = encoder(jnp.asarray(np.stack([ROOM, ROOM.T])))
    assert features.shape == (2, 8, 8, 8 * 3)
    length = jnp.linalg.norm(features.reshape(2, 8, 8, 8, 3), axis=-1)
    np.testing.assert_allclose(length, 1.0, atol=1e-2)


def test_maps_of_a_batch_do_not_mix():
    view = PanoramaEncoder(CONFIG, np.random.default_rng(0))
    view.block.norm.use_running_average = True
    both = jax.jit(lambda maps: view(maps))(jnp.asarray(np.stack([ROOM, ROOM.T])))
    np.testing.assert_allclose(both[1], view(jnp.asarray(ROOM.T)[None])[0], atol=1e-5)


def test_the_papers_encoder_has_no_panorama():
    with pytest.raises(ValueError, match="polar"):
        DSOMConfig(encoder="paper", panorama=True)
