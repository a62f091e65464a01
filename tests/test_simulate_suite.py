"""The frozen suite stays what it is, can be made again, and a user can list drives on maps of their own."""

from __future__ import annotations

import hashlib
import runpy
from functools import lru_cache
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from dsom_jax.data.suite import Suite, decode, encode, load_suite
from dsom_jax.episode import Episode
from dsom_jax.errors import UserError
from dsom_jax.geometry import compose, relative
from dsom_jax.lidar import LidarConfig
from dsom_jax.occupancy import OccupancyGrid, from_cells, is_free

FROZEN = "f37d938c504b6e19f4ae6b3e6dca892fb5ecb28787d6b197202284372f336ad7"
GENERATOR = Path(__file__).parents[1] / "experiments" / "suites" / "synthetic_v1.py"

OWN = """
name = "mine"
[lidar]
beams = 90
angle_increment = 0.069
range_max = 6.0
[[episodes]]
world = 4
cells = 64
seed = 3
updates = [6, 5]
obstacles = 3
removed = 1
kidnap_distance = 4
[[episodes]]
name = "office"
map = "office.yaml"
seed = 1
updates = [6, 5]
kidnap_distance = 4
obstacles = 3
removed = 1
"""


@lru_cache
def suite() -> Suite:
    return load_suite("synthetic-v1")


@lru_cache
def generator() -> dict:
    return runpy.run_path(str(GENERATOR))


def maps(suite: Suite) -> list[OccupancyGrid]:
    return [*suite.train_maps, *(grid for _, grid, _ in suite.episodes)]


def test_the_frozen_numbers_have_not_changed() -> None:
    digest = hashlib.sha256()
    for grid in maps(suite()):
        for cells in (grid.occupied, grid.free):
            digest.update(np.packbits(np.asarray(cells)).tobytes())
    for _, _, drive in suite().episodes:
        for part in drive:
            digest.update(np.ascontiguousarray(np.asarray(part)).tobytes())
    assert digest.hexdigest() == FROZEN


def test_the_suite_is_as_specified() -> None:
    assert len(suite().train_maps) == 18 and len(suite().episodes) == 6
    assert suite().lidar == LidarConfig()
    names = [name for name, _, _ in suite().episodes]
    assert [names.count(name) for name in sorted(set(names))] == [3, 3]
    for grid in maps(suite()):
        assert grid.shape == (128, 128) and grid.resolution == pytest.approx(1 / 3)
    for _, grid, drive in suite().episodes:
        assert drive.ranges.shape == (140, 360)
        assert np.flatnonzero(drive.kidnapped).tolist() == [70]
        assert is_free(grid, drive.poses).all()
        assert np.hypot(*np.asarray(drive.poses[70] - drive.poses[69])[:2]) >= 8.0


def test_no_test_map_is_a_training_map() -> None:
    train = np.stack([np.asarray(grid.occupied) for grid in suite().train_maps])
    for _, grid, _ in suite().episodes:
        assert ((train == np.asarray(grid.occupied)).mean((1, 2)) < 0.95).all()


def test_odometry_is_noisy_but_of_this_drive() -> None:
    for _, _, drive in suite().episodes:
        moved = ~np.asarray(drive.kidnapped)[1:]
        wrong = np.asarray(relative(compose(drive.poses[:-1], drive.odometry[1:]), drive.poses[1:]))[moved]
        assert 0.002 < np.abs(wrong[:, :2]).mean() < 0.05 and 0.002 < np.abs(wrong[:, 2]).mean() < 0.06


def test_one_building_can_be_generated_again() -> None:
    for seeds, frozen in (("TRAIN_SEEDS", suite().train_maps[0]), ("TEST_SEEDS", suite().episodes[0][1])):
        again = generator()["building"](generator()[seeds][0])
        np.testing.assert_array_equal(again.occupied, frozen.occupied)
        np.testing.assert_array_equal(again.free, frozen.free)


def test_one_drive_can_be_generated_again() -> None:
    script = generator()
    _, grid, frozen = suite().episodes[0]
    number = 100 * script["TEST_SEEDS"][0] + script["DRIVE_SEEDS"][0]
    again = script["make_synthetic"](number, grid, script["DRIVE"])[1]
    np.testing.assert_allclose(again.poses, frozen.poses, atol=1e-5)
    np.testing.assert_allclose(again.odometry, frozen.odometry, atol=1e-5)
    # Stored to the millimetre; rounding may tip a ray at a corner on another machine.
    assert (np.isclose(again.ranges, frozen.ranges, atol=6e-4) | (again.ranges == frozen.ranges)).mean() > 0.999


def test_encoding_keeps_what_is_special() -> None:
    ranges = jnp.asarray([[1.2345, jnp.inf, -jnp.inf, jnp.nan], [0.0, 9.9996, 3.0, 50.0]])
    drive = Episode(ranges, jnp.ones((2, 3)), jnp.zeros((2, 3)), jnp.asarray([False, True]), jnp.arange(2.0))
    grid = from_cells(jnp.zeros((9, 7), bool).at[2, 3].set(True), resolution=0.25)
    kept = decode("x", encode(Suite("x", LidarConfig(beams=4), (grid,), (("a", grid, drive),))))
    np.testing.assert_allclose(kept.episodes[0][2].ranges, ranges, atol=5.1e-4)
    for ours, theirs in zip(kept.episodes[0][2][1:], drive[1:], strict=True):
        np.testing.assert_array_equal(ours, theirs)
    np.testing.assert_array_equal(kept.train_maps[0].occupied, grid.occupied)
    assert kept.train_maps[0].resolution == 0.25


def write_own(folder: Path, text: str = OWN) -> Path:
    """A TOML suite beside a small ROS map: a hall of 21 m x 21 m with a pillar."""
    pixels = np.full((64, 64), 254, np.uint8)
    pixels[[0, -1], :] = pixels[:, [0, -1]] = 0
    pixels[20:30, 30:34] = 0
    (folder / "office.pgm").write_bytes(b"P5 64 64 255\n" + pixels.tobytes())
    (folder / "office.yaml").write_text(
        "image: office.pgm\nresolution: 0.3333333333333333\norigin: [-1.0, 2.0, 0.0]\nnegate: 0\n"
        "occupied_thresh: 0.65\nfree_thresh: 0.196\n"
    )
    (folder / "own.toml").write_text(text)
    return folder / "own.toml"


def test_a_suite_of_ones_own(tmp_path: Path) -> None:
    own = load_suite(write_own(tmp_path))
    assert own.name == "mine" and own.lidar.beams == 90 and own.train_maps == ()
    (first, world, drive), (second, office, short) = own.episodes
    assert (first, second) == ("world-4", "office")
    assert world.shape == (64, 64) and drive.ranges.shape == (11, 90) and drive.kidnapped.sum() == 1
    assert office.origin[0] == -1.0 and short.ranges.shape == (11, 90) and short.kidnapped.sum() == 1
    assert is_free(office, short.poses).all() and is_free(world, drive.poses).all()


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("episodes = [", "not valid TOML"),
        ("name = 'x'", "lists no drives"),
        ("[[episodes]]\nseed = 3", "episodes\\[0\\]: give either map"),
        ("[[episodes]]\nworld = 1\nobstacle = 3", "unknown field 'obstacle'.*obstacles"),
        ("[[episodes]]\nworld = -1", "world = -1"),
        ("[[episodes]]\nworld = 1\ncells = 8", "cells = 8"),
        ("[[episodes]]\nworld = 1\ncells = 64\nupdates = 70", "updates = 70.*whole numbers"),
        ("[[episodes]]\nworld = 1\ncells = 64\nupdates = [1]", "at least 2 updates"),
        ("[[episodes]]\nmap = 'absent.yaml'", "absent.yaml"),
        ("[[episodes]]\nmap = 'office.yaml'\nresolution = 0", "resolution = 0"),
        ("[[episodes]]\nmap = 'office.yaml'\nkidnap_distance = 90", "episodes\\[0\\].*kidnap_distance"),
        ("[lidar]\nbeam = 3\n[[episodes]]\nworld = 1", "lidar has an unknown field 'beam'"),
        ("[lidar]\nbeams = 0\n[[episodes]]\nworld = 1", "lidar: beams"),
        ("lidar = 3\n[[episodes]]\nworld = 1", "table \\[lidar\\]"),
    ],
)
def test_bad_suites_end_in_one_clear_line(tmp_path: Path, text: str, named: str) -> None:
    with pytest.raises(UserError, match=named) as raised:
        load_suite(write_own(tmp_path, text))
    assert "\n" not in str(raised.value).strip()


def test_missing_and_damaged_suites(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="no such suite; give one of synthetic-v1"):
        load_suite("synthetic-v9")
    with pytest.raises(UserError, match="no such suite file"):
        load_suite(tmp_path / "absent.toml")
    with pytest.raises(UserError, match="damaged"):
        decode("x", b"PK not an archive")
