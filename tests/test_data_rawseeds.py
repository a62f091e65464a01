"""Sessions of Rawseeds, written here line by line as their descriptions say."""

from __future__ import annotations

import bz2
import gzip
import math

import numpy as np
import pytest

from dsom_jax.data import LogOptions, load_log, load_rawseeds, save_tum, se2, thin
from dsom_jax.errors import UserError

SESSION, START, BEAMS, SCANS = "Bicocca_2009-02-25b", 1235603336.3, 181, 12
PERIOD = 0.1


def path_of(scans: int = SCANS) -> np.ndarray:
    """(N, 3) a bend to the left."""
    poses = [np.zeros(3)]
    for _ in range(scans - 1):
        poses.append(se2.compose(poses[-1], np.array([0.3, 0.0, 0.1])))
    return np.stack(poses)


def scan_lines(ranges, offset: float = 0.0) -> list[str]:
    lines = []
    for n, scan in enumerate(ranges):
        padded = [*scan, *[0.0] * (BEAMS - len(scan))]
        lines.append(f"{START + PERIOD * n:.6f}, {len(scan)}, {offset:g}, " + ", ".join(f"{r:.3f}" for r in padded))
    return lines


def odometry_lines(poses) -> list[str]:
    return [
        f"{START + PERIOD * n:.6f}, {4100 + n}, {240 * n}, {250 * n}, {x:.6f}, {y:.6f}, {theta:.6f}"
        for n, (x, y, theta) in enumerate(poses)
    ]


def truth_lines(poses, step: int = 1, covariance: bool = True) -> list[str]:
    rest = "," + ",".join(["0.000011"] * 9) if covariance else ""
    return [f"{START + PERIOD * n:.6f},{x:.6f},{y:.6f},{theta:.6f}{rest}" for n, (x, y, theta) in enumerate(poses)][
        ::step
    ]


def ranges_of(count: int = BEAMS) -> np.ndarray:
    """(N, B) metres with two decimals, no two scans alike, and a few beams without return."""
    ranges = 2.0 + (np.arange(SCANS)[:, None] * 0.01 + np.arange(count) * 0.02).round(2)
    ranges[:, 4:6] = 81.91
    return ranges


def write(folder, kind: str, lines: list[str], session: str = SESSION):
    path = folder / f"{session}-{kind}.csv"
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.fixture
def folder(tmp_path):
    write(tmp_path, "SICK_FRONT", scan_lines(ranges_of()))
    write(tmp_path, "SICK_REAR", scan_lines(ranges_of() + 1))
    write(tmp_path, "ODOMETRY_XYT", odometry_lines(path_of()))
    return tmp_path


def test_a_session_by_its_folder_or_its_file(folder):
    log = load_log(folder)
    same = load_log(folder / f"{SESSION}-SICK_FRONT.csv")
    assert len(log) == len(same) == SCANS and log.path == same.path
    np.testing.assert_allclose(log.stamps, START + PERIOD * np.arange(SCANS), atol=1e-6)
    np.testing.assert_allclose(log.odometry, path_of(), atol=2e-6)
    expected = ranges_of().astype(np.float32)
    expected[:, 4:6] = np.inf
    np.testing.assert_array_equal(log.ranges, expected)
    assert log.reference is None and "without ground truth" in " ".join(log.report.lines())


def test_the_lidar_is_that_of_the_description(folder):
    lidar = load_rawseeds(folder).lidar
    assert lidar.beams == 181 and lidar.mount == (0.08, 0.0, 0.0) and not lidar.upside_down
    np.testing.assert_allclose(np.degrees(lidar.angles()), np.arange(-90, 91), atol=1e-4)
    assert 81.0 < lidar.range_max < 81.91
    assert load_rawseeds(folder, range_max=30.0).lidar.range_max == 30.0


def test_the_rear_laser_looks_back(folder):
    log = load_log(folder / f"{SESSION}-SICK_REAR.csv")
    assert log.lidar.mount == (-0.463, 0.001, math.pi)
    assert log.ranges[0, 0] == np.float32(3.0)


def test_the_mount_is_an_option_and_meta_yaml_has_the_next_word(folder):
    options = LogOptions(mount="0.2,0.1,0.05")
    assert load_rawseeds(folder, options).lidar.mount == (0.2, 0.1, 0.05)
    (folder / "meta.yaml").write_text("mount: [0.1, 0.0, 0.5]\nangle_min: -1.5\nrange_no_return: 30.0\n")
    lidar = load_rawseeds(folder).lidar
    assert (lidar.mount, lidar.angle_min, lidar.range_max) == ((0.1, 0.0, 0.5), -1.5, 30.0)
    assert load_rawseeds(folder, options).lidar.mount == (0.2, 0.1, 0.05)


def test_the_angular_offset_turns_the_scan_and_the_odd_one_is_dropped(folder):
    lines = scan_lines(ranges_of(), offset=2)
    lines[3] = scan_lines(ranges_of(), offset=1)[3]
    write(folder, "SICK_FRONT", lines)
    log = load_rawseeds(folder)
    assert len(log) == SCANS - 1 and "1 scans with another angular offset dropped" in log.report.lines()
    np.testing.assert_allclose(math.degrees(log.lidar.angle_min), -89.5, atol=1e-6)
    # So it is if the odd one comes first, or has the larger number.
    write(folder, "SICK_FRONT", [scan_lines(ranges_of(), offset=3)[0], *scan_lines(ranges_of(), offset=2)[1:]])
    np.testing.assert_allclose(math.degrees(load_rawseeds(folder).lidar.angle_min), -89.5, atol=1e-6)


def test_scans_padded_with_zeros_have_as_many_beams_as_they_say(folder):
    write(folder, "SICK_FRONT", scan_lines(ranges_of(180)))
    log = load_rawseeds(folder)
    assert log.lidar.beams == 180 and log.ranges.shape == (SCANS, 180)
    np.testing.assert_allclose(math.degrees(log.lidar.angle_increment), 1.0)


def test_odometry_is_that_of_the_stamp(folder):
    """The odometry runs at its own rate: what it says is interpolated."""
    late = [line for n, line in enumerate(odometry_lines(path_of(2 * SCANS))) if n % 3 != 1]
    write(folder, "ODOMETRY_XYT", late)
    log = load_rawseeds(folder)
    # Chords of at most 0.6 m of a bend of 3 m radius: off by 0.6^2 / (8 * 3) m.
    np.testing.assert_allclose(log.odometry, path_of(), atol=0.0151)
    # Whatever the order of its lines.
    write(folder, "ODOMETRY_XYT", late[::-1])
    np.testing.assert_array_equal(load_rawseeds(folder).odometry, log.odometry)


def test_y_forward_is_noticed_and_turned(folder):
    """The same drive as it looks if the robot's y axis points forward."""
    poses = path_of()
    turned = np.column_stack([poses[:, :2], poses[:, 2] - math.pi / 2])
    write(folder, "ODOMETRY_XYT", odometry_lines(turned))
    log = load_rawseeds(folder)
    np.testing.assert_allclose(se2.wrap(log.odometry - poses), 0.0, atol=2e-6)
    assert any("quarter turn" in line for line in log.report.lines())


def test_driving_backwards_is_left_alone_and_reported(folder):
    poses = path_of()
    write(folder, "ODOMETRY_XYT", odometry_lines(np.column_stack([poses[:, :2], poses[:, 2] + math.pi])))
    log = load_rawseeds(folder)
    np.testing.assert_allclose(log.odometry[:, :2], poses[:, :2], atol=2e-6)
    assert any("deg off the way driven" in line for line in log.report.lines())


def test_an_x_axis_to_the_left_is_not_mended(folder):
    """Only y forward is known of; what drives to its own right is a fault that nobody has described."""
    turned = np.column_stack([path_of()[:, :2], path_of()[:, 2] + math.pi / 2])
    write(folder, "ODOMETRY_XYT", odometry_lines(turned))
    log = load_rawseeds(folder)
    np.testing.assert_allclose(se2.wrap(log.odometry - turned), 0.0, atol=2e-6)
    assert any("deg off the way driven" in line for line in log.report.lines())


def test_ground_truth_is_the_reference_and_the_extended_one_comes_first(folder):
    truth = se2.compose(np.array([5.0, -3.0, 1.0]), path_of())
    write(folder, "GROUNDTRUTH", truth_lines(truth)[4:8])
    log = load_rawseeds(folder)
    np.testing.assert_allclose(log.reference[4:8], truth[4:8], atol=2e-6)
    assert np.isnan(log.reference[[0, 1, 2, 3, 8, 9, 10, 11]]).all()
    assert "8 scans without a pose in Bicocca_2009-02-25b-GROUNDTRUTH.csv" in log.report.lines()
    write(folder, "GT-extended", truth_lines(truth, step=5, covariance=False))
    extended = load_rawseeds(folder).reference
    # A pose every half second, in between chords of 1.5 m of a bend of 3 m radius: off by 1.5^2 / (8 * 3) m.
    np.testing.assert_allclose(extended[:11], truth[:11], atol=0.095)
    np.testing.assert_allclose(extended[[0, 5, 10]], truth[[0, 5, 10]], atol=2e-6)


def test_long_gaps_of_the_ground_truth_are_not_bridged(folder):
    first, *rest = truth_lines(path_of(), step=4)
    late = [f"{float(line.split(',')[0]) + 3:.6f},{line.split(',', 1)[1]}" for line in rest]
    write(folder, "GT-extended", [first, *late])
    reference = load_rawseeds(folder).reference
    assert np.isfinite(reference[0]).all() and np.isnan(reference[1:]).all()


def test_another_reference_may_be_given(folder):
    write(folder, "GROUNDTRUTH", truth_lines(path_of()))
    moved = se2.compose(np.array([1.0, 0.0, 0.0]), path_of())
    save_tum(folder / "better.tum", START + PERIOD * np.arange(SCANS), moved)
    log = load_log(folder, reference=folder / "better.tum")
    np.testing.assert_allclose(log.reference, moved, atol=2e-6)


@pytest.mark.parametrize("pack", [gzip.compress, bz2.compress])
def test_packed_files(folder, pack):
    suffix = {gzip.compress: ".gz", bz2.compress: ".bz2"}[pack]
    expected = load_rawseeds(folder)
    for file in list(folder.glob("*.csv")):
        (folder / (file.name + suffix)).write_bytes(pack(file.read_bytes()))
        file.unlink()
    for place in (folder, folder / f"{SESSION}-SICK_FRONT.csv{suffix}"):
        log = load_log(place)
        np.testing.assert_array_equal(log.ranges, expected.ranges)
        np.testing.assert_array_equal(log.odometry, expected.odometry)


def test_garbage_lines_are_counted_and_the_rest_is_read(folder):
    lines = scan_lines(ranges_of())
    lines[2] = "to be or not to be"
    lines[5] = lines[5][:200]  # cut while it was written
    lines[6] = lines[6].replace(", 181,", ", 90,")  # says 90 ranges and has 181
    lines[7] = lines[7].replace(", 181,", ", -1,")
    lines[8] = lines[8].replace(", 181,", ", 180,")  # the last of the 181 is no zero
    write(folder, "SICK_FRONT", ["# a comment", "", *lines])
    odometry = odometry_lines(path_of())
    odometry[9:9] = ["1,2,3", "nan, 1, 2, 3, 4, 5, 6", "???"]
    write(folder, "ODOMETRY_XYT", odometry)
    log = load_rawseeds(folder)
    kept = [0, 1, 3, 4, 9, 10, 11]
    assert len(log) == len(kept)
    np.testing.assert_allclose(log.odometry, path_of()[kept], atol=2e-6)
    assert log.report.counts[f"unreadable lines of {SESSION}-SICK_FRONT.csv skipped"] == 5
    assert log.report.counts[f"unreadable lines of {SESSION}-ODOMETRY_XYT.csv skipped"] == 3
    assert "line 5: 'to be or not to be'" in " ".join(log.report.lines())


def no_odometry(folder):
    (folder / f"{SESSION}-ODOMETRY_XYT.csv").unlink()


def two_sessions(folder):
    write(folder, "SICK_FRONT", scan_lines(ranges_of()), session="Bicocca_2009-02-26a")


def broken_archive(folder):
    (folder / f"{SESSION}-SICK_FRONT.csv").write_bytes(b"BZh9 not really")


def no_scan(folder):
    for laser in ("FRONT", "REAR"):
        (folder / f"{SESSION}-SICK_{laser}.csv").unlink()


SPOILT = {
    "no odometry": (no_odometry, "", ["SICK_FRONT.csv", f"{SESSION}-ODOMETRY_XYT.csv", "one folder"]),
    "two sessions": (two_sessions, "", ["several sessions", "2009-02-25b, ", "2009-02-26a"]),
    "no such file": (lambda d: None, f"{SESSION}-SICK_LEFT.csv", ["SICK_LEFT.csv", "SICK_FRONT.csv"]),
    "other file": (lambda d: None, f"{SESSION}-ODOMETRY_XYT.csv", ["ODOMETRY_XYT.csv", "SICK_FRONT.csv"]),
    "missing": (lambda d: None, "Bovisa-SICK_FRONT.csv", ["Bovisa-SICK_FRONT.csv", "no such"]),
    "no scan file": (no_scan, "", ["SICK_FRONT.csv", "metadata.yaml"]),
    "archive": (broken_archive, "", ["SICK_FRONT.csv", "broken bzip2"]),
    "words": (lambda d: write(d, "SICK_FRONT", ["to be"]), "", ["SICK_FRONT.csv", "no scan", "line 1: 'to be'"]),
    "empty": (lambda d: write(d, "SICK_FRONT", []), "", ["SICK_FRONT.csv", "no scan"]),
    "empty odometry": (lambda d: write(d, "ODOMETRY_XYT", []), "", ["ODOMETRY_XYT.csv", "no trajectory", "7 numbers"]),
    "empty truth": (lambda d: write(d, "GROUNDTRUTH", ["?"]), "", ["GROUNDTRUTH.csv", "no trajectory"]),
    "other clock": (
        lambda d: write(d, "ODOMETRY_XYT", [line[3:] for line in odometry_lines(path_of())]),
        "", ["holds no scan"],
    ),
    "zeros": (lambda d: write(d, "SICK_FRONT", scan_lines(np.zeros((SCANS, BEAMS)))), "", ["NaN or zero"]),
    "other beams": (lambda d: (d / "meta.yaml").write_text("beams: 361\n"), "", ["meta.yaml", "beams = 361"]),
}  # fmt: skip


@pytest.mark.parametrize("kind", SPOILT)
def test_spoilt_sessions_are_one_line(folder, kind):
    spoil, name, fragments = SPOILT[kind]
    spoil(folder)
    with pytest.raises(UserError) as error:
        load_log(folder / name)
    assert all(fragment in str(error.value) for fragment in fragments), error.value
    assert "\n" not in str(error.value)


def test_the_update_after_a_reset_of_the_odometry_is_marked(tmp_path):
    poses = path_of()
    poses[6:] += np.array([50.0, 0.0, 0.0])
    path = write(tmp_path, "SICK_FRONT", scan_lines(ranges_of()))
    write(tmp_path, "ODOMETRY_XYT", odometry_lines(poses))
    log = load_rawseeds(path)
    np.testing.assert_array_equal(np.flatnonzero(log.broken), [6])
    assert 6 in thin(log, 10.0, 10.0)
