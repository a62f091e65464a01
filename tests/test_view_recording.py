"""Recordings of answers: read back by the readers of logs and maps, and message by message."""

from __future__ import annotations

import csv
import json
import sys
from dataclasses import replace
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from rosbags.interfaces import QosDurability

import made_story
import tiny_world
from dsom_jax import localize
from dsom_jax.data import LogOptions, load_log, load_map
from dsom_jax.data.bag_file import open_bag
from dsom_jax.data.tf_tree import planar, stamp_of
from dsom_jax.errors import UserError, run_cli
from dsom_jax.judging.scores import Drive
from dsom_jax.lidar import LidarConfig, scan_points
from dsom_jax.localize_args import LocalizeArgs, check
from dsom_jax.occupancy import from_cells
from dsom_jax.view.recording import MOST, ready, updates, write_mcap
from dsom_jax.view.rerun_file import returns, write_rerun
from tiny_log import record

LIDAR = LidarConfig(
    beams=made_story.BEAMS, angle_min=-np.pi, angle_increment=2 * np.pi / made_story.BEAMS, range_min=0.1,
    range_max=10.0, mount=(0.1, -0.05, 0.3), upside_down=True,
)  # fmt: skip


def grid():
    """The map of the made-up story: occupied, free and unknown cells in a shifted and turned frame."""
    plan = made_story.plan()
    return from_cells(plan.occupied, plan.free, resolution=plan.resolution, origin=tuple(plan.origin))


def drive(**fields):
    """The made-up drive with all kinds of readings that REP-117 knows, and a reference that begins late."""
    found = made_story.drive()
    ranges, truth = found.ranges.astype(np.float32), found.truth.copy()
    ranges[:, 3], ranges[:, 5], truth[:10] = -np.inf, np.nan, np.nan
    return replace(found, **({"ranges": ranges, "truth": truth} | fields))


def messages(path):
    """TOPIC -> [(nanoseconds of the recording, message)]; and the connections by topic."""
    found: dict[str, list] = {}
    with open_bag(path) as reader:
        for connection, at, raw in reader.messages():
            found.setdefault(connection.topic, []).append((at, reader.deserialize(raw, connection.msgtype)))
        return found, {connection.topic: connection for connection in reader.connections}


def poses_of(told):
    """(T, 3) poses of PoseStamped."""
    return np.array([planar(message.pose.position, message.pose.orientation) for _, message in told])


def assert_same_poses(found, expected):
    gap = np.asarray(found, float) - expected
    gap[..., 2] = (gap[..., 2] + np.pi) % (2 * np.pi) - np.pi
    np.testing.assert_allclose(gap, 0, atol=1e-6)


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    path = tmp_path_factory.mktemp("recording") / "answers.mcap"
    write_mcap(path, grid(), LIDAR, [drive()])
    return path


def test_map_scans_and_answers_come_back(written):
    plan, log = load_map(written), load_log(written, LogOptions(reference_topic="/reference"))
    np.testing.assert_array_equal(plan.occupied, grid().occupied)
    np.testing.assert_array_equal(plan.free, grid().free)
    np.testing.assert_allclose(plan.origin, grid().origin, atol=1e-6)
    assert plan.resolution == np.float32(grid().resolution)
    np.testing.assert_array_equal(log.ranges, drive().ranges)  # infinities and NaN where they were
    np.testing.assert_allclose(log.stamps, drive().stamps, rtol=0, atol=2e-9)
    np.testing.assert_allclose(log.lidar.angles(), LIDAR.angles(), atol=1e-5)
    np.testing.assert_allclose(log.lidar.mount, LIDAR.mount, atol=1e-9)
    assert (log.lidar.range_min, log.lidar.range_max) == pytest.approx((0.1, 10.0)) and log.lidar.upside_down
    # The answers are read as odometry, whose jumps, from update 8 on, the reader takes for resets.
    assert_same_poses(log.odometry[:8], drive().estimates[:8])
    assert log.broken[8]
    assert_same_poses(log.reference[10:], drive().truth[10:])


def test_messages_are_of_their_stamps_and_frames(written):
    told, connections = messages(written)
    nanoseconds = np.rint(drive().stamps * 1e9).astype(int).tolist()
    for topic, frame in (("/tf", ""), ("/scan", "laser"), ("/amcl_pose", "map"), ("/particle_cloud", "map")):
        assert [at for at, _ in told[topic]] == nanoseconds
        if frame:
            assert {message.header.frame_id for _, message in told[topic]} == {frame}
            np.testing.assert_allclose([stamp_of(message) for _, message in told[topic]], drive().stamps, atol=2e-9)
    assert [at for at, _ in told["/reference"]] == nanoseconds[10:]
    assert [at for at, _ in told["/map"] + told["/tf_static"]] == nanoseconds[:1] * 2
    turns = [t for _, message in told["/tf"] for t in message.transforms]
    assert_same_poses([planar(t.transform.translation, t.transform.rotation) for t in turns], drive().estimates)
    frames = {(t.header.frame_id, t.child_frame_id) for _, m in told["/tf"] + told["/tf_static"] for t in m.transforms}
    assert frames == {("map", "base_link"), ("base_link", "laser")}
    # Whoever begins to play later, or listens later, still gets the map and where the laser sits.
    lasts = {t for t, c in connections.items() for qos in c.ext.offered_qos_profiles
             if qos.durability == QosDurability.TRANSIENT_LOCAL}  # fmt: skip
    assert lasts == {"/map", "/tf_static"}


def test_answers_with_their_spread_particles_and_verdict(written):
    told, _ = messages(written)
    drove, (_, cloud) = drive(), told["/particle_cloud"][7]
    assert_same_poses(poses_of([(at, message.pose) for at, message in told["/amcl_pose"]]), drove.estimates)
    assert_same_poses([planar(pose.position, pose.orientation) for pose in cloud.poses], drove.particles[7])
    _, answer = told["/amcl_pose"][40]
    covariance = answer.pose.covariance.reshape(6, 6)
    gap = drove.particles[40] - drove.estimates[40]
    expected = np.einsum("p,pi,pj->ij", drove.particle_weights[40], gap, gap)
    np.testing.assert_allclose(covariance[np.ix_([0, 1, 5], [0, 1, 5])], expected, atol=1e-9)
    assert not covariance[2:5].any() and not covariance[:, 2:5].any()
    verdicts = [json.loads(message.data) for _, message in told["/verdict"]]
    assert [said["verdict"] for said in verdicts] == list(drove.verdicts)
    assert [said["p_lost"] for said in verdicts] == drove.p_lost.tolist()
    assert [n for n, said in enumerate(verdicts) if said["kidnapped"]] == [made_story.CARRIED]
    places = [[h["weight"], h["x"], h["y"], h["theta"]] for h in verdicts[0]["hypotheses"]]
    expected = np.column_stack([drove.hypotheses.weights[0], drove.hypotheses.means[0]])
    np.testing.assert_allclose(places, expected)
    assert len(verdicts[60]["hypotheses"]) == 1 and verdicts[0]["segment"] == 1


def test_of_overlapping_drives_the_earlier_one_counts():
    first, second = drive(stamps=500.0 + np.arange(120)), drive(stamps=450.0 + np.arange(120))
    found = updates([first, second])
    assert [update.stamp for update in found] == (450.0 + np.arange(170)).tolist()
    assert [update.segment for update in found] == [2] * 50 + [1] * 120


def test_many_particles_are_thinned():
    many = np.random.default_rng(0).normal(size=(120, 3 * MOST, 3))
    (first, *_) = updates([drive(particles=many, particle_weights=np.full((120, 3 * MOST), 1 / (3 * MOST)))])
    assert first.particles.shape == (MOST, 3)


def test_one_whole_file_in_place_of_the_old_one(tmp_path):
    path = tmp_path / "answers.mcap"
    path.write_text("old")
    write_mcap(path, grid(), LIDAR, [drive()])
    assert load_map(path).shape == grid().shape and [p.name for p in tmp_path.iterdir()] == ["answers.mcap"]


@pytest.mark.parametrize(("write", "option"), [(write_mcap, "--mcap"), (write_rerun, "--rerun")])
def test_what_cannot_be_written_is_one_line_and_leaves_nothing(tmp_path, write, option):
    if write is write_rerun:
        pytest.importorskip("rerun")
    path = tmp_path / "taken.mcap"
    (path / "by").mkdir(parents=True)
    with pytest.raises(UserError, match=rf"{option} .*taken.mcap: cannot be written \(.+\); name another file"):
        write(path, grid(), LIDAR, [drive()])
    assert [p.name for p in tmp_path.iterdir()] == ["taken.mcap"]


def args(**fields):
    return LocalizeArgs(Path("m.yaml"), Path("l.log"), Path("out"), **fields)


@pytest.mark.parametrize(
    ("fields", "says"),
    [
        ({"mcap": Path("answers.bag")}, "--mcap answers.bag: name a file that ends in .mcap"),
        ({"mcap": Path("answers")}, "--mcap answers: name a file that ends in .mcap"),
        ({"rerun": Path("answers.mcap")}, "--rerun answers.mcap: name a file that ends in .rrd"),
    ],
)
def test_other_kinds_of_files_are_refused(fields, says):
    with pytest.raises(UserError) as error:
        check(args(**fields))
    assert str(error.value) == says


def test_a_folder_is_refused(tmp_path):
    (tmp_path / "bag.mcap").mkdir()
    with pytest.raises(UserError, match=r"--mcap .*bag.mcap: is a folder; name a file"):
        check(args(mcap=tmp_path / "bag.mcap"))


def test_without_rerun_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(UserError) as error:
        check(args(rerun=Path("answers.rrd")))
    assert str(error.value) == "--rerun: needs rerun-sdk; run pip install 'dsom-jax[rerun]'"


def drives(first):
    return [Drive(None, first + np.arange(3.0))]


def test_folders_are_made_and_refused_by_the_name_of_the_option(tmp_path):
    ready(tmp_path / "a" / "b.mcap", tmp_path / "c" / "d.rrd", drives(0.0))
    assert (tmp_path / "a").is_dir() and (tmp_path / "c").is_dir()
    (tmp_path / "file").write_text("")
    for option in ("mcap", "rerun"):
        asked = {"mcap": None, "rerun": None, option: tmp_path / "file" / "b"}
        with pytest.raises(UserError, match=rf"--{option} .*file: cannot write there"):
            ready(**asked, drives=drives(0.0))


def test_stamps_that_ros_does_not_know_are_refused(tmp_path):
    for first in (-1.0, 2.0**31):
        with pytest.raises(UserError, match=r"--mcap .*: the log has the stamp .* s, and ROS 2 counts from 0"):
            ready(tmp_path / "b.mcap", None, drives(first))
        ready(None, tmp_path / "b.rrd", drives(first))


def test_points_of_a_scan_are_where_the_beams_ended():
    """Those in the frame of the lidar, put where it sits head down, are those in the base frame."""
    scan = drive().ranges[0]
    x, y, z = returns(scan, LIDAR).T
    c, s = np.cos(LIDAR.mount[2]), np.sin(LIDAR.mount[2])
    in_base = np.stack([LIDAR.mount[0] + c * x + s * y, LIDAR.mount[1] + s * x - c * y], -1)
    points, valid = scan_points(jnp.asarray(scan), LIDAR)
    np.testing.assert_allclose(in_base, np.asarray(points)[np.asarray(valid)], atol=1e-4)
    assert not z.any() and len(x) == np.isfinite(scan).sum()


def entities(path):
    """ENTITY -> its columns as lists over its rows, in the order of the file."""
    reader = pytest.importorskip("rerun.chunk").RrdReader(path)
    found: dict[str, dict[str, list]] = {}
    for chunk in reader.stream().to_chunks():
        batch = chunk.to_record_batch()
        for name in batch.schema.names:
            found.setdefault(chunk.entity_path, {}).setdefault(name, []).extend(batch.column(name).to_pylist())
    return found


def test_rerun_holds_the_same(tmp_path):
    pytest.importorskip("rerun")
    path = tmp_path / "answers.rrd"
    path.write_text("old")
    write_rerun(path, grid(), LIDAR, [drive()])
    assert [p.name for p in tmp_path.iterdir()] == ["answers.rrd"]
    told, drove = entities(path), drive()
    robot, cells = told["/map/base_link"], told["/map/cells"]
    order = np.argsort(np.array(robot["stamp"], "datetime64[ns]"))
    np.testing.assert_array_equal(np.array(robot["stamp"], "datetime64[ns]").astype(int)[order],
                                  np.rint(drove.stamps * 1e9).astype(int))  # fmt: skip
    places = np.array(robot["Transform3D:translation"])[order, 0]
    np.testing.assert_allclose(places[:, :2], drove.estimates[:, :2], atol=1e-5)
    turns = np.array(robot["Transform3D:quaternion"])[order, 0]
    np.testing.assert_allclose(2 * np.arctan2(turns[:, 2], turns[:, 3]) - drove.estimates[:, 2], 0, atol=1e-5)
    picture = np.array(cells["GridMap:data"][0][0], np.uint8).view(np.int8).reshape(grid().shape)[::-1]
    np.testing.assert_array_equal(picture == 100, grid().occupied)
    np.testing.assert_array_equal(picture == 0, grid().free)
    assert len(told["/map/particles"]["Arrows3D:origins"][0]) == made_story.PARTICLES
    shown = [len(rows) for rows in told["/map/reference"]["Arrows3D:origins"]]
    assert sorted(shown) == [0] * 10 + [1] * 110
    assert sorted(v for (v,) in told["/p_lost"]["Scalars:scalars"]) == sorted(drove.p_lost)
    assert {json.loads(text)["verdict"] for (text,) in told["/verdict"]["TextDocument:text"]} == set(drove.verdicts)
    assert len(told["/map/base_link/laser/scan"]["Points3D:positions"][0]) == np.isfinite(drove.ranges[0]).sum()


def localized(folder, *words):
    """Rows of answers.csv, and the text of stderr, of ``localize`` in the tiny room."""
    room = record(folder)
    common = ["localize", "--map", room.map, "--log", room.log, "--reference", room.reference, "--out", folder / "out"]
    common += ["--runs", 2, "--particles", 60, "--segments", 2, "--steps-per-segment", 10, "--json", *words]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", [str(word) for word in common])
        run_cli(localize.main)
    with (folder / "out" / "answers.csv").open() as file:
        return list(csv.DictReader(file))


def test_the_command_records_what_answers_csv_says(tmp_path):
    """Each of two segments, and the jump from one to the other that the robot does not notice."""
    path = tmp_path / "new" / "answers.mcap"
    rows = localized(tmp_path, "--kidnap", "--mcap", path)
    told, _ = messages(path)
    assert [f"{at / 1e9:.6f}" for at, _ in told["/amcl_pose"]] == [row["stamp"] for row in rows] and len(rows) == 20
    found = poses_of([(at, message.pose) for at, message in told["/amcl_pose"]])
    columns = [[float(row[name]) for name in ("x", "y", "theta")] for row in rows]
    np.testing.assert_allclose(found, columns, rtol=1e-5, atol=1e-5)  # answers.csv has six digits
    verdicts = [json.loads(message.data) for _, message in told["/verdict"]]
    said = [(verdict["verdict"], f"{verdict['p_lost']:.6g}") for verdict in verdicts]
    assert said == [(row["verdict"], row["p_lost"]) for row in rows]
    assert sum(verdict["kidnapped"] for verdict in verdicts) == 1
    spread = [np.sqrt(message.pose.covariance[[0, 7, 35]]) for _, message in told["/amcl_pose"]]
    columns = [[float(row[name]) for name in ("sd_x", "sd_y", "sd_theta")] for row in rows]
    np.testing.assert_allclose(spread, columns, rtol=1e-5, atol=1e-9)
    assert len(told["/particle_cloud"][0][1].poses) == 60 and len(told["/reference"]) == 20
    np.testing.assert_array_equal(load_map(path).free, tiny_world.grid().free)
    log = load_log(path)
    original = load_log(tmp_path / "drive.log")
    at = np.searchsorted(original.stamps, log.stamps - 1e-6)
    np.testing.assert_array_equal(log.ranges, original.ranges[at])


def test_the_command_refuses_before_it_reads(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(localize, "read", None)
    with pytest.raises(SystemExit) as stop:
        localized(tmp_path, "--mcap", tmp_path / "answers.bag")
    assert stop.value.code == 2 and capsys.readouterr().err.endswith("name a file that ends in .mcap\n")
