"""``python -m dsom_jax.train``: killed at random it ends with the numbers of an uninterrupted run; clear errors."""

from __future__ import annotations

import json
import os
import random
import subprocess
import sys
import time
from pathlib import Path

import jax
import numpy as np
import pytest

from dsom_jax import checkpoint
from dsom_jax.errors import UserError
from dsom_jax.run_folder import read_fields
from dsom_jax.train import TrainArgs
from dsom_jax.trainer import open_run

CONFIG = """
model: {width: 2, headings: 4}
scan: {beams: 24, obstacles: [0, 0]}
early: {cells: 32, worlds: 1, scans: 2}
late: {cells: 32, worlds: 1, scans: 2}
warmup: 3
"""


@pytest.fixture(scope="module")
def files(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("train")
    cells = np.full((40, 40), 254, np.uint8)
    cells[[0, -1]] = cells[:, [0, -1]] = cells[10, 5:20] = 0
    (folder / "map.pgm").write_bytes(b"P5\n40 40\n255\n" + cells.tobytes())
    (folder / "map.yaml").write_text(
        "image: map.pgm\nresolution: 0.25\norigin: [0.0, 0.0, 0.0]\n"
        "negate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"
    )
    (folder / "tiny.yaml").write_text(CONFIG)
    return folder


def start(files: Path, out: str, *more: str) -> subprocess.Popen:
    command = [sys.executable, "-m", "dsom_jax.train", "--config", "tiny.yaml", "--maps", "map.yaml", "--out", out]
    cache = {"JAX_COMPILATION_CACHE_DIR": str(files / "cache"), "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"}
    return subprocess.Popen(
        [*command, "--steps", "14", "--save-steps", "3", *more],
        cwd=files,
        env={**os.environ, **cache},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def numbers(folder: Path) -> list[dict[str, float]]:
    lines = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    return [{k: v for k, v in line.items() if k != "seconds"} for line in lines]


def weights(folder: Path) -> bytes:
    return b"".join(np.asarray(x).tobytes() for x in jax.tree.leaves(checkpoint.load(folder)))


def kill_after_lines(process: subprocess.Popen, log: Path, lines: int) -> None:
    """Kill -9 as soon as the log has so many lines, at whatever the process then does."""
    while process.poll() is None:
        if log.exists() and len(log.read_bytes().splitlines()) >= lines:
            time.sleep(random.Random(lines).uniform(0, 0.05))
            process.kill()
        time.sleep(0.005)
    process.communicate()


@pytest.mark.slow
def test_killed_run_ends_like_an_uninterrupted_one(files):
    whole = start(files, "whole")
    assert whole.wait() == 0, whole.communicate()[1]
    for lines in (4, 10):
        kill_after_lines(start(files, "killed", "--resume"), files / "killed" / "metrics.jsonl", lines)
    last = start(files, "killed", "--resume")
    assert last.wait() == 0, last.communicate()[1]
    assert numbers(files / "killed") == numbers(files / "whole")
    assert [line["step"] for line in numbers(files / "whole")] == list(range(1, 15))
    assert weights(files / "killed") == weights(files / "whole")
    record = json.loads((files / "whole" / "provenance.json").read_text())
    assert record["steps"] == 14 and record["data"] == ["map.yaml"] and "mass_median" in record["metrics"]


def test_bad_input_is_one_line_and_exit_code_2(files):
    process = start(files, "never", "--init", "nowhere")
    _, errors = process.communicate()
    assert process.returncode == 2
    assert errors.count("error:") == 1 and "nowhere/provenance.json" in errors and "Traceback" not in errors
    assert not (files / "never").exists()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("colour: 1", "unknown field colour"),
        ("model: {width: wide}", "model: width: expected a whole number"),
        ("early: {cells: 12}", "multiple of 8"),
        ("- 1", "holds no fields"),
        ("a: [", "not valid YAML at line 2"),
    ],
)
def test_bad_configurations(tmp_path, text, message):
    (tmp_path / "c.yaml").write_text(text)
    with pytest.raises(UserError, match=message):
        TrainArgs().read_config(read_fields(tmp_path / "c.yaml"), "c.yaml")


def test_bad_arguments(tmp_path):
    with pytest.raises(UserError, match="--steps 0"):
        TrainArgs(steps=0)
    with pytest.raises(UserError, match="--minutes"):
        TrainArgs(minutes=0.0)
    (tmp_path / "x").write_text("")
    with pytest.raises(UserError, match="not empty"):
        open_run(TrainArgs(out=tmp_path))
    with pytest.raises(UserError, match="cannot write"):
        open_run(TrainArgs(out=tmp_path / "x" / "y"))
    (tmp_path / "run.json").write_text("{}")
    with pytest.raises(UserError, match="no run to resume"):
        open_run(TrainArgs(out=tmp_path, resume=True))
