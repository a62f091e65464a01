"""Bags as strangers bring them: angles, frames, clocks, mounts and references, against the drive they are made from."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dsom_jax.data import LogOptions, RawLog, load_log, load_map, se2, thin, to_episode
from dsom_jax.errors import UserError
from fixtures import strangers
from fixtures.make_bag import Entry, write_bag
from fixtures.strangers import Case, Lidar, fixed, frames, lasers, localized, wheels

DRIVE, SPINNING = strangers.way(12.0), strangers.way(12.0, spin=1.0)
LIDAR = Lidar(180)
MOUNT = fixed("base_link", "laser", LIDAR.mount)
SCANS = len(strangers.scan_stamps(DRIVE))


def load(folder: Path, entries: list[Entry], *, form: str = "db3", **options) -> RawLog:
    return load_log(Case(entries).write(folder, form), LogOptions(**options))


def said(log: RawLog, words: str) -> int:
    """How often the one note with these words holds."""
    (kind,) = [kind for kind in log.report.counts if words in kind]
    return log.report.counts[kind]


def off(log: RawLog, drive: strangers.Way = DRIVE, least: float = 0.9) -> float:
    """Median metres between what the log's beams read and the walls as the drive's poses see them."""
    poses = se2.compose(drive.at(log.stamps), np.array(log.lidar.mount))
    bearings = log.lidar.angles() - log.lidar.mount[2]
    expected = strangers.cast(poses, bearings)
    both = np.isfinite(log.ranges) & np.isfinite(expected)
    assert both.mean() > least
    return float(np.median(np.abs(log.ranges[both] - expected[both])))


def drift(log: RawLog) -> np.ndarray:
    """(2,) metres and radians that the odometry of the log is off after all, as its own drifts."""
    step = se2.relative(log.odometry[0], log.odometry[-1])
    true = se2.relative(DRIVE.at(log.stamps[0]), DRIVE.at(log.stamps[-1]))
    return np.abs(step - true) @ np.array([[1, 0], [1, 0], [0, 1]])


# The odometry is 2 % short: of the 14 m of this drive, whose ends are less far apart, 0.28 m at most.
DRIFT = (0.3, 0.05)


def test_every_scan_of_a_lidar_whose_beams_vary_is_used(tmp_path: Path) -> None:
    counts = np.random.default_rng(2).integers(170, 190, SCANS)
    log = load(tmp_path, [*lasers(DRIVE, LIDAR, beams=counts), *wheels(DRIVE), *MOUNT])
    assert len(log) == SCANS and log.lidar.beams == round(np.median(counts))
    assert log.lidar.fov == pytest.approx(2 * np.pi) and said(log, "170 to 189") > 0.9 * SCANS
    # Noise of 1 cm, and beams up to half a beam (1 deg) beside: 3 cm at 2 m on a slanted wall.
    assert off(log) < 0.03


def test_beams_that_start_elsewhere_in_every_scan(tmp_path: Path) -> None:
    entries = [*wheels(DRIVE), *MOUNT]
    for n, (t, topic, kind, (ranges, frame, start, step, dt)) in enumerate(lasers(DRIVE, LIDAR)):
        turned = n % 7
        entries.append((t, topic, kind, (np.roll(ranges, -turned), frame, start + turned * step, step, dt)))
    log = load(tmp_path, entries)
    assert len(log) == SCANS and said(log, "scans of other beams (180)") > 0.8 * SCANS
    assert off(log) < 0.02


def test_no_return_is_invented_between_a_near_and_a_far_wall() -> None:
    from dsom_jax.data.scans import Beams, nearest

    ranges = np.where(np.arange(90) < 45, 2.0, 8.0).astype(np.float32)
    found = nearest(np.linspace(-1, 1, 90), ranges, Beams(71, -1.0, 2 / 70), 2 / 89)
    assert set(found.tolist()) == {2.0, 8.0}
    # Outside of the scan nothing is known.
    wide = nearest(np.linspace(-1, 1, 90), ranges, Beams(101, -1.43, 2 / 70), 2 / 89)
    assert np.isnan(wide[[0, -1]]).all() and np.isfinite(wide[50])


def bent(factor: float, lidar: Lidar, *, of_end: bool) -> list[Entry]:
    """Scans whose angle_increment, or angle_max, is wrong by ``factor``."""
    out = []
    for t, topic, kind, (ranges, frame, start, step, dt) in lasers(DRIVE, lidar):
        span = step * (len(ranges) - 1)
        told = (step, start + span * factor) if of_end else (step * factor, start + span)
        out.append((t, topic, kind, (ranges, frame, start, told[0], dt, told[1])))
    return out


@pytest.mark.parametrize("span", [2 * np.pi, 1.5 * np.pi])
@pytest.mark.parametrize("of_end", [True, False])
@pytest.mark.parametrize("factor", [0.97, 1.03])
def test_of_two_increments_the_right_one_is_found(tmp_path: Path, span: float, of_end: bool, factor: float) -> None:
    lidar = Lidar(180, span)
    log = load(tmp_path, [*bent(factor, lidar, of_end=of_end), *wheels(DRIVE), *MOUNT])
    taken = "angle_increment is taken" if of_end else "angle_max is taken"
    assert said(log, taken) == SCANS and log.lidar.angle_increment == pytest.approx(span / 180, rel=1e-5)


def test_an_increment_that_nothing_decides_is_said(tmp_path: Path) -> None:
    entries = bent(0.97, Lidar(180, 1.5 * np.pi), of_end=False)[:15]
    log = load(tmp_path, [*entries, *wheels(DRIVE), *MOUNT])
    assert said(log, "angle_increment is taken, nothing tells") == 15


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


def spoilt(change) -> list[Entry]:
    """Odometry whose rows (x, y, yaw) from the middle on are changed."""
    half = strangers.START + 10.0
    return [(t, top, kind, (*change(np.array(v[:3])), v[3]) if t >= half else v) for t, top, kind, v in wheels(DRIVE)]


RESET = {
    "reset": lambda p: se2.relative(np.array([5.0, 1.0, 0.3]), p),
    "10 km": lambda p: se2.compose(np.array([1e4, 0.0, 0.0]), p),
    "turned": lambda p: se2.compose(np.array([0.0, 0.0, 2.0]), p),
}


@pytest.mark.parametrize("kind", RESET)
def test_a_jump_of_the_odometry_is_no_motion(tmp_path: Path, kind: str) -> None:
    log = load(tmp_path, [*lasers(DRIVE, LIDAR), *spoilt(RESET[kind]), *MOUNT])
    assert len(log) == SCANS and said(log, "jumps or resets") == 1 and (drift(log) < DRIFT).all()
    (at,) = np.flatnonzero(log.broken)
    assert log.stamps[at] == pytest.approx(strangers.START + 10.0, abs=0.11) and at in thin(log)
    assert np.abs(to_episode(log, thin(log)).odometry[:, :2]).max() < 0.5


def test_a_single_wild_odometry_message_is_dropped(tmp_path: Path) -> None:
    wild = [(t, a, b, (1e4, *v[1:]) if n in (100, 200) else v) for n, (t, a, b, v) in enumerate(wheels(DRIVE))]
    log = load(tmp_path, [*lasers(DRIVE, LIDAR), *wild, *MOUNT])
    assert said(log, "far from their neighbours") == 2 and not log.broken.any() and (drift(log) < DRIFT).all()


def test_odometry_that_never_moves_is_said(tmp_path: Path) -> None:
    frozen = [(t, a, b, (0.0, 0.0, 0.0, v[3])) for t, a, b, v in wheels(DRIVE)]
    assert said(load(tmp_path, [*lasers(DRIVE, LIDAR), *frozen, *MOUNT]), "never moves") == 1


@pytest.mark.parametrize("shift", [0.3, -0.3, 40.0, 86400.0])
def test_clocks_that_disagree_are_said_and_corrected(tmp_path: Path, shift: float) -> None:
    entries = [*lasers(DRIVE, LIDAR, shift=shift), *wheels(DRIVE), *MOUNT]
    log = load(tmp_path, entries, clock_offset="auto")
    assert said(log, "clock offset corrected") == 1
    # Scans are 0.1 s apart; a tenth of that, and the 0.6 m that the robot drives meanwhile.
    np.testing.assert_allclose(log.stamps[5:9], strangers.scan_stamps(DRIVE)[5:9], atol=0.05)
    if abs(shift) > 1:
        with pytest.raises(UserError, match=r"s apart, not corrected; give --clock-offset -?\d+\.\d\d, or auto"):
            load_log(tmp_path / "made")
    else:
        assert said(load_log(tmp_path / "made"), "not corrected") == 1
    by_hand = load_log(tmp_path / "made", LogOptions(clock_offset=str(-shift)))
    np.testing.assert_allclose(by_hand.stamps[:9], strangers.scan_stamps(DRIVE)[:9], atol=1e-6)
    assert not any("clock" in line for line in by_hand.report.lines())


def test_clocks_that_agree_get_no_word(tmp_path: Path) -> None:
    log = load(tmp_path, [*lasers(DRIVE, LIDAR), *wheels(DRIVE), *MOUNT])
    assert log.report.lines() == []
    asked = load_log(tmp_path / "made", LogOptions(clock_offset="auto"))
    assert said(asked, "none found") == 1
    np.testing.assert_array_equal(asked.stamps, log.stamps)


def test_scans_taken_while_turning_are_straightened(tmp_path: Path) -> None:
    stamps_as_taken = [*lasers(SPINNING, LIDAR, beam_time=0.1 / 180), *wheels(SPINNING), *MOUNT]
    log = load(tmp_path, stamps_as_taken)
    bent = load_log(tmp_path / "made", LogOptions(deskew=False))
    assert off(log, SPINNING, 0.85) < 0.03 < 0.05 < off(bent, SPINNING)
    quiet = [(t, a, b, (*v[:4], 0.0)) for t, a, b, v in stamps_as_taken if b == "laser"]
    by_hand = load(tmp_path / "quiet", [*quiet, *wheels(SPINNING), *MOUNT], scan_time=0.1 * 179 / 180)
    np.testing.assert_allclose(by_hand.ranges, log.ranges, atol=1e-4)


def test_a_time_increment_that_cannot_be_is_not_used(tmp_path: Path) -> None:
    wrong = [(t, a, b, (*v[:4], 1.0)) for t, a, b, v in lasers(DRIVE, LIDAR)]
    log = load(tmp_path, [*wrong, *wheels(DRIVE), *MOUNT])
    assert said(log, "time_increment is too long") == SCANS and off(log) < 0.02


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


def test_masks_and_least_ranges(tmp_path: Path) -> None:
    entries = [*lasers(DRIVE, LIDAR), *wheels(DRIVE), *MOUNT]
    log = load(tmp_path, entries, laser_mask=("170deg:-170deg", "0.0:0.1"), laser_min_range=1.0)
    bearings = np.degrees(log.lidar.angle_min + log.lidar.angle_increment * np.arange(180))
    hidden = np.isnan(log.ranges).all(axis=0)
    np.testing.assert_array_equal(hidden, (np.abs(bearings) >= 170 - 1e-4) | ((bearings > -1e-4) & (bearings < 5.73)))
    assert said(log, "beams of 180 masked") == hidden.sum() and log.lidar.range_min == 1.0
    assert np.isneginf(log.ranges).any() and log.ranges[np.isfinite(log.ranges)].min() >= 1.0
    with pytest.raises(UserError, match="covers every beam"):
        load_log(tmp_path / "made", LogOptions(laser_mask=("-180deg:180deg",)))


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
    told = strangers.START + np.arange(0, 20, 2.0)
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


def test_the_first_of_several_echoes(tmp_path: Path) -> None:
    echoes = [
        (t, a, "echoes", ([[r, r + 1] if r < 6 else [] for r in v[0]], *v[1:4])) for t, a, _, v in lasers(DRIVE, LIDAR)
    ]
    log = load(tmp_path, [*echoes, *wheels(DRIVE), *MOUNT])
    assert said(log, "several echoes") == SCANS and off(log, least=0.7) < 0.02 and np.isnan(log.ranges).any()


def test_point_clouds_alone_are_told_how_to_convert(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"pointcloud_to_laserscan.* cloud_in:=/points") as error:
        load(tmp_path, [*wheels(DRIVE), (1000.0, "/points", "cloud", ())])
    assert "\n" not in str(error.value)


def test_a_log_without_odometry_says_what_to_do(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"holds no odometry.*above laser.*record /odom or /tf"):
        load(tmp_path, [*lasers(DRIVE, LIDAR), *MOUNT])


@pytest.mark.parametrize(
    ("code", "told"), [(10.0, 10.0), (11.0, 10.0), (3.4028235e38, 10.0), (3.4e38, 3.4028235e38), (8.19, 30.0)]
)
def test_what_stands_for_no_return_is_found(tmp_path: Path, code: float, told: float) -> None:
    reach = min(8.0, code)
    entries = [
        (t, a, b, (np.where(v[0] < reach, v[0], code), *v[1:], None, told)) for t, a, b, v in lasers(DRIVE, LIDAR)
    ]
    log = load(tmp_path, [*entries, *wheels(DRIVE), *MOUNT])
    gone = np.stack([v[0] >= reach for _, _, _, v in lasers(DRIVE, LIDAR)])
    assert gone.mean() > 0.005
    np.testing.assert_array_equal(np.isposinf(log.ranges), gone)


def test_zeros_beside_long_readings_are_no_returns_and_others_errors(tmp_path: Path) -> None:
    scans, rng = lasers(DRIVE, LIDAR), np.random.default_rng(0)
    far = [(t, a, b, (np.where(v[0] < 6, v[0], 0.0), *v[1:])) for t, a, b, v in scans]
    log = load(tmp_path / "far", [*far, *wheels(DRIVE), *MOUNT])
    gone = np.stack([v[0] >= 6 for _, _, _, v in scans])
    np.testing.assert_array_equal(np.isposinf(log.ranges), gone)
    assert said(log, "readings of 0 m") == gone.sum()
    known = [(t, a, b, (np.where(np.isfinite(v[0]), v[0], np.nan), *v[1:])) for t, a, b, v in scans]
    lost = [(t, a, b, (np.where(rng.random(180) < 0.1, 0.0, v[0]), *v[1:])) for t, a, b, v in known]
    errors = load(tmp_path / "lost", [*lost, *wheels(DRIVE), *MOUNT])
    assert not np.isposinf(errors.ranges).any() and 0.05 < np.isnan(errors.ranges).mean() < 0.15


def test_scans_without_stamps_take_the_time_of_recording(tmp_path: Path) -> None:
    entries = [*lasers(DRIVE, LIDAR), *wheels(DRIVE), *MOUNT]
    path = write_bag(tmp_path, "db3", entries, unstamped="/scan")
    log = load_log(path)
    assert said(log, "the time of recording is taken") == SCANS
    np.testing.assert_allclose(log.stamps, strangers.scan_stamps(DRIVE), atol=1e-6)


def test_odometry_of_any_source_makes_a_log(tmp_path: Path) -> None:
    """What scan odometry will use: scans and rows are assembled without a bag."""
    from dsom_jax.data.assemble import Sensor, assemble
    from dsom_jax.data.log import Report
    from dsom_jax.data.log_options import AS_TOLD
    from dsom_jax.data.scans import table

    stamps, rows = strangers.scan_stamps(DRIVE), LIDAR.scans(DRIVE, strangers.scan_stamps(DRIVE))
    same = {"start": rows[0][2], "end": rows[0][2] + 179 * rows[0][3], "step": rows[0][3], "beam_time": 0.0}
    scans = table([r[0] for r in rows], stamps=stamps, **{k: np.full(len(stamps), v) for k, v in same.items()})
    known = np.column_stack([stamps, DRIVE.at(stamps)])
    log = assemble(scans, known, Sensor(0.1, 10.0, mount=LIDAR.mount), AS_TOLD, Report(), tmp_path)
    np.testing.assert_allclose(log.odometry[:, :2], known[:, 1:3], atol=1e-9)
    assert off(replace(log, path=tmp_path)) < 0.02
