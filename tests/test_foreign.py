"""Trajectories of other localizers: read, matched in time, judged like ours; a suite written for them."""

from __future__ import annotations

import json
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest

import tiny_world
from dsom_jax import bench, export, localize, localize_args
from dsom_jax.data import load_log, load_map, load_tum, save_tum
from dsom_jax.data.suite import Suite
from dsom_jax.episode import Episode
from dsom_jax.errors import UserError
from dsom_jax.geometry import relative
from dsom_jax.judging import foreign
from dsom_jax.judging.by_drive import judge_drives
from dsom_jax.judging.drives import carried_over
from dsom_jax.judging.scores import Drive, Outcome, answered
from dsom_jax.lidar import LidarConfig
from dsom_jax.montecarlo import Result

UPDATES, MOVED = 16, 8


def made_suite(drives: int = 2) -> Suite:
    """Drives to and fro in the tiny room with a kidnapping; the scans are made up, 1 s apart."""
    grid, lidar, listed = tiny_world.grid(), LidarConfig(beams=8, angle_increment=np.pi / 4, range_max=4.0), []
    for number in range(drives):
        local = np.stack([2.0 + 0.1 * np.arange(UPDATES), np.full(UPDATES, 2.3), 0.05 * np.arange(UPDATES)], -1)
        local[MOVED:, 0] += 1.0
        poses = np.asarray(grid.from_grid(jnp.asarray(local)))
        moves = np.concatenate([np.zeros((1, 3)), np.asarray(relative(poses[:-1], poses[1:]))])
        moves[MOVED] = 0.0
        ranges = np.random.default_rng(number).uniform(0.5, 3.5, (UPDATES, 8)).astype(np.float32)
        ranges[0, :2] = np.inf
        kidnapped = np.arange(UPDATES) == MOVED
        listed.append(("room", grid, Episode(*map(jnp.asarray, (ranges, moves, poses, kidnapped, np.arange(16.0))))))
    return Suite("made", lidar, (), tuple(listed))


def tum_of(folder, suite, off=(0.0, 0.0), late: float = 0.0) -> None:
    """Trajectories of all drives, off by so many metres before and after the kidnapping."""
    for number, drive in enumerate(foreign.drives_of(suite), start=1):
        poses = np.asarray(drive.episode.poses).copy()
        poses[:MOVED, 1] += off[0]
        poses[MOVED:, 1] += off[1]
        save_tum(folder / f"sequence-{number}.tum", drive.stamps + late, poses)


def test_bench_judges_a_trajectory_as_a_method(tmp_path):
    suite = made_suite()
    tum_of(tmp_path, suite, (0.3, 5.0), late=0.04)
    drives = foreign.drives_of(suite)
    judged = judge_drives([drive.episode for drive in drives], foreign.replies_of_suite(tmp_path, drives))
    entry = bench.foreign(judged, 0)
    first, second = entry["global"], entry["kidnap"]
    assert (first["experiments"], first["converged"], first["steps_median"]) == (2, 1.0, 0)
    assert first["e_pos_m"] == pytest.approx(0.3, abs=1e-5) and second["converged"] == 0
    assert np.isnan(first["confident"]) and entry["ms_per_step"] is None
    data = {"suite": "made", "particles": 1, "methods": {"amcl": entry}}
    assert "| `amcl` | 100.0 [" in bench.report.markdown(data)


def test_several_runs_of_a_drive_lie_in_a_folder(tmp_path):
    suite = made_suite()
    tum_of(tmp_path, suite)
    (tmp_path / "sequence-2").mkdir()
    for run, name in enumerate(("a.tum", "b.tum")):
        (tmp_path / "sequence-2" / name).write_bytes((tmp_path / f"sequence-{run + 1}.tum").read_bytes())
    (tmp_path / "sequence-2.tum").unlink()
    drives = foreign.drives_of(suite)
    assert [g.poses.shape for g in foreign.replies_of_suite(tmp_path, drives)] == [(1, 16, 3), (2, 16, 3)]
    (tmp_path / "sequence-1.tum").unlink()
    with pytest.raises(UserError, match=r"neither sequence-1\.tum"):
        foreign.replies_of_suite(tmp_path, drives)


def test_answers_too_late_or_missing_are_wrong(tmp_path):
    (drive,) = foreign.drives_of(made_suite(1))
    save_tum(tmp_path / "a.tum", drive.stamps[::2], np.asarray(drive.episode.poses)[::2])
    (given,) = foreign.replies_of(tmp_path / "a.tum", [drive])
    # 2 s between poses are too far to be bridged.
    assert (np.isnan(given.poses[0]).any(-1) == (np.arange(UPDATES) % 2 == 1)).all()
    save_tum(tmp_path / "b.tum", drive.stamps + 500, np.asarray(drive.episode.poses))
    with pytest.raises(UserError, match="both must use the same clock"):
        foreign.replies_of(tmp_path / "b.tum", [drive])


@pytest.mark.parametrize("words", [("amcl",), ("=x.tum",), ("amcl=",), ("amcl=nowhere.tum",), ("a={0}", "a={0}")])
def test_external_needs_a_name_and_a_file(words, tmp_path):
    (tmp_path / "x.tum").touch()
    with pytest.raises(UserError, match=r"--external .*NAME=FILE"):
        foreign.named([word.format(tmp_path / "x.tum") for word in words], "FILE.tum")


def test_localize_holds_all_against_both_references(tmp_path):
    """Our own answers are right in the map and 3 m off on the plan; those of the other system the other way round."""
    suite = made_suite()
    drives = [Drive(d.episode, d.stamps + 100 * n) for n, d in enumerate(foreign.drives_of(suite))]
    stamps = np.concatenate([d.stamps for d in drives])
    shifted = np.concatenate([np.asarray(d.episode.poses) for d in drives]) + np.array([0.0, 3.0, 0.0])
    save_tum(tmp_path / "plan.tum", stamps, shifted)
    outcomes = []
    for d in drives:
        poses = np.asarray(d.episode.poses)[None]
        sure, localized = np.full((1, UPDATES), 0.01), np.zeros((1, UPDATES), np.int8)
        info = SimpleNamespace(mean=poses, cluster=poses, lost=sure, p_lost=sure, verdict=localized)
        outcomes.append(Outcome(d, Result(info, None, None), 1.0))
    args = localize_args.LocalizeArgs(map=tmp_path, log=tmp_path, out=tmp_path)
    on_plan = carried_over(drives, tmp_path / "plan.tum")
    others = {"amcl": foreign.replies_of(tmp_path / "plan.tum", drives)}
    found = localize.summary_of(outcomes, answered(outcomes, args.method), tiny_world.grid(), args, on_plan, others)
    theirs = found["external"]["amcl"]
    assert found["converged"] == found["kidnap"]["converged"] == theirs["on_plan"]["converged"] == 1
    assert found["on_plan"]["converged"] == theirs["converged"] == 0
    assert set(found["on_plan"]) <= set(found) and found["right_room"] == 1
    assert carried_over(drives, None) is None


def test_an_exported_suite_is_read_back(tmp_path):
    suite = made_suite()
    export.write_suite(suite, tmp_path)
    listed = json.loads((tmp_path / "suite.json").read_text())["sequences"]
    assert [entry["kidnapped_at"] for entry in listed] == [[foreign.START + MOVED]] * 2
    grid = load_map(tmp_path / listed[0]["map"])
    np.testing.assert_array_equal(grid.occupied, suite.episodes[0][1].occupied)
    log = load_log(tmp_path / listed[1]["bag"])
    episode = suite.episodes[1][2]
    np.testing.assert_allclose(log.ranges, episode.ranges, atol=1e-6)
    np.testing.assert_allclose(log.stamps, foreign.stamps_of(episode), atol=1e-6)
    # Increments in the body frame are those of the drive, the carrying away is not among them.
    moves = np.asarray(relative(jnp.asarray(log.odometry[:-1]), jnp.asarray(log.odometry[1:])))
    np.testing.assert_allclose(moves, episode.odometry[1:], atol=1e-5)
    reference = load_tum(tmp_path / listed[1]["reference"])
    np.testing.assert_allclose(reference.poses, episode.poses, atol=1e-5)
