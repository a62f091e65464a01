"""Simulated drives: consistent, possible, reproducible."""

from __future__ import annotations

from functools import lru_cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import ndimage

from dsom_jax.episode import Episode
from dsom_jax.errors import UserError
from dsom_jax.geometry import compose, relative
from dsom_jax.lidar import LidarConfig, LidarNoise
from dsom_jax.motion import OdometryMotion
from dsom_jax.occupancy import OccupancyGrid, from_cells, is_free
from dsom_jax.simulate.drive import DriveConfig, make_synthetic
from dsom_jax.simulate.paths import roads, shortest_path, smooth
from dsom_jax.simulate.worlds import WorldConfig, make_world
from reference.rays import cast

EXACT = OdometryMotion(0.0, 0.0, 0.0, 0.0, min_xy=0.0, min_theta=0.0)
CLEAN = DriveConfig(
    updates=(30, 30),
    kidnap_distance=6.0,
    obstacles=8,
    removed=2,
    lidar=LidarConfig(beams=36, angle_increment=2 * np.pi / 36),
    lidar_noise=LidarNoise(),
    odometry=EXACT,
)


@lru_cache
def building() -> OccupancyGrid:
    return jax.jit(make_world, static_argnums=1)(jax.random.key(12), WorldConfig(cells=64))


@lru_cache
def clean_drive(seed: int = 1) -> tuple[OccupancyGrid, Episode]:
    return make_synthetic(seed, building(), CLEAN)


def test_zero_noise_odometry_leads_from_pose_to_pose() -> None:
    _, drive = clean_drive()
    kidnapped = np.asarray(drive.kidnapped)
    assert np.flatnonzero(kidnapped).tolist() == [30]
    reached = compose(drive.poses[:-1], drive.odometry[1:])
    # float32 coordinates of 20 m carry 2e-6 m; the chain of four operations stays within 1e-5.
    error = np.abs(np.asarray(relative(reached, drive.poses[1:])))
    assert error[~kidnapped[1:]].max() < 1e-5
    np.testing.assert_array_equal(drive.odometry[0], 0)


def test_a_kidnapping_is_far_and_its_odometry_looks_like_any_other() -> None:
    _, drive = clean_drive()
    jump = np.hypot(*(np.asarray(drive.poses)[30] - np.asarray(drive.poses)[29])[:2])
    assert jump >= CLEAN.kidnap_distance
    assert np.hypot(*np.asarray(drive.odometry)[30, :2]) <= CLEAN.update_min_d + 0.06


def test_updates_come_as_often_as_asked() -> None:
    moves = np.asarray(clean_drive()[1].odometry)[1:]
    travel, turn = np.hypot(moves[:, 0], moves[:, 1]), np.abs(moves[:, 2])
    # The dense path has a point every 5 cm and every 0.05 rad of turning in place; bends add a little.
    assert travel.max() <= CLEAN.update_min_d + 0.06 and turn.max() <= CLEAN.update_min_a + 0.2
    assert ((travel > CLEAN.update_min_d - 0.1) | (turn > CLEAN.update_min_a - 0.01)).mean() > 0.9


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_robot_stands_on_free_cells_of_map_and_world(seed: int) -> None:
    world, drive = clean_drive(seed)
    assert is_free(building(), drive.poses).all()
    assert is_free(world, drive.poses).all()


def test_the_world_differs_from_the_map_near_the_path_only() -> None:
    world, drive = clean_drive()
    added = np.asarray(world.occupied & ~building().occupied)
    removed = np.asarray(building().occupied & ~world.occupied)
    assert added.any() and removed.any()
    path = np.ones(world.shape, bool)
    j, i = np.floor(np.asarray(drive.poses)[:, :2] / world.resolution).astype(int).T
    path[i, j] = False
    distance = ndimage.distance_transform_edt(path) * world.resolution
    # Centres lie within ``near``; halves of the largest shapes (turned) and a cell's diagonal come on top.
    assert distance[added].max() <= CLEAN.near + 0.71 + 0.48
    assert distance[removed].max() <= CLEAN.near + 1.77 + 0.48
    assert distance[added].min() > CLEAN.margin


def test_scans_are_those_of_the_true_world() -> None:
    world, drive = clean_drive()
    occupied = np.asarray(world.occupied)
    for t in (0, 17, 45):
        x, y, theta = np.asarray(drive.poses[t], np.float64)
        for angle, got in zip(CLEAN.lidar.angles(), np.asarray(drive.ranges[t]), strict=True):
            cells, clearance = cast(occupied, x / world.resolution, y / world.resolution, theta + angle)
            expected = cells * world.resolution
            # Within rounding of a corner nobody can say on which side a ray passes.
            if clearance > 1e-3 and abs(expected - CLEAN.lidar.range_max) > 1e-3:
                assert got == pytest.approx(expected if expected < CLEAN.lidar.range_max else np.inf, abs=1e-3)


def test_noise_of_odometry_has_the_spread_it_was_given() -> None:
    noise = OdometryMotion(0.0, 0.0, 0.01, 0.0, min_xy=0.0, min_theta=0.0)
    _, drive = make_synthetic(1, building(), DriveConfig(**{**CLEAN.__dict__, "odometry": noise}))
    true, noisy = (np.hypot(*np.asarray(d.odometry)[1:, :2].T) for d in (clean_drive()[1], drive))
    ratio = (noisy / np.maximum(true, 1e-9))[true > 0.2]
    # Standard deviation 0.1 of the way from n samples: relative error 1 / sqrt(2 n), four of them allowed.
    assert abs(ratio.std() - 0.1) < 4 * 0.1 / np.sqrt(2 * len(ratio))


def test_the_same_seed_gives_the_same_drive() -> None:
    again = make_synthetic(1, building(), CLEAN)[1]
    for ours, theirs in zip(clean_drive()[1], again, strict=True):
        np.testing.assert_array_equal(ours, theirs)
    assert (np.asarray(clean_drive(2)[1].poses) != np.asarray(again.poses)).any()


def test_stamps_increase() -> None:
    stamps = np.asarray(clean_drive()[1].stamps)
    assert stamps[0] == 0 and (np.diff(stamps) > 0).all()


def test_drives_follow_the_origin_of_the_map() -> None:
    plain = building()
    moved = from_cells(plain.occupied, plain.free, resolution=plain.resolution, origin=(5.0, -3.0, 0.7))
    _, drive = make_synthetic(1, moved, CLEAN)
    np.testing.assert_allclose(moved.to_grid(drive.poses)[:, :2], clean_drive()[1].poses[:, :2], atol=1e-4)
    # Noise-free scans are the same wherever the map lies, but for rays that graze a corner.
    close = np.isclose(drive.ranges, clean_drive()[1].ranges, atol=1e-2)
    assert close.mean() > 0.97


def test_paths_end_where_they_should_and_smoothing_keeps_them_free() -> None:
    network = roads(building())
    path = shortest_path(network, 0, len(network.cells) - 1)
    smoothed = smooth(network, path)
    np.testing.assert_allclose(smoothed[[0, -1]], path[[0, -1]], atol=1e-6)
    assert network.is_free(smoothed).all()
    assert np.hypot(*np.diff(smoothed, axis=0).T).max() < 0.06


def test_a_diagonal_gap_is_no_road() -> None:
    free = np.zeros((6, 6), bool)
    free[:3, :3] = free[3:, 3:] = True
    assert roads(from_cells(jnp.asarray(~free), resolution=0.3)).free.sum() == 9


def test_fine_maps_are_planned_on_coarser_cells_that_are_free_throughout() -> None:
    cells = np.zeros((120, 160), bool)
    cells[[0, -1], :] = cells[:, [0, -1]] = True
    cells[:70, 80] = True
    grid = from_cells(jnp.asarray(cells), jnp.asarray(~cells).at[60:64, 20:24].set(False), resolution=0.05)
    network = roads(grid)
    assert network.resolution > grid.resolution
    path = smooth(network, shortest_path(network, 0, len(network.cells) - 1))
    poses = jnp.asarray(np.column_stack([path, np.zeros(len(path))]))
    assert is_free(grid, poses).all()
    j, i = np.floor(path / 0.05).astype(int).T
    # A coarse cell of 0.15 m hides at most its diagonal of the clearance.
    assert (ndimage.distance_transform_edt(~cells) * 0.05)[i, j].min() > 0.3 - 0.15 * np.sqrt(2)


def test_maps_that_cannot_be_driven_are_refused() -> None:
    with pytest.raises(UserError, match="no free cell"):
        make_synthetic(0, from_cells(jnp.ones((20, 20), bool), resolution=0.3), CLEAN)
    with pytest.raises(UserError, match="kidnap_distance"):
        make_synthetic(0, from_cells(jnp.zeros((12, 12), bool), resolution=0.3), CLEAN)
    spot = jnp.ones((12, 12), bool).at[5, 5].set(False)
    with pytest.raises(UserError, match="single free cell"):
        make_synthetic(0, from_cells(spot, resolution=0.3), CLEAN)


@pytest.mark.parametrize(
    ("wrong", "named"),
    [({"updates": (1,)}, "updates"), ({"update_min_d": 0.0}, "update_min_d"), ({"obstacles": -1}, "obstacles")],
)
def test_impossible_configs_are_refused(wrong: dict, named: str) -> None:
    with pytest.raises(ValueError, match=named):
        DriveConfig(**wrong)
