"""CARMEN logs written by hand: every form of message, the guess at the lidar, no-return values, garbage."""

from __future__ import annotations

import gzip
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dsom_jax.data import se2, thin
from dsom_jax.data.carmen import load_carmen
from dsom_jax.data.range_codes import detect_no_return
from dsom_jax.errors import UserError


def flaser(ranges, laser=(0, 0, 0), odom=(0, 0, 0), stamp=1.0, tail="host {t}") -> str:
    numbers = " ".join(str(v) for v in (*ranges, *laser, *odom, stamp))
    return f"FLASER {len(ranges)} {numbers} {tail.format(t=stamp)}".rstrip()


def robotlaser(ranges, laser, odom, stamp, config="0 -1.0 2.0 0.5 50.0 0.01 0", kind="ROBOTLASER1") -> str:
    readings, remissions = " ".join(map(str, ranges)), "2 100 200"
    poses = " ".join(map(str, (*laser, *odom)))
    return f"{kind} {config} {len(ranges)} {readings} {remissions} {poses} 0.1 0.2 0.3 0.4 1e6 {stamp} host 0.5"


def write(folder: Path, lines: list[str], name: str = "a.log") -> Path:
    path = folder / name
    text = "\n".join(lines) + "\n"
    path.write_bytes(gzip.compress(text.encode()) if name.endswith("gz") else text.encode())
    return path


RANGES = [1.0, 2.0, 3.0, 4.0, 5.0]


@pytest.mark.parametrize("name", ["a.log", "a.clf", "a.log.gz", "a.clf.gz"])
def test_flaser(tmp_path: Path, name: str) -> None:
    lines = [
        "# message_name [message contents] ipc_timestamp ipc_hostname logger_timestamp",
        "PARAM robot_front_laser_max 4.5",
        "SYNC start",
        "ODOM 9 9 9 0 0 0 0.5 host 0.5",
        flaser(RANGES, odom=(1, 2, 0.3), laser=(1, 2, 0.3), stamp=976052857.25, tail="nohost 0.32"),
        "RLASER 5 9 9 9 9 9 0 0 0 0 0 0 1.5 host 1.5",
        flaser(RANGES, odom=(1.5, 2, 0.3), laser=(1.5, 2, 0.3), stamp=976052858.5, tail=""),
    ]
    log = load_carmen(write(tmp_path, lines, name))
    np.testing.assert_array_equal(log.ranges, [[1, 2, 3, 4, np.inf]] * 2)
    np.testing.assert_array_equal(log.odometry, [[1, 2, 0.3], [1.5, 2, 0.3]])
    np.testing.assert_array_equal(log.stamps, [976052857.25, 976052858.5])
    assert log.reference is None and log.lidar.range_max == 4.5 and log.lidar.mount == (0, 0, 0)
    assert log.report.counts == {"SYNC messages not used": 1, "RLASER messages not used": 1}


# CARMEN's carmen_laser_guess_angle_increment; the first beam is always at -90 deg.
@pytest.mark.parametrize(
    ("beams", "degrees"),
    [(180, 1.0), (181, 1.0), (360, 0.5), (361, 0.5), (400, 0.25), (401, 0.25), (91, 2.0), (1, 180.0)],
)
def test_angles_that_flaser_does_not_tell(tmp_path: Path, beams: int, degrees: float) -> None:
    lidar = load_carmen(write(tmp_path, [flaser([1.0] * beams)])).lidar
    assert (lidar.beams, lidar.angle_min) == (beams, -np.pi / 2)
    assert lidar.angle_increment == pytest.approx(np.radians(degrees))


def test_robotlaser_tells_its_geometry_and_mount(tmp_path: Path) -> None:
    mount = np.array([0.3, 0.1, 0.2])
    odometry = np.array([[0, 0, 3.0], [1, 0, -3.1], [2, 1, 1.0]])
    laser = se2.compose(odometry, mount)
    log = load_carmen(
        write(tmp_path, [robotlaser(RANGES, p, o, n) for n, (p, o) in enumerate(zip(laser, odometry, strict=True))])
    )
    assert (log.lidar.beams, log.lidar.angle_min, log.lidar.angle_increment) == (5, -1.0, 0.5)
    assert log.lidar.range_max == 50.0 and log.reference is None
    np.testing.assert_allclose(log.lidar.mount, mount, atol=1e-12)
    np.testing.assert_array_equal(log.odometry, odometry)
    np.testing.assert_array_equal(log.stamps, [0, 1, 2])


def test_corrected_poses_become_the_reference_and_never_the_odometry(tmp_path: Path) -> None:
    odometry = np.array([[0, 0, 0], [1, 0, 0.1], [2, 0.5, 0.2]])
    corrected = np.array([[5, 5, 1.0], [5.5, 6, 1.2], [6, 7, 1.0]])
    lines = ["PARAM robot_frontlaser_offset 0.2"]
    lines += [flaser(RANGES, p, o, n) for n, (p, o) in enumerate(zip(corrected, odometry, strict=True))]
    log = load_carmen(write(tmp_path, lines))
    np.testing.assert_array_equal(log.odometry, odometry)
    # The log gives the pose of the laser, which sits 0.2 m in front of the base.
    assert log.lidar.mount == (0.2, 0, 0)
    np.testing.assert_allclose(se2.compose(log.reference, np.array([0.2, 0, 0])), corrected, atol=1e-12)


@pytest.mark.parametrize("kind", ["RAWLASER1", "LASER"])
def test_scans_without_pose_take_it_from_odom_lines(tmp_path: Path, kind: str) -> None:
    config = "0 -1.0 2.0 0.5 50.0 0.01 0 " if kind == "RAWLASER1" else ""
    remissions = " 0" if kind == "RAWLASER1" else ""
    scan = f"{kind} {config}5 1 2 3 4 5{remissions} {{0}} host {{0}}"
    odom = [f"ODOM {x} 0 {theta} 0 0 0 {t} host {t}" for t, x, theta in ((10, 0, 3.1), (11, 1, -3.1), (15, 1, -3.1))]
    lines = [odom[0], scan.format(10.25), odom[1], scan.format(12), odom[2], scan.format(20)]
    log = load_carmen(write(tmp_path, lines))
    # The scan in the gap of 4 s and the one 5 s after the end have no odometry.
    assert len(log) == 1 and log.report.counts["scans without odometry near their stamp"] == 2
    np.testing.assert_allclose(log.odometry[0], [0.25, 0, 3.1 + (2 * np.pi - 6.2) / 4], atol=1e-12)


def test_raw_scans_beside_scans_with_pose_are_left_out(tmp_path: Path) -> None:
    lines = ["RAWLASER1 0 -1 2 0.5 50 0.01 0 5 1 2 3 4 5 0 1.0 host 1.0", flaser(RANGES), "ODOM 0 0 0 0 0 0 1 host 1"]
    log = load_carmen(write(tmp_path, lines))
    assert len(log) == 1 and log.report.counts == {"RAWLASER1 messages not used": 1}


GARBAGE = [
    "FLASER 5 1 2 3",
    "FLASER five 1 2 3 4 5 0 0 0 0 0 0 1 host 1",
    "FLASER 4 1 2 3 4 5 0 0 0 0 0 0 1 host 1",
    "FLASER 6 1 2 3 4 5 0 0 0 0 0 0 1 host 1",
    "FLASER 5 1 2 3 4 5 0 0 nan 0 0 0 1 host 1",
    "FLASER 0 0 0 0 0 0 0 1 host 1",
    "FLASER",
    "ODOM 1 2",
    "PARAM alone",
    "<<<<<<< HEAD",
    "\x00\x01 binary",
]


def test_garbage_is_counted_not_fatal(tmp_path: Path) -> None:
    log = load_carmen(write(tmp_path, [flaser(RANGES, stamp=1), *GARBAGE, "", "   ", flaser(RANGES, stamp=2)]))
    np.testing.assert_array_equal(log.stamps, [1, 2])
    assert log.report.counts["unreadable lines skipped"] == len(GARBAGE)
    assert log.report.lines()[0].startswith("11 unreadable lines skipped (first: line 2: 'FLASER 5 1 2 3'; line 3:")


@given(noise=st.lists(st.text(max_size=60), max_size=8))
@settings(max_examples=60, deadline=None)
def test_no_text_whatever_is_fatal(tmp_path_factory, noise: list[str]) -> None:
    path = tmp_path_factory.mktemp("log") / "a.log"
    path.write_bytes("\n".join([*noise, flaser(RANGES), *noise]).encode(errors="replace"))
    assert len(load_carmen(path)) == 1


def test_the_other_lidar_is_dropped_and_reported(tmp_path: Path) -> None:
    lines = [flaser(RANGES, stamp=1), flaser([1.0] * 7, stamp=2), flaser(RANGES, stamp=3)]
    log = load_carmen(write(tmp_path, lines))
    np.testing.assert_array_equal(log.stamps, [1, 3])
    assert log.report.counts["scans of 7 beams dropped, the log's lidar has 5"] == 1


def wall(bearings: np.ndarray) -> list[float]:
    """Metres of a round wall by bearing; it changes by at most 1 m a radian."""
    return np.round(3 + np.sin(bearings), 4).tolist()


def test_scans_whose_number_of_beams_varies(tmp_path: Path) -> None:
    """FLASER spans -90 to 90 deg: a beam is the nearest one of its scan, at most three quarters of one off."""
    counts = np.random.default_rng(0).integers(165, 180, 60)
    lines = [flaser(wall(np.linspace(-np.pi / 2, np.pi / 2, n)), odom=(0.1 * t, 0, 0), laser=(0.1 * t, 0, 0.1), stamp=t)
             for t, n in enumerate(counts, 1)]  # fmt: skip
    log = load_carmen(write(tmp_path, lines))
    assert len(log) == 60 and list(log.report.counts.values()) == [int((counts != log.lidar.beams).sum())]
    step = log.lidar.angle_increment
    bearings = log.lidar.angle_min + step * np.arange(log.lidar.beams)
    # A beam of the scan with the fewest is a tenth wider.
    np.testing.assert_allclose(log.ranges, np.tile(wall(bearings), (60, 1)), atol=0.75 * 1.1 * step + 1e-4)


def test_scans_whose_angles_vary(tmp_path: Path) -> None:
    """Two thirds begin at -1.0 rad, one third two beams later; what begins elsewhere altogether is another lidar."""
    starts = [-1.0, -1.0, -0.9] * 4 + [2.0]
    lines = [robotlaser(wall(a + 0.05 * np.arange(40)), (0, 0, 0), (t, 0, 0), t, f"0 {a} 2.0 0.05 50.0 0.01 0")
             for t, a in enumerate(starts, 1)]  # fmt: skip
    log = load_carmen(write(tmp_path, lines))
    assert len(log) == 12 and log.report.counts["scans of other angles than most dropped"] == 1
    assert (log.lidar.beams, log.lidar.angle_min, log.lidar.angle_increment) == (40, -1.0, 0.05)
    late = np.array(starts[:12]) > -1.0
    np.testing.assert_allclose(log.ranges[~late], np.tile(wall(log.lidar.angles()), (8, 1)), atol=1e-4)
    assert np.isnan(log.ranges[late][:, :2]).all()
    np.testing.assert_allclose(log.ranges[late][:, 2:], np.tile(wall(log.lidar.angles()[2:]), (4, 1)), atol=1e-4)


def test_odd_stamps_are_reported(tmp_path: Path) -> None:
    other = [2.0, 2.0, 3.0, 4.0, 5.0]
    lines = [flaser(RANGES, stamp=5), flaser(RANGES, stamp=5), flaser(other, stamp=5), flaser(RANGES, stamp=4)]
    log = load_carmen(write(tmp_path, lines))
    # Word for word the same message goes, different scans of one stamp stay, in the order of the log.
    np.testing.assert_array_equal(log.stamps, [5, 5, 4])
    assert log.report.counts == {
        "repeated messages dropped": 1,
        "scans share the stamp of the scan before": 1,
        "stamps run backwards": 1,
    }


def scans_with_code(code: list[float], top: float = 25.0, n: int = 4000) -> np.ndarray:
    """Readings up to ``top`` metres with no-return values mixed in."""
    readings = np.round(np.random.default_rng(0).uniform(0.5, top, n), 2)
    readings[: len(code)] = code
    return readings.reshape(-1, 40)


@pytest.mark.parametrize(
    ("code", "expected"),
    [
        ([81.83] * 60, 81.825),
        ([81.91] * 60 + [81.83] * 2, 81.825),
        # A code that flickers, as in the log of Edmonton.
        ([51.16] * 5 + [51.15] * 70 + [51.14] * 10 + [51.1] * 4 + [51.09], 51.085),
        # Three far walls are not a code, nor are many different distances.
        ([81.83] * 3, None),
        (list(np.round(np.linspace(24.9, 25.0, 60), 2)), None),
        ([], None),
    ],
)
def test_no_return_values_are_detected(code: list[float], expected: float | None) -> None:
    found = detect_no_return(scans_with_code(code))
    assert found is None if expected is None else found == pytest.approx(expected)


def test_sources_of_the_limit_in_order(tmp_path: Path) -> None:
    scans = scans_with_code([81.83] * 60)
    lines = [flaser(scan, stamp=n) for n, scan in enumerate(scans)]
    path = write(tmp_path, lines)
    assert load_carmen(path).lidar.range_max == pytest.approx(81.825)
    # A limit that the readings do not respect is the log's mistake, a lower one is believed, a higher one is not.
    for stated, expected in (("0.4", 81.825), ("20", 20.0), ("90", 81.825)):
        write(tmp_path, [f"PARAM robot_front_laser_max {stated}", *lines])
        assert load_carmen(path).lidar.range_max == pytest.approx(expected)
    (tmp_path / "meta.yaml").write_text("beams: 40\nangle_min: -0.5\nangle_increment: 0.02\nrange_no_return: 24.0\n")
    described = load_carmen(path)
    assert (described.lidar.range_max, described.lidar.angle_min, described.lidar.angle_increment) == (24.0, -0.5, 0.02)
    np.testing.assert_array_equal(np.isposinf(described.ranges), scans >= 24.0)
    assert load_carmen(path, range_max=10.0).lidar.range_max == 10.0


def test_without_a_code_every_reading_is_a_wall(tmp_path: Path) -> None:
    log = load_carmen(write(tmp_path, [flaser([3.0, 4.0]), flaser([5.0, 6.0], stamp=2)]))
    assert np.isfinite(log.ranges).all() and log.lidar.range_max > 6.0


def test_zeros_and_nonsense_are_invalid(tmp_path: Path) -> None:
    log = load_carmen(write(tmp_path, [flaser([0.0, -1.0, "nan", "inf", 2.0])]))
    np.testing.assert_array_equal(log.ranges, [[np.nan, np.nan, np.nan, np.inf, 2.0]])


def test_meta_mount(tmp_path: Path) -> None:
    (tmp_path / "meta.yaml").write_text("mount: [0.1, 0, 3.14]\nupside_down: true\n")
    lidar = load_carmen(write(tmp_path, [flaser(RANGES)])).lidar
    assert lidar.mount == (0.1, 0, 3.14) and lidar.upside_down


@pytest.mark.parametrize(
    ("meta", "message"),
    [
        ("beams: 180\n", "meta.yaml: beams = 180, .* have 5: wrong lidar"),
        ("angle_min: left\n", "meta.yaml: angle_min = 'left': must be a number"),
        ("range_no_return: x\n", "range_no_return = 'x': must be a number"),
        ("mount: [1, 2]\n", r"mount = \[1, 2\]: must be \[x, y, yaw\]"),
        ("angle_increment: 30.0\n", "more than a turn"),
        ("- 1\n", "holds no fields"),
    ],
)
def test_bad_meta(tmp_path: Path, meta: str, message: str) -> None:
    (tmp_path / "meta.yaml").write_text(meta)
    with pytest.raises(UserError, match=message):
        load_carmen(write(tmp_path, [flaser(RANGES)]))


def test_bad_logs(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="no such log"):
        load_carmen(tmp_path / "no.log")
    with pytest.raises(UserError, match=r"holds no FLASER.*2 unreadable lines"):
        load_carmen(write(tmp_path, ["hello", "world"]))
    with pytest.raises(UserError, match="holds no FLASER"):
        load_carmen(write(tmp_path, [], "empty.log"))
    with pytest.raises(UserError, match="nor ODOM lines"):
        load_carmen(write(tmp_path, ["LASER 5 1 2 3 4 5 1.0 host 1.0"]))
    broken = tmp_path / "broken.log.gz"
    broken.write_bytes(gzip.compress(b"FLASER" * 1000)[:20])
    with pytest.raises(UserError, match="broken gzip"):
        load_carmen(broken)


@pytest.mark.parametrize("kind", ["FLASER", "ODOM"])
def test_the_update_after_a_reset_of_the_odometry_is_marked(tmp_path: Path, kind: str) -> None:
    """A robot creeps, and its odometry begins anew at scan 25: that scan is an update, however little it moved."""
    poses = [(0.01 * n + (100.0 if n < 25 else 0.0), 0.0, 0.0) for n in range(50)]
    lines = []
    for n, pose in enumerate(poses):
        if kind == "FLASER":
            lines.append(flaser([1.0 + 0.01 * n, 2.0, 3.0, 4.0, 5.0], laser=pose, odom=pose, stamp=0.1 * n))
        else:
            lines += [f"ODOM {pose[0]} 0 0 0 0 0 {0.1 * n} host 0", f"LASER 3 1 2 {1 + 0.01 * n} {0.1 * n} host 0"]
    log = load_carmen(write(tmp_path, lines))
    np.testing.assert_array_equal(np.flatnonzero(log.broken), [25])
    assert np.abs(np.diff(log.odometry[:, 0])).max() < 0.02 and 25 in thin(log)
