"""Bags of the three formats, written here: topics, mounts, interpolation, and what can be wrong with them."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from dsom_jax.data import LogOptions, load_bag, load_log, se2
from dsom_jax.data.bag_types import odd_field, standard
from dsom_jax.errors import UserError
from fixtures.make_bag import FORMATS, Entry, write_bag

RANGES = (0.05, 0.0, 1.0, 7.5, 8.0, 9.0, np.inf, np.nan)


def drive(
    n: int = 5, scan_topic: str = "/scan", odom_topic: str = "/odom", mount: tuple = (0.2, 0.1, 0.5)
) -> list[Entry]:
    """Scans half way between odometry messages of 1 m and 0.4 rad each 0.2 s, over the wrap of the heading."""
    out: list[Entry] = [(10.0, "/tf_static", "tf", ("base_link", "laser", *mount))] if mount else []
    for k in range(n):
        t = 10.0 + 0.2 * k
        out.append((t, odom_topic, "odom", (float(k), 2.0, float(se2.wrap(3.0 + 0.4 * k)))))
        out.append((t + 0.1, scan_topic, "scan", (RANGES,)))
    return out


@pytest.mark.parametrize("form", FORMATS)
def test_every_format(tmp_path: Path, form: str) -> None:
    log = load_bag(write_bag(tmp_path, form, drive()))
    np.testing.assert_allclose(log.stamps, 10.1 + 0.2 * np.arange(5), atol=1e-9)
    # REP-117: too close, zero is an error code, returns, from range_max on no return.
    expected = [-np.inf, np.nan, 1.0, 7.5, np.inf, np.inf, np.inf, np.nan]
    np.testing.assert_array_equal(log.ranges, np.tile(np.float32(expected), (5, 1)))
    # The last scan is 0.1 s after the last odometry, which is close enough to stand for it.
    np.testing.assert_allclose(log.odometry[:, 0], [0.5, 1.5, 2.5, 3.5, 4.0], atol=1e-6)
    np.testing.assert_allclose(se2.wrap(log.odometry[:4, 2] - 3.2 - 0.4 * np.arange(4)), 0, atol=1e-6)
    assert (log.lidar.beams, log.lidar.angle_min, log.lidar.angle_increment) == (8, -1.0, 0.5)
    assert log.lidar.range_max == 8.0 and log.lidar.range_min == pytest.approx(0.1)
    np.testing.assert_allclose(log.lidar.mount, [0.2, 0.1, 0.5], atol=1e-9)
    assert not log.lidar.upside_down and log.reference is None


@pytest.mark.parametrize("form", ["db3", "mcap"])
def test_storage_file_without_its_folder(tmp_path: Path, form: str) -> None:
    folder = write_bag(tmp_path, form, drive())
    (storage,) = folder.glob(f"*.{form}")
    alone = tmp_path / f"alone.{form}"
    shutil.copy(storage, alone)
    np.testing.assert_array_equal(load_log(alone).ranges, load_log(folder).ranges)


@pytest.mark.parametrize(
    ("msgtype", "fields", "odd"),
    [
        ("sensor_msgs/msg/LaserScan", lambda own: own[:5] + own[6:], "scan_time"),
        ("sensor_msgs/msg/LaserScan", lambda own: [*own[:8], ("ranges", own[5][1]), own[9]], "ranges"),
        ("sensor_msgs/msg/LaserScan", lambda own: [("header", own[1][1]), *own[1:]], "header"),
        ("std_msgs/msg/Header", lambda own: [("seq", own[0][1]), *own], ""),
        ("std_msgs/msg/Header", lambda own: own[:1], "header.frame_id"),
        ("builtin_interfaces/msg/Time", lambda own: own[:1], "header.stamp.nanosec"),
        ("std_msgs/msg/Header", None, "header.std_msgs/msg/Header"),
    ],
)
def test_definitions_that_lack_what_is_read(msgtype: str, fields, odd: str) -> None:
    own = dict(standard())
    constants, held = own.pop(msgtype)
    if fields is not None:
        own[msgtype] = (constants, fields(held))
    assert odd_field(own, "sensor_msgs/msg/LaserScan") == odd
    assert odd_field(own, "mine/msg/Other") == ""


def test_scans_of_a_definition_without_scan_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bag = write_bag(tmp_path, "db3", drive())
    place = "dsom_jax.data.bag_file.odd_field"
    monkeypatch.setattr(place, lambda own, kind: "scan_time" if "LaserScan" in kind else "")
    with pytest.raises(UserError, match="topic /scan holds no scan"):
        load_bag(bag)
    monkeypatch.setattr(place, lambda own, kind: "header")
    with pytest.raises(UserError, match="topic /scan holds no scan"):
        load_bag(bag)


@pytest.mark.parametrize(
    ("field", "value", "where"),
    [
        ("name: /scan", "name: [/scan, /b]", r"Expected `str`, got `array` - at .*topic_metadata\.name"),
        ("type: sensor_msgs/msg/LaserScan", "type: {a: 1}", r"Expected `str`, got `object` .*metadata\.type"),
        ("storage_identifier: sqlite3", "storage_identifier: [1]", "Expected `str`.*storage_identifier"),
        ("message_count: 5", "message_count: many", "Expected `int`, got `str`.*message_count"),
        ("rosbag2_bagfile_information:", "other:", "missing required field `rosbag2_bagfile_information`"),
    ],
)
def test_metadata_of_wrong_types(tmp_path: Path, field: str, value: str, where: str) -> None:
    metadata = write_bag(tmp_path, "db3", drive()) / "metadata.yaml"
    text = metadata.read_text()
    assert field in text
    metadata.write_text(text.replace(field, value))
    with pytest.raises(UserError, match=rf"metadata\.yaml: .*{where}.*reindex"):
        load_log(metadata.parent)


def test_upside_down_laser_through_a_chain_of_frames(tmp_path: Path) -> None:
    entries = drive(mount=())
    # base_link is a child of the frame that odometry moves; the laser hangs on a mast, head down and turned.
    static = [
        (10.0, "/tf_static", "tf", ("base_footprint", "base_link", 0.0, 0.0, 0.0)),
        (10.0, "/tf_static", "tf", ("/base_link", "/mast", 0.3, 0.0, np.pi / 2)),
        (10.0, "/tf_static", "tf", ("mast", "laser", 0.1, 0.0, 0.25, np.pi)),
    ]
    moved = [(t, topic, kind, (*v, "base_footprint") if kind == "odom" else v) for t, topic, kind, v in entries]
    lidar = load_bag(write_bag(tmp_path, "bag", static + moved)).lidar
    assert lidar.upside_down
    np.testing.assert_allclose(lidar.mount, [0.3, 0.1, np.pi / 2 + 0.25], atol=1e-6)
    # A beam to the sensor's left (+1 rad) of a laser head down points to the right of its forward direction.
    beam = int(np.argmin(np.abs(lidar.angle_min + lidar.angle_increment * np.arange(8) - 1.0)))
    assert lidar.angles()[beam] == pytest.approx(np.pi / 2 + 0.25 - 1.0, abs=1e-6)


def test_missing_mount_and_tilt_are_reported(tmp_path: Path) -> None:
    log = load_bag(write_bag(tmp_path, "bag", drive(mount=())))
    assert log.lidar.mount == (0, 0, 0) and any("missing transform base_link -> laser" in s for s in log.report.lines())
    tilted = load_bag(write_bag(tmp_path, "db3", drive(mount=(0.0, 0.0, 0.0, 0.5))))
    assert any("tilted by 29 deg" in line for line in tilted.report.lines())


def test_odometry_from_tf_where_there_is_no_topic(tmp_path: Path) -> None:
    entries = [
        (t, "/tf", "tf", ("odom", "base_link", *v)) if kind == "odom" else (t, topic, kind, v)
        for t, topic, kind, v in drive()
    ]
    log = load_bag(write_bag(tmp_path, "bag", entries))
    np.testing.assert_allclose(log.odometry[:4, 0], [0.5, 1.5, 2.5, 3.5], atol=1e-6)
    np.testing.assert_allclose(log.lidar.mount, [0.2, 0.1, 0.5], atol=1e-9)


def test_topics_must_be_chosen_where_there_are_several(tmp_path: Path) -> None:
    entries = [*drive(), (11.1, "/rear", "scan", ((1.0, 2.0),)), (11.1, "/visual_odom", "odom", (0.0, 0.0, 0.0))]
    path = write_bag(tmp_path, "bag", entries)
    with pytest.raises(UserError, match=r"several .*LaserScan topics; set --scan-topic to one of /rear, /scan"):
        load_bag(path)
    with pytest.raises(UserError, match=r"several nav_msgs/Odometry topics; set --odom-topic"):
        load_bag(path, LogOptions(scan_topic="/scan"))
    assert len(load_bag(path, LogOptions(scan_topic="/scan", odom_topic="/odom"))) == 5
    with pytest.raises(UserError, match=r"--scan-topic /lidar: no such .* /odom \(nav_msgs/msg/Odometry\), /rear"):
        load_bag(path, LogOptions(scan_topic="/lidar", odom_topic="/odom"))


def test_missing_topics(tmp_path: Path) -> None:
    for k, (kinds, message) in enumerate(
        [
            (("odom", "tf"), "holds no sensor_msgs/LaserScan topic; topics in the bag: /odom"),
            (("scan",), "holds no odometry"),
        ]
    ):
        (tmp_path / str(k)).mkdir()
        path = write_bag(tmp_path / str(k), "bag", [e for e in drive() if e[2] in kinds])
        with pytest.raises(UserError, match=message):
            load_bag(path)


def test_scans_far_from_odometry_and_of_other_size_are_dropped(tmp_path: Path) -> None:
    entries = [*drive(), (11.15, "/scan", "scan", ((1.0, 2.0),)), (15.0, "/scan", "scan", (RANGES,))]
    log = load_bag(write_bag(tmp_path, "bag", entries))
    assert len(log) == 5
    assert log.report.counts["scans without odometry near their stamp"] == 1
    assert log.report.counts["scans that cover less than half of the lidar's 8 beams dropped"] == 1


def test_range_max_override(tmp_path: Path) -> None:
    log = load_bag(write_bag(tmp_path, "bag", drive()), range_max=5.0)
    assert log.lidar.range_max == 5.0 and np.isposinf(log.ranges[:, 3]).all()


@pytest.mark.parametrize("told", [np.inf, 0.0, np.nan])
def test_scans_that_tell_no_range_max(tmp_path: Path, told: float) -> None:
    entries = [(t, topic, kind, (*v, "laser", told) if kind == "scan" else v) for t, topic, kind, v in drive()]
    log = load_bag(write_bag(tmp_path, "bag", entries))
    assert log.lidar.range_max == pytest.approx(9.01) and log.ranges[0, 5] == 9.0 and np.isposinf(log.ranges[0, 6])
    assert any("9.01 m is taken" in line for line in log.report.lines())


def test_odometry_that_is_no_number_costs_its_own_message_only(tmp_path: Path) -> None:
    entries = drive(n=8)
    spoilt = [(t, top, kind, (np.nan, *v[1:]) if (kind, t) == ("odom", 10.4) else v) for t, top, kind, v in entries]
    log = load_bag(write_bag(tmp_path, "bag", spoilt))
    assert len(log) == 8 and log.report.counts["odometry messages that are not finite dropped"] == 1
    np.testing.assert_allclose(log.odometry[:3, 0], [0.5, 1.5, 2.5], atol=1e-6)


def test_a_laser_with_a_clock_of_its_own_is_told(tmp_path: Path) -> None:
    entries = [(t - 9.0 if kind == "scan" else t, topic, kind, v) for t, topic, kind, v in drive()]
    with pytest.raises(UserError, match=r"odometry from 10.000 to 10.800 s, scans from 1.100 to 1.900 s.*one clock"):
        load_log(write_bag(tmp_path, "bag", entries))


@pytest.mark.parametrize("name", ["a.bag", "a.db3", "a.mcap"])
@pytest.mark.parametrize("content", [b"", b"not a bag at all, whatever its name says"])
def test_broken_bags(tmp_path: Path, name: str, content: bytes) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(UserError, match=f"{name}: not a readable bag") as error:
        load_bag(tmp_path / name)
    assert "\n" not in str(error.value)


def test_a_bag_cut_off(tmp_path: Path) -> None:
    path = write_bag(tmp_path, "bag", drive(n=50))
    path.write_bytes(path.read_bytes()[:3000])
    with pytest.raises(UserError, match="not a readable bag"):
        load_bag(path)
