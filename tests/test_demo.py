"""The demo: a bag that reads back as what was driven, and a page that knows of the kidnapping."""

from __future__ import annotations

import json
import re
import sys
from dataclasses import replace

import numpy as np
import pytest

import tiny_world
from dsom_jax import cache, cli, demo, localize
from dsom_jax.data import RawLog, load_bag
from dsom_jax.data.bag_writer import odometry_at_rate, write_bag
from dsom_jax.errors import run_cli
from dsom_jax.judging.drives import marked
from dsom_jax.judging.scores import Drive
from dsom_jax.lidar import LidarConfig
from dsom_jax.simulate.drive import DriveConfig


def log():
    """Ten scans a second apart, turning over the wrap of the heading."""
    t = np.arange(10)
    lidar = LidarConfig(8, -1.0, 0.25, range_min=0.1, range_max=8.0, mount=(0.2, 0.1, 0.5))
    ranges = np.tile(np.float32([0.5, 1, 2, 3, 4, 5, 6, np.inf]), (10, 1)) + np.float32(0.01) * t[:, None]
    poses = np.stack([0.3 * t, 0.1 * t, (2.6 + 0.2 * t + np.pi) % (2 * np.pi) - np.pi], -1)
    return RawLog(ranges.astype(np.float32), poses, 1_700_000_000.25 + t, lidar)


def test_a_written_bag_reads_back(tmp_path):
    wrote = log()
    write_bag(tmp_path / "drive", wrote)
    write_bag(tmp_path / "drive", wrote)  # in place of the first
    read = load_bag(tmp_path / "drive")
    np.testing.assert_array_equal(read.ranges, wrote.ranges)
    np.testing.assert_allclose(read.stamps, wrote.stamps, atol=1e-6)
    np.testing.assert_allclose(read.odometry, wrote.odometry, atol=1e-6)
    assert read.lidar.beams == 8 and read.lidar.mount == pytest.approx(wrote.lidar.mount)
    assert not read.report.counts and [p.name for p in tmp_path.iterdir()] == ["drive"]


def test_odometry_between_scans_takes_the_short_way():
    stamps, poses = odometry_at_rate(np.array([0.0, 1.0]), np.array([[0.0, 0, 3.1], [1.0, 0, -3.1]]), 0.25)
    np.testing.assert_allclose(stamps, [0, 0.25, 0.5, 0.75, 1])
    np.testing.assert_allclose(np.abs(poses[:, 2]), [3.1, 3.1208, 3.14159, 3.1208, 3.1], atol=1e-4)


def test_marks_of_a_kidnapping():
    drive = Drive(tiny_world.drive(10), 100.0 + np.arange(10))
    assert np.flatnonzero(marked(drive, (104.0,)).episode.kidnapped).tolist() == [4]
    # Before the drive, at its start or after it there is nothing to mark.
    assert not np.asarray(marked(drive, (99.0, 100.0, 200.0)).episode.kidnapped).any()
    assert marked(drive, ()) is drive


@pytest.fixture
def small(monkeypatch):
    """The demo in the tiny room, without its building."""
    config = DriveConfig((8, 8), 0.2, 0.25, 1.5, 1, 0, lidar=replace(tiny_world.LIDAR, range_min=0.05))
    monkeypatch.setattr(demo, "make_world", lambda key, building: tiny_world.grid())
    make = demo.make
    monkeypatch.setattr(demo, "make", lambda folder, seed: make(folder, seed, demo.BUILDING, config))
    monkeypatch.setattr(demo.webbrowser, "open", lambda address: pytest.fail("opened"))


def test_under_json_nothing_else_is_on_stdout(tmp_path, monkeypatch, capsys):
    """Not even that the page is open, which is told where people look."""
    scene = demo.DemoFiles(tmp_path / "m.yaml", tmp_path / "log", tmp_path / "truth.tum", (1.0,))
    monkeypatch.setattr(demo, "make", lambda folder, seed: scene)
    monkeypatch.setattr(localize, "answer", lambda words, carried: {"carried": carried})
    opened = []
    monkeypatch.setattr(demo.webbrowser, "open", lambda address: not opened.append(address))
    monkeypatch.setattr(sys, "argv", ["demo", "--out", str(tmp_path), "--json"])
    run_cli(demo.main)
    printed = capsys.readouterr()
    assert json.loads(printed.out) == {"carried": [1.0]} and "open in your browser" in printed.err
    assert opened == [(tmp_path / "report.html").resolve().as_uri()]


@pytest.mark.slow
def test_demo(small, tmp_path, monkeypatch, capsys):
    words = ["demo", "--out", str(tmp_path), "--no-open", "--runs", "2", "--json"]
    monkeypatch.setattr(sys, "argv", words)
    run_cli(demo.main)
    summary = json.loads(capsys.readouterr().out)
    assert summary["kidnap"]["experiments"] == 2 and summary == json.loads((tmp_path / "summary.json").read_text())
    (data,) = re.findall(r'id="story">(.*?)</script>', (tmp_path / "report.html").read_text())
    (drive,) = json.loads(data)["drives"]
    assert len(drive["kidnapped"]) == 1 and "kidnapping" in {moment["kind"] for moment in drive["moments"]}


def test_where_compiled_things_are_kept(tmp_path, monkeypatch):
    told = {}
    monkeypatch.setattr(cache.jax.config, "update", told.__setitem__)
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", "elsewhere")
    cache.keep_compiled()
    assert not told
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(cache.sys, "platform", "linux")
    cache.keep_compiled()
    assert told["jax_compilation_cache_dir"] == str(tmp_path / "dsom_jax" / "jax") and (tmp_path / "dsom_jax").is_dir()
    # A place that cannot be written to is none.
    told.clear()
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    cache.keep_compiled()
    assert not told


def test_progress_gives_every_item_once(capsys):
    assert list(cli.each(["a", "b", "c"], "segments")) == ["a", "b", "c"]
    with cli.stage("reading"):
        pass
    assert capsys.readouterr().out == ""
