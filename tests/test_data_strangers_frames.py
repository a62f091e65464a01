"""Bags as strangers bring them: whose scans, in which frames, and what a user has to say, against the drive made."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from dsom_jax.data import LogOptions, Report, load_log, load_map, se2
from dsom_jax.errors import UserError
from fixtures import strangers
from fixtures.strangers import (
    DRIFT,
    DRIVE,
    LIDAR,
    MOUNT,
    SCANS,
    SPINNING,
    START,
    Case,
    Lidar,
    drift,
    fixed,
    frames,
    lasers,
    load,
    localized,
    off,
    said,
    wheels,
)  # fmt: skip


@pytest.mark.parametrize("chosen", [None, "rear"])
def test_of_two_lidars_on_a_topic_one_is_used(tmp_path: Path, chosen: str | None) -> None:
    front, rear = Lidar(91, np.pi, frame="front"), Lidar(91, np.pi, (-0.2, 0.0, np.pi), "rear")
    mounts = [*fixed("base_link", "front", front.mount), *fixed("base_link", "rear", rear.mount)]
    both = [*lasers(DRIVE, front), *lasers(DRIVE, rear)[::2]]
    log = load(tmp_path, [*both, *wheels(DRIVE), *mounts], scan_frame=chosen)
    lidar, count, left = (rear, SCANS // 2, SCANS) if chosen else (front, SCANS, SCANS // 2)
    np.testing.assert_allclose(log.lidar.mount, lidar.mount, atol=1e-9)
    assert abs(len(log) - count) <= 1 and abs(said(log, "another lidar") - left) <= 1 and off(log, least=0.8) < 0.02
    with pytest.raises(UserError, match="--scan-frame top: the scans are of front, rear"):
        load_log(tmp_path / "made", LogOptions(scan_frame="top"))


@pytest.mark.parametrize(
    ("parent", "base"), [("odom_combined", "base_footprint"), ("robot1/odom", "robot1/base_link"), ("drift", "body")]
)
def test_odometry_in_tf_is_found_whatever_its_name(tmp_path: Path, parent: str, base: str) -> None:
    tree = [*frames(DRIVE, parent, base), *fixed(base, "laser", LIDAR.mount), *localized(DRIVE, parent)]
    # Beside the base: an antenna that does not move, and another robot that does, farther.
    tree += [
        *fixed(parent, "antenna", (3.0, 4.0, 1.0)),
        *frames(strangers.way(20.0, spin=1.0), "robot2/odom", "robot2/base"),
    ]
    log = load(tmp_path, [*lasers(DRIVE, LIDAR), *tree])
    assert (drift(log) < DRIFT).all() and said(log, f"{parent} -> {base}") == 1
    np.testing.assert_allclose(log.lidar.mount, LIDAR.mount, atol=1e-9)
    other = load_log(tmp_path / "made", LogOptions(odom_frame=parent))
    np.testing.assert_array_equal(other.odometry, log.odometry)
    with pytest.raises(UserError, match=f"--odom-frame wheel: frames that something moves in: .*{parent}"):
        load_log(tmp_path / "made", LogOptions(odom_frame="wheel"))


def test_the_chain_to_the_lidar_decides_between_children_of_the_odometry(tmp_path: Path) -> None:
    """A localization that publishes odom -> map is on no lidar's chain, though it comes first."""
    inverse = [(t, top, kind, ("odom", "map", *se2.inverse(np.array(v[2:])))) for t, top, kind, v in localized(DRIVE)]
    tree = [*inverse, *frames(DRIVE, "odom", "base_link"), *MOUNT]
    log = load(tmp_path, [*lasers(DRIVE, LIDAR), *tree], reference_tf="map")
    assert (drift(log) < DRIFT).all() and off(log) < 0.02
    # Noise of 2 cm and 5 mrad, at most 15 m from the odometry's origin: 0.1 m.
    assert np.median(np.hypot(*(log.reference - DRIVE.at(log.stamps))[:, :2].T)) < 0.1


def test_a_robot_of_several_is_told_by_its_namespace(tmp_path: Path) -> None:
    mine = [
        *lasers(DRIVE, LIDAR, topic="/a/scan"),
        *wheels(DRIVE, "/a/odom"),
        *fixed("base_link", "laser", LIDAR.mount, "/a/tf"),
    ]
    other = [*wheels(SPINNING, "/b/odom"), *fixed("base_link", "laser", (1.0, 1.0, 1.0), "/b/tf")]
    log = load(tmp_path, [*other, *mine])
    assert (drift(log) < DRIFT).all() and said(log, "odometry topic /a/odom taken") == 1
    np.testing.assert_allclose(log.lidar.mount, LIDAR.mount, atol=1e-9)


def test_the_mount_by_hand(tmp_path: Path) -> None:
    backwards = Lidar(180, mount=(-0.15, 0.05, np.pi))
    entries = [*lasers(DRIVE, backwards), *wheels(DRIVE)]
    log = load(tmp_path, entries, mount="-0.15, 0.05, 180deg")
    assert off(log) < 0.02 and not log.report.lines()
    hanging = load_log(tmp_path / "made", LogOptions(mount="0,0,0.5,upside-down")).lidar
    assert hanging.upside_down and hanging.mount == (0.0, 0.0, 0.5)
    assert said(load_log(tmp_path / "made"), "taken to sit on the base; --base-frame or --mount") == 1


def test_an_odometry_of_base_footprint_where_tf_knows_base_link(tmp_path: Path) -> None:
    entries = [*lasers(DRIVE, LIDAR), *wheels(DRIVE, child="base_footprint"), *MOUNT]
    log = load(tmp_path, entries)
    np.testing.assert_allclose(log.lidar.mount, LIDAR.mount, atol=1e-9)
    assert said(log, "base_link -> laser is taken for it; --base-frame") == 1
    chosen = load_log(tmp_path / "made", LogOptions(base_frame="base_link"))
    np.testing.assert_allclose(chosen.lidar.mount, LIDAR.mount, atol=1e-9)
    assert said(chosen, "the odometry is taken to be that of base_link") == 1


def test_the_odometry_of_another_base_frame(tmp_path: Path) -> None:
    """The rear axle moves in odom; asked for is the centre, 0.5 m before it."""
    tree = [*fixed("axle", "centre", (0.5, 0.0, 0.0)), *fixed("axle", "laser", (0.8, 0.0, 0.0))]
    log = load(tmp_path, [*lasers(DRIVE, LIDAR), *wheels(DRIVE, child="axle"), *tree], base_frame="centre")
    axle = load_log(tmp_path / "made")
    np.testing.assert_allclose(log.lidar.mount, (0.3, 0.0, 0.0), atol=1e-9)
    # Interpolated along chords: half a metre of lever times the square of half a step's turn, 0.02 rad.
    np.testing.assert_allclose(log.odometry, se2.compose(axle.odometry, np.array([0.5, 0, 0])), atol=2e-4)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"mount": "1,2"}, "--mount 1,2: give x,y,yaw"),
        ({"mount": "0,0,180"}, "radians or degrees as in"),
        ({"mount": "1e300,0,0"}, "--mount 1e300"),
        ({"mount": "0,0,0,sideways"}, "upside-down"),
        ({"laser_mask": ("80:100",)}, "--laser-mask 80:100: give FROM:TO"),
        ({"laser_mask": ("nan:1",)}, "--laser-mask nan:1"),
        ({"laser_min_range": -1.0}, "--laser-min-range -1"),
        ({"clock_offset": "soon"}, "--clock-offset soon: give seconds, or auto"),
        ({"scan_time": -1.0}, "--scan-time -1"),
        ({"odom_topic": "a", "odom_frame": "b"}, "leave it out, or --odom-topic"),
        ({"reference_topic": "a", "reference_tf": "b"}, "leave it out, or --reference-topic"),
    ],
)
def test_options_that_mean_nothing(options: dict, words: str) -> None:
    with pytest.raises(UserError, match=words):
        LogOptions(**options)


def test_options_of_bags_are_refused_for_other_logs(tmp_path: Path) -> None:
    (tmp_path / "a.log").write_text("FLASER 3 1 2 3 0 0 0 0 0 0 1.0 host 1.0\n")
    with pytest.raises(UserError, match="--odom-frame wheel: has no use, the log is no bag"):
        load_log(tmp_path / "a.log", LogOptions(odom_frame="wheel"))
    log = load_log(tmp_path / "a.log", LogOptions(mount="0.1,0,90deg", laser_min_range=1.5))
    assert log.lidar.mount[2] == pytest.approx(np.pi / 2) and np.isneginf(log.ranges[0, 0])


@pytest.mark.parametrize("kind", ["amcl", "pose", "odom"])
def test_a_reference_from_a_topic(tmp_path: Path, kind: str) -> None:
    """Poses each 2 s are carried to the scans between them by the odometry."""
    told = START + np.arange(0, 20, 2.0)
    poses = [(t, "/truth", kind, tuple(DRIVE.at(t).tolist())) for t in told]
    log = load(tmp_path, [*lasers(DRIVE, LIDAR), *wheels(DRIVE), *MOUNT, *poses], reference_topic="/truth")
    off = np.abs(se2.relative(log.reference, DRIVE.at(log.stamps)))
    # 2 % of at most 1 m, and what 50 steps of noise add to the heading.
    assert off[:, :2].max() < 0.04 and off[:, 2].max() < 0.01
    with pytest.raises(UserError, match="--reference-topic /lies: no such"):
        load_log(tmp_path / "made", LogOptions(reference_topic="/lies"))


def test_a_reference_from_tf_above_an_odometry_topic(tmp_path: Path) -> None:
    entries = [*lasers(DRIVE, LIDAR), *wheels(DRIVE), *MOUNT, *localized(DRIVE)]
    log = load(tmp_path, entries, reference_tf="map")
    assert np.median(np.hypot(*(log.reference - DRIVE.at(log.stamps))[:, :2].T)) < 0.1
    with pytest.raises(UserError, match=r"--reference-tf earth: /tf does not connect it with base_link; .*map"):
        load_log(tmp_path / "made", LogOptions(reference_tf="earth"))


def test_the_map_of_a_bag(tmp_path: Path) -> None:
    cells = strangers.cells()
    cells[5, 5:8] = (-1, 50, 64)
    grids = [
        (1000.0, "/map", "grid", (cells * 0, 0.05, 1.0, 2.0)),
        (1001.0, "/map", "grid", (cells, 0.05, -0.05, 1.0, 0.5)),
    ]
    grids.append((1000.0, "/local_costmap/costmap", "grid", (cells * 0, 0.05, 0.0, 0.0)))
    grid = load_map(Case(grids).write(tmp_path))
    np.testing.assert_array_equal(grid.occupied, cells == 100)
    np.testing.assert_array_equal(grid.free, cells == 0)
    np.testing.assert_allclose(grid.origin, (-0.05, 1.0, 0.5), atol=1e-6)
    with pytest.raises(UserError, match=r"holds no map \(nav_msgs/OccupancyGrid\); topics in the bag: /odom"):
        load_map(Case(wheels(DRIVE)[:9]).write(tmp_path / "none"))


@pytest.mark.parametrize(
    ("topics", "says"),
    [(("/a", "/b"), "several maps, none of them called map: /a, /b; record one"),
     (("/a/map", "/b/map", "/c"), "several maps, several of them called map: /a/map, /b/map, /c; record one")],
)  # fmt: skip
def test_of_several_maps_one_must_be_recorded_alone(tmp_path: Path, topics: tuple[str, ...], says: str) -> None:
    grids = [(1000.0, topic, "grid", (np.zeros((4, 5)), 0.05, 0.0, 0.0)) for topic in topics]
    with pytest.raises(UserError, match=f"made: {says} alone") as error:
        load_map(Case(grids).write(tmp_path))
    assert "--map" not in str(error.value)


def test_a_bag_of_maps_that_breaks_half_way(tmp_path: Path) -> None:
    """The last one that can be read is taken, and the place is told."""
    grids = [(1000.0 + k, "/map", "grid", (np.zeros((4 + k, 5)), 0.05, 0.0, 0.0)) for k in range(3)]
    path = Case(grids).write(tmp_path, "bag")
    whole = path.read_bytes()
    # The headers of messages in a rosbag1.
    marks = [at for at in range(len(whole)) if whole.startswith(b"op=\x02", at)]
    report = Report()
    path.write_bytes(whole[: marks[2]] + b"xx" + whole[marks[2] + 2 :])
    assert load_map(path, report).shape == (5, 5)
    assert [line for line in report.lines() if line.startswith("1 broken places where the bag was left")]
    path.write_bytes(whole[: marks[0]] + b"xx" + whole[marks[0] + 2 :])
    with pytest.raises(UserError, match=r"/map holds no map that can be read \(1 broken places .*\); record it again"):
        load_map(path)


def test_a_log_without_odometry_says_what_to_do(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"holds no odometry.*above laser.*record /odom or /tf"):
        load(tmp_path, [*lasers(DRIVE, LIDAR), *MOUNT])


def test_point_clouds_alone_are_told_how_to_convert(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"pointcloud_to_laserscan.* cloud_in:=/points") as error:
        load(tmp_path, [*wheels(DRIVE), (1000.0, "/points", "cloud", ())])
    assert "\n" not in str(error.value)
