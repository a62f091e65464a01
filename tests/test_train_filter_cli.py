"""``python -m dsom_jax.train_filter``: it resumes bit for bit, and bad input is one line."""

from __future__ import annotations

import json
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import yaml
from flax import nnx

import dsom_jax
import tiny_world
from dsom_jax import checkpoint, train_filter
from dsom_jax.errors import UserError, run_cli
from dsom_jax.judging import tracking
from dsom_jax.nn import create_pfrnn
from dsom_jax.run_folder import FilterRun, create_run
from dsom_jax.train_filter import TrainFilterArgs
from dsom_jax.trainer import first_state, open_run
from dsom_jax.training.filter_loop import init_filter_state
from dsom_jax.training.sequences import Window
from learned_kit import training

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def files(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("train_filter")
    dsom_jax.save_ros_map(tiny_world.grid(), folder / "map.yaml")
    config = {
        "model": {"view": {"cells": 8, "map_resolution": 0.25, "beams": 32, "reach_min": 5.0}, "width": 4,
                  "features": 4, "hidden": 4},
        "data": {"lidar": {"beams": 32, "angle_increment": 2 * np.pi / 32, "range_max": 5.0}, "beam_step": 1,
                 "drives": 2, "length": 6, "window": 3, "obstacles": 0, "removed": 0,
                 "drive": {"update_min_d": 0.2}},
        "batch": 2, "particles": 6,
    }  # fmt: skip
    (folder / "tiny.yaml").write_text(yaml.safe_dump(config))
    return folder


def command(files: Path, monkeypatch, out: str, *words: str) -> None:
    given = ("--filter", "pfrnn", "--config", str(files / "tiny.yaml"), "--maps", str(files / "map.yaml"))
    rest = ("--steps", "4", "--save-steps", "2", "--out", str(files / out), *words)
    monkeypatch.setattr(sys, "argv", ["train_filter", *given, *rest])
    run_cli(train_filter.main)


def weights(folder: Path) -> bytes:
    return b"".join(np.asarray(x).tobytes() for x in jax.tree.leaves(checkpoint.load(folder, kind="pfrnn")))


def test_a_run_that_lost_its_end_resumes_bit_for_bit(files, monkeypatch):
    made, parts = [], train_filter.filter_parts

    def compiled_once(run, material):
        made.append(made[0] if made else parts(run, material))
        return made[0]._replace(state=first_state(run, init_filter_state(run.config, material.network)))

    def blank_windows(key, pool, config, resolution, count, strays):
        """Robots that stand at the start of their paths and see nothing: no scans to compile."""
        poses = jnp.broadcast_to(pool.poses[:count, :1], (count, config.window, 3))
        blank = jnp.full((count, config.window, config.lidar.beams), jnp.inf)
        return Window(pool.where[:count], blank, jnp.zeros_like(poses), poses, jnp.zeros((count, strays, 3)))

    monkeypatch.setattr(train_filter, "filter_parts", compiled_once)
    monkeypatch.setattr(tracking, "make_windows", blank_windows)
    command(files, monkeypatch, "run")
    whole, log = weights(files / "run"), (files / "run" / "metrics.jsonl").read_text()
    record = json.loads((files / "run" / "provenance.json").read_text())
    assert (record["kind"], record["steps"], record["data"]) == ("pfrnn", 4, ["map.yaml"])
    assert record["samples"] == 4 * 2 * 3
    assert record["metrics"]["sequences"] == 32 and record["metrics"]["updates"] == 6
    # As if it had been killed after the third step: the last state is of the second.
    shutil.rmtree(files / "run" / "state-00000004")
    command(files, monkeypatch, "run", "--resume")
    assert weights(files / "run") == whole
    numbers = [{k: v for k, v in json.loads(line).items() if k != "seconds"} for line in log.splitlines()]
    again = (files / "run" / "metrics.jsonl").read_text().splitlines()
    assert [{k: v for k, v in json.loads(line).items() if k != "seconds"} for line in again] == numbers


def test_a_run_begins_with_the_weights_that_are_named(files, capsys):
    begin = files / "begin"
    given = TrainFilterArgs("pfrnn", files / "tiny.yaml", (files / "map.yaml",), out=files / "more", resume=True)
    config = given.read_config(yaml.safe_load((files / "tiny.yaml").read_text()), "tiny.yaml")
    network = create_pfrnn(config.model, 7)
    checkpoint.save(begin, network, {})
    run, material = open_run(replace(given, init=begin))
    state = first_state(run, init_filter_state(run.config, material.network))
    for part in (state.params, state.average):
        chex.assert_trees_all_equal(part, nnx.as_pure(nnx.split(network)[1]))
    with pytest.raises(UserError, match="give --init, too"):
        open_run(given)
    with pytest.raises(UserError, match="began with begin"):
        open_run(replace(given, init=files))
    run.save(state, {})
    assert open_run(replace(given, init=begin))[1].network is None
    assert "not read, the run goes on" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--steps", "0"), "--steps 0"),
        (("--filter", "magic"), "filter"),
        (("--maps", "nowhere.yaml"), "nowhere.yaml"),
        (("--config", "nowhere.yaml"), "nowhere.yaml"),
        (("--init", "nowhere"), "nowhere"),
        (("--init", str(ROOT / "checkpoints" / "dsom")), "a pfrnn is needed"),
        (("--init", str(ROOT / "checkpoints" / "pfrnn")), "cells = 16, the run's is 8"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(files, monkeypatch, capsys, words, message):
    with pytest.raises(SystemExit) as stop:
        command(files, monkeypatch, "never", *words)
    error = capsys.readouterr().err
    assert stop.value.code == 2 and error.count("\n") == 1 and message in error
    assert not (files / "never").exists()


@pytest.mark.parametrize(
    ("text", "message"),
    [("colour: 1", "unknown field colour"), ("data: {window: 1}", "window = 1"), ("strays: 2.0", "strays"),
     ("model: {hidden: 3}", "unknown field hidden"), ("batch: 0", "batch"), ("start_xy: [2.0, 1.0]", "start_xy")],
)  # fmt: skip
def test_bad_configurations(tmp_path, text, message):
    with pytest.raises(UserError, match=message):
        TrainFilterArgs("pf_net").read_config(yaml.safe_load(text), "c.yaml")


def test_scans_that_the_network_would_refuse_are_not_trained_on(files, tmp_path):
    config = yaml.safe_load((files / "tiny.yaml").read_text())
    config["data"]["lidar"] |= {"beams": 16, "angle_min": -1.5}
    (tmp_path / "half.yaml").write_text(yaml.safe_dump(config))
    given = TrainFilterArgs("pfrnn", tmp_path / "half.yaml", (files / "map.yaml",), out=tmp_path / "never")
    with pytest.raises(UserError, match=r"half.yaml: data.lidar: field of view 180 deg, trained for 360"):
        open_run(given)
    assert not given.folder.exists()


def test_a_run_of_another_filter_is_not_resumed(tmp_path):
    create_run(FilterRun(tmp_path, training("pfrnn"), (), 3))
    with pytest.raises(UserError, match="unknown field"):
        open_run(TrainFilterArgs("pf_net", out=tmp_path, resume=True))
    with pytest.raises(UserError, match="not empty"):
        open_run(TrainFilterArgs("pfrnn", out=tmp_path))
    with pytest.raises(UserError, match="--steps 5"):
        open_run(TrainFilterArgs("pfrnn", out=tmp_path, resume=True, steps=5))
