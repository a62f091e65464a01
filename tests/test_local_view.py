"""The spatial transformer against slow crops, and the scan drawn on the same cells."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import tiny_world
from dsom_jax.errors import UserError
from dsom_jax.lidar import LidarConfig
from dsom_jax.nn.local_view import (
    ViewConfig,
    bilinear,
    corner_map,
    local_view,
    map_for,
    pack_corners,
    patch_order,
    scan_view,
)
from dsom_jax.occupancy import from_cells
from reference.local_view import crop

draw = jax.jit(scan_view, static_argnums=(1, 2))
look = jax.jit(local_view, static_argnums=2)
VIEW = ViewConfig(cells=16, resolution=0.3, map_resolution=0.25, beams=32, reach_min=5.0)


def picture(patches: np.ndarray, config: ViewConfig = VIEW) -> np.ndarray:
    """(cells, cells, ...) from patches (P, 16, ...)."""
    patches = np.asarray(patches)
    flat = np.zeros((config.cells**2, *patches.shape[2:]), patches.dtype)
    flat[patch_order(config)] = patches
    return flat.reshape(config.cells, config.cells, *patches.shape[2:])


@pytest.mark.parametrize(
    ("y", "x", "value"),
    [
        (1.5, 1.5, 1.0),  # centre of the occupied cell
        (1.5, 2.0, 0.5),  # its edge
        (2.0, 2.0, 0.25),  # its corner
        (1.5, 2.25, 0.25),
        (0.75, 1.0, 0.125),
        (1.5, 2.5, 0.0),  # centre of its neighbour
        (-3.0, 1.5, 0.0),
        (90.0, -90.0, 0.0),
    ],
)
def test_bilinear_by_hand(y, x, value):
    cells = np.zeros((3, 3), bool)
    cells[1, 1] = True
    assert float(bilinear(pack_corners(jnp.asarray(cells)), jnp.float32(y), jnp.float32(x))) == value


def test_a_full_map_is_full_up_to_its_outermost_centres():
    codes = pack_corners(jnp.ones((4, 5), bool))
    y, x = np.meshgrid(np.linspace(0.5, 3.5, 13), np.linspace(0.5, 4.5, 17), indexing="ij")
    np.testing.assert_allclose(bilinear(codes, y, x), 1.0, atol=1e-6)
    assert float(bilinear(codes, jnp.float32(0.0), jnp.float32(2.5))) == 0.5


def test_view_is_the_slow_crop():
    grid = tiny_world.grid()  # its origin is shifted and turned
    local = np.array([[3.1, 2.3, 0.3], [0.2, 4.8, -2.9], [5.9, 0.1, 1.57], [-9.0, 2.0, 0.0]], np.float32)
    views = look(corner_map(grid), grid.from_grid(jnp.asarray(local)), VIEW)
    for pose, view in zip(local, np.asarray(views), strict=True):
        # float32 positions of about 20 cells are off by a few 1e-6 cells, and slopes are at most one per cell
        np.testing.assert_allclose(picture(view), crop(tiny_world.cells(), 0.25, pose, 16, 0.3), atol=3e-5)


def test_gradient_along_a_path_adds_up_to_the_difference():
    place, start = corner_map(tiny_world.grid()), tiny_world.grid().from_grid(jnp.array([3.13, 2.21, 0.37]))
    weights, way = jax.random.normal(jax.random.key(0), (VIEW.patches, 16)), jnp.array([0.3, -0.2, 0.15])

    def value(share):
        return (local_view(place, start + share * way, VIEW) * weights).sum()

    slopes = jax.jit(jax.vmap(jax.grad(value)))((jnp.arange(2000) + 0.5) / 2000)
    # 256 samples cross some 500 kinks, each of which costs at most its jump (about 1) times the step.
    np.testing.assert_allclose(slopes.mean(), value(1.0) - value(0.0), atol=0.02)
    assert np.isfinite(slopes).all() and np.abs(slopes).max() > 1


def square_room(mount=(0.0, 0.0, 0.0)) -> tuple[np.ndarray, LidarConfig]:
    """Ranges of a sensor in the middle of a room of 4 m x 4 m, parallel to the robot's axes."""
    lidar = LidarConfig(beams=360, range_max=5.0, mount=mount)
    angles = lidar.angles()
    return (2.0 / np.maximum(np.abs(np.cos(angles)), np.abs(np.sin(angles)))).astype(np.float32), lidar


def test_scan_of_a_square_room():
    ranges, lidar = square_room()
    hit, through, seen = np.moveaxis(picture(draw(jnp.asarray(ranges), lidar, VIEW)), -1, 0)
    centres = (np.arange(16) + 0.5 - 8) * 0.3
    x, y = np.meshgrid(centres, centres)
    depth = np.maximum(np.abs(x), np.abs(y))
    assert (seen == 1).all()
    # Walls at 2 m lie between the centres at 1.95 and 2.25 m.
    assert (hit[(depth < 1.7) | (depth > 2.3)] == 0).all() and (hit[np.isclose(depth, 1.95)] > 0.5).all()
    assert (through[depth < 1.6] == 1).all() and (through[depth > 2.0] == 0).all()


def test_a_scan_is_drawn_from_where_the_sensor_is():
    """A sensor ahead of the base, to its right and turned, in the middle of the room: the walls lie about it."""
    ranges, lidar = square_room((0.6, -0.3, 2.5))
    hit, through, seen = np.moveaxis(picture(draw(jnp.asarray(ranges), lidar, VIEW)), -1, 0)
    centres = (np.arange(16) + 0.5 - 8) * 0.3
    x, y = np.meshgrid(centres - 0.6, centres + 0.3)
    depth = np.maximum(np.abs(x), np.abs(y))
    assert (hit[(depth < 1.7) | (depth > 2.3)] == 0).all() and (hit[np.isclose(depth, 1.95)] > 0.5).all()
    assert (through[depth < 1.6] == 1).all() and (through[depth > 2.0] == 0).all() and (seen == 1).all()
    assert hit.max() == 1.0  # however many beams end there


def test_what_lies_beyond_the_range_is_not_seen():
    near = LidarConfig(beams=360, range_max=1.5)
    _, through, seen = np.moveaxis(picture(draw(jnp.full(360, jnp.inf), near, VIEW)), -1, 0)
    centres = (np.arange(16) + 0.5 - 8) * 0.3
    distance = np.hypot(*np.meshgrid(centres, centres))
    np.testing.assert_array_equal(seen, distance < 1.5)
    assert (through[distance < 1.2] == 1).all() and not through[distance > 1.5].any()


def test_patches_are_squares_and_four_in_a_row_make_one():
    """The network joins every four patches that follow each other."""
    order = patch_order(VIEW)
    assert sorted(order.ravel().tolist()) == list(range(256))
    for cells, side in ((order, 4), (order.reshape(-1, 64), 8)):
        for square in cells:
            i, j = square // 16, square % 16
            assert np.ptp(i) == np.ptp(j) == side - 1 and i.min() % side == j.min() % side == 0
    # Rows along y, columns along x, in a patch and among the patches.
    assert (order[0] == [i * 16 + j for i in range(4) for j in range(4)]).all()
    assert order[:4, 0].tolist() == [0, 4, 64, 68] and order[4, 0] == 8


def test_invalid_beams_are_not_seen_and_missing_returns_see_through():
    ranges, lidar = square_room()
    ahead = np.abs(lidar.angles()) < math.pi / 4
    blind = picture(draw(jnp.where(ahead, jnp.nan, ranges), lidar, VIEW))
    assert (blind[7:9, 10:] == 0).all() and (blind[7:9, :6, 2] == 1).all()
    close = picture(draw(jnp.where(ahead, -jnp.inf, ranges), lidar, VIEW))
    np.testing.assert_array_equal(close, blind)
    empty = picture(draw(jnp.where(ahead, jnp.inf, ranges), lidar, VIEW))
    assert (empty[7:9, 10:, 1] == 1).all() and (empty[7:9, 10:, 0] == 0).all()


def test_directions_without_beams_are_not_seen():
    lidar = LidarConfig(beams=180, angle_min=-math.pi / 2, angle_increment=math.pi / 180, range_max=5.0)
    seen = picture(draw(jnp.full(180, 2.0), lidar, VIEW))[..., 2]
    assert (seen[:, 9:] == 1).all() and (seen[:, :6] == 0).all()


def test_pictures_of_map_and_scan_agree_at_the_true_pose():
    episode, place = tiny_world.drive(3), corner_map(tiny_world.grid())
    scan = draw(episode.ranges[0], tiny_world.LIDAR, VIEW)

    def agreement(pose):
        return float((look(place, pose, VIEW) * (scan[..., 0] - 0.3 * scan[..., 1])).sum())

    true = agreement(episode.poses[0])
    shifts = ([0.4, 0, 0], [-0.4, 0, 0], [0, 0.4, 0], [0, -0.4, 0], [0, 0, 0.3], [0, 0, -0.3])
    assert all(agreement(episode.poses[0] + jnp.array(shift)) < true for shift in shifts)


def test_maps_come_to_the_scale_of_the_network():
    fine = from_cells(np.zeros((30, 40), bool), resolution=0.1)
    assert map_for(fine, VIEW).resolution == 0.25
    assert map_for(tiny_world.grid(), VIEW).shape == tiny_world.grid().shape
    with pytest.raises(UserError, match=r"map: 0\.5 m per cell.*works at 0\.25"):
        map_for(from_cells(np.zeros((30, 40), bool), resolution=0.5), VIEW)


@pytest.mark.parametrize(
    ("lidar", "reason"),
    [
        (LidarConfig(), None),
        (LidarConfig(beams=90, angle_increment=math.radians(1)), "field of view 90 deg"),
        (LidarConfig(range_max=4.0), "range_max 4 m"),
        (LidarConfig(beams=8, angle_increment=2 * math.pi / 8), "8 beams"),
    ],
)
def test_lidars_that_do_not_fit(lidar, reason):
    found = VIEW.misfit(lidar)
    assert found is None if reason is None else reason in found
