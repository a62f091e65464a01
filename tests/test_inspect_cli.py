"""The command line of ``inspect``, and what needs no search, on files and by hand."""

from __future__ import annotations

import json
import sys
from dataclasses import replace

import numpy as np
import pytest

import inspect_kit as kit
from dsom_jax import inspect
from dsom_jax.data import LogOptions, save_ros_map
from dsom_jax.data.log import Report, majority_beams, select
from dsom_jax.diagnosis import ego_motion, explain
from dsom_jax.diagnosis.describe import messages_of
from dsom_jax.diagnosis.matching import bearings
from dsom_jax.diagnosis.symptoms import cheap_findings, code_at_the_top, grey_is_free
from dsom_jax.errors import run_cli
from dsom_jax.occupancy import from_cells
from fixtures import strangers
from fixtures.make_bag import FORMATS, changed_in, without_types, write_bag

LOG = kit.drive()


def write(folder, log=LOG):
    """``map.yaml`` and ``drive.log`` of the floor."""
    save_ros_map(kit.grid(), folder / "map.yaml")
    rows = []
    for scan, odometry, pose, stamp in zip(log.ranges, log.odometry, log.reference, log.stamps, strict=True):
        words = [f"{r:.3f}" for r in np.minimum(scan, 81.83)] + [f"{v:.5f}" for v in (*pose, *odometry)]
        rows.append(f"FLASER {len(scan)} {' '.join(words)} {stamp:.3f} robot {stamp:.3f}")
    (folder / "drive.log").write_text("\n".join(rows) + "\n")
    return folder / "drive.log"


@pytest.fixture
def call(tmp_path, monkeypatch, capsys):
    """Runs the command on some of the steps; gives its JSON and what was printed."""
    monkeypatch.setattr(explain, "matched_steps", lambda log: ego_motion.matched_steps(log, pairs=60, blocks=3))

    def go(*words):
        monkeypatch.setattr(sys, "argv", ["inspect", *map(str, words), "--json", str(tmp_path / "new" / "found.json")])
        run_cli(inspect.main)
        text = (tmp_path / "new" / "found.json").read_text()
        return json.loads(text, parse_constant=pytest.fail), capsys.readouterr().out

    return go


def test_a_log_and_its_map(call, tmp_path):
    found, printed = call(write(tmp_path), "--map", tmp_path / "map.yaml")
    log, about = found["log"], found["map"]
    assert set(found) == {"log", "map", "findings"} and found["findings"] == []
    assert (log["scans"], log["beams"], log["messages"]) == (len(LOG), 181, {"FLASER": len(LOG)})
    assert abs(log["fov_deg"] - 181) < 0.1 and abs(log["clock"]["rate_hz"] - 2) < 1e-6
    assert abs(sum(log["ranges"]["shares"].values()) - 1) < 1e-9 and log["mount"]["yaw_deg"] == 0
    assert (about["cells"], about["resolution_m"], about["origin"]) == ([95, 150], 0.1, [-2.0, 1.0, 0.0])
    assert log["scans_against_map"]["held"] == 1 and log["scans_against_odometry"]["odometry_signs"] == "as is"
    assert "nothing found that is wrong" in printed and "181 beams" in printed


def test_a_mirrored_scan_without_a_map(call, tmp_path):
    found, printed = call(write(tmp_path, replace(LOG, ranges=LOG.ranges[:, ::-1])))
    first = found["findings"][0]
    assert set(first) == {"code", "severity", "says", "fix"} and found["map"] is None
    assert (first["code"], first["severity"]) == ("scan_mirrored", "error") and "upside_down: true" in first["fix"]
    assert "error: scan_mirrored: " in printed


def bag(log=LOG):
    """What a bag of the drive holds."""
    lidar, entries = log.lidar, []
    for scan, odometry, stamp in zip(log.ranges, log.odometry, log.stamps, strict=True):
        entries.append((stamp, "/odom", "odom", tuple(odometry.tolist())))
        angles = (lidar.angle_min, lidar.angle_increment, 0.0, None, lidar.range_max)
        entries.append((stamp, "/scan", "laser", (scan, "laser", *angles)))
    return entries


def floor():
    """A bag's map of the floor."""
    return [(100.0, "/map", "grid", (100 * kit.cells(), kit.RESOLUTION, -2.0, 1.0))]


def test_a_bag_of_humble_and_its_map_in_another_bag(call, tmp_path):
    """The drive and the map in a bag each, the first without its types."""
    log = without_types(write_bag(tmp_path, "db3", bag()))
    plan = write_bag(tmp_path, "bag", floor())
    found, printed = call(log, "--map", plan)
    assert found["findings"] == [] and found["log"]["scans_against_map"]["held"] == 1
    topics = {"/odom (nav_msgs/msg/Odometry)": len(LOG), "/scan (sensor_msgs/msg/LaserScan)": len(LOG)}
    assert found["log"]["messages"] == topics and found["map"]["cells"] == [95, 150]
    assert "nothing found that is wrong" in printed


@pytest.mark.parametrize("form", FORMATS)
def test_messages_of_bags_and_no_grey_in_their_maps(tmp_path, form):
    path = write_bag(tmp_path, form, [*bag(select(LOG, np.arange(3))), *floor()])
    assert messages_of(path)["/map (nav_msgs/msg/OccupancyGrid)"] == 1 and grey_is_free(path) == []
    if form == "db3":
        assert messages_of(without_types(path)) == messages_of(path)


def test_a_map_in_a_bag_that_cannot_be_read_is_one_line(tmp_path, monkeypatch, capsys):
    write(tmp_path, select(LOG, np.arange(5)))
    plan = changed_in(write_bag(tmp_path, "db3", floor()), "UPDATE messages SET data = substr(data, 1, 20)")
    monkeypatch.setattr(sys, "argv", ["inspect", str(tmp_path / "drive.log"), "--map", str(plan)])
    with pytest.raises(SystemExit) as stop:
        run_cli(inspect.main)
    (line,) = capsys.readouterr().err.splitlines()
    assert stop.value.code == 2 and "topic /map holds no map that can be read (1 unreadable messages on /map" in line


@pytest.mark.parametrize("words", [["none.log"], [".", "--map", "none.yaml"], ["drive.log", "--map", "none.yaml"]])
def test_bad_input_is_one_line(tmp_path, monkeypatch, capsys, words):
    write(tmp_path, select(LOG, np.arange(5)))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["inspect", *words, "--json", "found.json"])
    with pytest.raises(SystemExit) as stop:
        run_cli(inspect.main)
    assert stop.value.code == 2 and len(capsys.readouterr().err.splitlines()) == 1
    assert not (tmp_path / "found.json").exists()


def codes(log, grid=None):
    return [f.code for f in cheap_findings(log, grid)]


def test_nothing_is_odd_about_a_clean_log():
    assert codes(LOG, kit.grid()) == []


def test_a_code_among_the_ranges():
    gone = np.random.default_rng(0).random(LOG.ranges.shape) < 0.05
    coded = replace(LOG, ranges=np.where(gone, np.float32(30.0), LOG.ranges), lidar=replace(LOG.lidar, range_max=40.0))
    (found,) = cheap_findings(coded)
    assert found.code == "no_return_code" and "30.00" in found.says and "--laser-max-range 29.98" in found.fix
    zeros = replace(LOG, ranges=np.where(gone | np.isinf(LOG.ranges), np.float32(np.nan), LOG.ranges))
    assert codes(zeros) == ["no_return_code"]


@pytest.mark.parametrize("seed", range(3))
def test_walls_are_no_code(seed):
    """Returns of rooms of all sizes, rounded to centimetres, with one wall that is seen again and again."""
    rng = np.random.default_rng(seed)
    walls = np.concatenate([rng.gamma(2, 2, 20_000), rng.normal(20, 0.03, 300)])
    assert code_at_the_top(np.round(walls, 2)) is None


def test_the_robots_own_body():
    ranges = LOG.ranges.copy()
    ranges[:, 40:52] = 0.3
    (found,) = cheap_findings(replace(LOG, ranges=ranges))
    assert found.code == "self_hits" and "12 of 181 beams (40:51)" in found.says
    assert codes(replace(LOG, ranges=ranges, odometry=LOG.odometry * 0.01)) == []
    mask, least = (found.fix.split(word)[1].strip(" ,or") for word in ("--laser-mask", "--laser-min-range"))
    mask = mask.split(",")[0]
    hidden = LogOptions(laser_mask=tuple(mask.split())).masked(bearings(LOG.lidar))
    np.testing.assert_array_equal(np.flatnonzero(hidden), np.arange(40, 52))
    assert float(least) == pytest.approx(0.35)


def test_odometry_that_stands_still_for_a_while():
    odometry = LOG.odometry.copy()
    odometry[60:90] = odometry[60]
    found = cheap_findings(replace(LOG, odometry=odometry))[0]
    assert (found.code, found.severity) == ("odometry_frozen", "error") and "130.00 to 144.50 s" in found.says
    parked = replace(LOG, odometry=odometry, ranges=np.concatenate([LOG.ranges[:60], np.tile(LOG.ranges[60], (30, 1)),
                                                                    LOG.ranges[90:]]))  # fmt: skip
    assert "odometry_frozen" not in codes(parked)


def test_odometry_that_leaps():
    odometry = LOG.odometry.copy()
    odometry[80:, :2] += [2.5, -1.0]
    (found,) = cheap_findings(replace(LOG, odometry=odometry))
    assert found.code == "odometry_jump" and "140.00 s" in found.says


def test_stamps_and_beams_as_the_reader_saw_them():
    report = Report()
    majority_beams([np.ones(181)] * 9 + [np.ones(179)] * 7, report, LOG.path)
    stamps = LOG.stamps.copy()
    stamps[50] = stamps[49]
    assert codes(replace(LOG, stamps=stamps, report=report)) == ["beams_vary", "odd_stamps"]


@pytest.mark.parametrize(("beams", "code"), [((170, 190), ["beams_vary"]), ((60, 61), ["beams_vary"]), (None, [])])
def test_beams_of_a_bag_that_vary(tmp_path, beams, code):
    """Every scan of another number of beams, or a third of them of far fewer; all the same get no word."""
    rng, counts = np.random.default_rng(2), None
    if beams:
        counts = np.where(np.arange(strangers.SCANS) % 3 == 0, rng.integers(*beams, strangers.SCANS), 180)
    entries = [*strangers.lasers(strangers.DRIVE, strangers.LIDAR, beams=counts), *strangers.wheels(strangers.DRIVE)]
    found = cheap_findings(strangers.load(tmp_path, [*entries, *strangers.MOUNT]))
    assert [f.code for f in found] == code


def test_unknown_space_that_counts_as_free():
    grid = kit.grid()
    free = np.zeros((125, 180), bool)
    free[15:110, 15:165] = np.asarray(grid.free)
    occupied = np.zeros_like(free)
    occupied[15:110, 15:165] = np.asarray(grid.occupied)
    assert codes(LOG, from_cells(occupied, free, resolution=0.1, origin=(-3.5, -0.5, 0.0))) == []
    assert codes(LOG, from_cells(occupied, resolution=0.1, origin=(-3.5, -0.5, 0.0))) == ["unknown_is_free"]


def test_the_grey_of_unknown_pixels(tmp_path):
    grid = kit.grid()
    known = np.asarray(grid.free).copy()
    known[:30] = False
    save_ros_map(from_cells(grid.occupied, known, resolution=0.1), tmp_path / "map.yaml")
    assert grey_is_free(tmp_path / "map.yaml") == []
    text = (tmp_path / "map.yaml").read_text()
    (tmp_path / "map.yaml").write_text(text.replace("free_thresh: 0.196", "free_thresh: 0.25"))
    (found,) = grey_is_free(tmp_path / "map.yaml")
    below = float(found.fix.split()[1])
    # Of 205 and 254 of 255 the first must be unknown and the second free.
    assert 1 - 254 / 255 < below < 1 - 205 / 255


def test_a_reference_off_the_map():
    away = replace(LOG, reference=LOG.reference + np.array([40.0, 0, 0]))
    (found,) = cheap_findings(away, kit.grid())
    assert (found.code, found.severity) == ("reference_frame", "error")
