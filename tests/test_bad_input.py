"""Bad input of every kind ends each command with one line that names the file, the field and the fix, and exit code 2.

The readers have tests of their own for every malformed field; here the commands are held against one of each kind:
no traceback, and nothing written.
"""

from __future__ import annotations

import importlib
import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from dsom_jax import bench, checkpoint, evaluate, localize, train, train_filter
from dsom_jax.data import save_tum
from dsom_jax.errors import UserError, run_cli
from dsom_jax.nn import DSOMConfig, create
from tiny_log import META, UPDATES, record, write_log

PGM = b"P5\n4 4\n255\n"
SHAPE = (UPDATES, 32)


@pytest.fixture(scope="module")
def original(tmp_path_factory):
    """A good recording, and a good checkpoint for whole turns of at least 10 m."""
    folder = tmp_path_factory.mktemp("good")
    checkpoint.save(folder / "net", create(DSOMConfig(width=2, headings=4)))
    return record(folder)


@pytest.fixture
def good(original, tmp_path):
    """A copy that may be spoilt."""
    for name in ("room.yaml", "room.pgm", "drive.log", "meta.yaml", "truth.tum"):
        (tmp_path / name).write_bytes((original.map.parent / name).read_bytes())
    (tmp_path / "net").symlink_to(original.map.parent / "net")
    return original


@pytest.fixture
def refused(tmp_path, monkeypatch, capfd):
    """Calls a command inside of ``tmp_path``, and returns its error line."""

    def call(main: Callable[[], None], *words: str) -> str:
        monkeypatch.chdir(tmp_path)
        monkeypatch.setattr(sys, "argv", ["command", *words])
        before = snapshot(tmp_path)
        capfd.readouterr()
        with pytest.raises(SystemExit) as stop:
            run_cli(main)
        shown = capfd.readouterr()
        assert stop.value.code == 2 and snapshot(tmp_path) == before
        assert shown.err.startswith("error: ") and shown.err.count("\n") == 1 and "Traceback" not in shown.out
        return shown.err

    return call


def snapshot(folder: Path) -> dict[Path, bytes | None]:
    """Everything in a folder."""
    return {path: path.read_bytes() if path.is_file() else None for path in sorted(folder.rglob("*"))}


def replaced(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))


def no_free_space(folder: Path) -> None:
    (folder / "room.pgm").write_bytes(PGM + bytes(16))


def gzip_cut_short(folder: Path) -> None:
    (folder / "drive.log").write_bytes(b"\x1f\x8b\x08 broken")


LOCALIZE = ("--map", "room.yaml", "--log", "drive.log", "--out", "out", "--runs", "2", "--particles", "10")
LOCALIZE += ("--segments", "2", "--steps-per-segment", "20")
FILES = {
    "no map": (lambda d: (d / "room.yaml").unlink(), ["room.yaml", "no such map yaml"]),
    "map is no yaml": (lambda d: (d / "room.yaml").write_text("a: [1"), ["room.yaml", "not valid YAML"]),
    "map is a picture": (lambda d: (d / "room.yaml").write_bytes(PGM + bytes(range(240, 256))), ["room.yaml"]),
    "no resolution": (lambda d: replaced(d / "room.yaml", "resolution", "scale"), ["room.yaml", "'resolution'"]),
    "a resolution of nothing": (
        lambda d: replaced(d / "room.yaml", "resolution: 0.25", "resolution: 1e-9"),
        ["room.yaml", "resolution = 1e-09", "0.001 to 10"],
    ),
    "origin": (
        lambda d: replaced(d / "room.yaml", "origin: [", "origin: [x, "),
        ["room.yaml", "[x, y, yaw]"],
    ),
    "no image": (lambda d: (d / "room.pgm").unlink(), ["room.pgm", "'image'"]),
    "cut image": (lambda d: (d / "room.pgm").write_bytes(PGM + b"abc"), ["room.pgm"]),
    "no free space": (no_free_space, ["room.yaml", "no free cell", "negate"]),
    "no log": (lambda d: (d / "drive.log").unlink(), ["drive.log", "no such log"]),
    "log of words": (lambda d: (d / "drive.log").write_text("to be or\nnot to be\n"), ["drive.log", "FLASER"]),
    "empty log": (lambda d: (d / "drive.log").write_text(""), ["drive.log", "FLASER"]),
    "broken gzip": (gzip_cut_short, ["drive.log", "gzip"]),
    "wrong lidar": (lambda d: replaced(d / "meta.yaml", "beams: 32", "beams: 31"), ["meta.yaml", "wrong lidar"]),
    "degrees": (lambda d: replaced(d / "meta.yaml", "increment: 0.", "increment: 11."), ["drive.log", "radians"]),
    "mount": (lambda d: (d / "meta.yaml").write_text(META + "mount: front\n"), ["meta.yaml", "mount", "[x, y, yaw]"]),
    "all NaN": (lambda d: write_log(d, np.full(SHAPE, np.nan)), ["drive.log", "NaN"]),
    "all zero": (lambda d: write_log(d, np.zeros(SHAPE)), ["drive.log", "zero"]),
    "beyond the limit": (lambda d: write_log(d, np.full(SHAPE, 60.0)), ["drive.log", "5 m", "range_max"]),
    "standing still": (lambda d: stand_still(d), ["drive.log", "never moves", "--odom-topic"]),
}


def stand_still(folder: Path) -> None:
    """The same scan again and again, under different stamps."""
    first = (folder / "drive.log").read_text().splitlines()[0].split()
    lines = [" ".join([*first[:-3], str(1000.0 + n), *first[-2:]]) for n in range(UPDATES)]
    (folder / "drive.log").write_text("\n".join(lines) + "\n")


@pytest.mark.parametrize("kind", FILES)
def test_localize_with_spoilt_files(good, refused, tmp_path, kind):
    spoil, fragments = FILES[kind]
    spoil(tmp_path)
    error = refused(localize.main, *LOCALIZE)
    assert all(fragment in error for fragment in fragments), error


@pytest.mark.parametrize(
    ("words", "fragments"),
    [
        (("--particles", "0"), ["--particles 0", "positive"]),
        (("--runs", "-1"), ["--runs -1"]),
        (("--segments", "0"), ["--segments 0"]),
        (("--max-beams", "0"), ["--max-beams 0"]),
        (("--seed", "-1"), ["--seed -1"]),
        (("--t-cut", "1"), ["--t-cut 1.0", "0.6"]),
        (("--steps-per-segment", "3"), ["--steps-per-segment 3", "at least 6"]),
        (("--steps-per-segment", "0", "--segments", "8"), ["drive.log", "5 updates", "fewer --segments"]),
        (("--update-min-d", "-1"), ["--update-min-d -1.0"]),
        (("--update-min-a", "nan"), ["--update-min-a nan"]),
        (("--laser-max-range", "nan"), ["--laser-max-range nan"]),
        (("--laser-max-range", "0.01"), ["--laser-max-range 0.01", "drive.log"]),
        (("--kidnap", "--segments", "1"), ["--segments 1", "--kidnap"]),
        (("--reference", "nowhere.tum"), ["nowhere.tum", "no such trajectory"]),
        (("--reference", "room.yaml"), ["room.yaml", "line 1", "stamp x y z"]),
        (("--reference", "early.tum"), ["early.tum", "same clock"]),
        (("--log", "drive.txt"), ["drive.txt", "'.txt'", "CARMEN"]),
        (("--log", "drive.bag"), ["drive.bag"]),
        (("--proposal", "dsom", "--checkpoint", "nowhere"), ["nowhere/provenance.json", "dsom_jax.train"]),
        (("--proposal", "dsom", "--checkpoint", "broken"), ["broken/provenance.json", "not JSON"]),
        (("--proposal", "dsom", "--checkpoint", "empty"), ["empty/provenance.json", "format"]),
        (("--proposal", "dsom", "--checkpoint", "net"), ["net", "does not fit the lidar", "range_max 5 m"]),
        (("--particles", "100000000000"), ["--particles 100000000000", "at most 1000000"]),
        (("--seed", "4294967296"), ["--seed 4294967296", "at most"]),
        (("--checkpoint", "net"), ["--checkpoint net", "no use with --proposal likelihood_grid", "leave it out"]),
        (("--proposal", "dsom", "--method", "mcl", "--checkpoint", "net"), ["--checkpoint net", "--method mcl"]),
        (("--out", "room.yaml"), ["--out room.yaml", "cannot write"]),
        (("--out", "room.yaml/deeper"), ["--out room.yaml/deeper", "cannot write"]),
    ],
    ids=lambda part: " ".join(part) if isinstance(part, tuple) else "",
)
def test_localize_with_wrong_words(good, refused, tmp_path, words, fragments):
    save_tum(tmp_path / "early.tum", np.arange(3.0), np.zeros((3, 3)))
    (tmp_path / "drive.txt").write_text("")
    (tmp_path / "drive.bag").write_bytes(b"#ROSBAG V2.0\nnot really")
    for name, text in (("broken", "{"), ("empty", "{}")):
        (tmp_path / name).mkdir()
        (tmp_path / name / "provenance.json").write_text(text)
    error = refused(localize.main, *LOCALIZE, *words)
    assert all(fragment in error for fragment in fragments), error


@pytest.mark.parametrize("proposal", ["dsom", "hybrid"])
def test_a_network_is_needed_where_none_is_shipped(good, refused, monkeypatch, proposal):
    monkeypatch.setattr(checkpoint, "shipped", lambda: None)
    assert "--checkpoint" in refused(localize.main, *LOCALIZE, "--proposal", proposal)


def test_a_checkpoint_whose_weights_are_of_another_configuration(good, refused, tmp_path):
    for name, width in (("small", 2), ("big", 3)):
        checkpoint.save(tmp_path / name, create(DSOMConfig(width=width, headings=4, reach_min=1.0)))
    record_path = tmp_path / "small" / "provenance.json"
    described = json.loads(record_path.read_text())
    record_path.write_text(json.dumps({**described, "model": {**described["model"], "width": 3}}))
    error = refused(localize.main, *LOCALIZE, "--proposal", "dsom", "--checkpoint", "small")
    assert "small/weights" in error and "another configuration" in error
    for part in (tmp_path / "big").rglob("*"):
        if part.is_file() and part.name != "provenance.json":
            part.write_bytes(part.read_bytes()[: part.stat().st_size // 2])
    error = refused(localize.main, *LOCALIZE, "--proposal", "dsom", "--checkpoint", "big")
    assert "big/weights" in error and "damaged" in error


@pytest.mark.parametrize(
    ("text", "fragments"),
    [
        (None, ["suite.toml", "no such suite file"]),
        ("a = [", ["suite.toml", "not valid TOML"]),
        ("name = 'x'", ["suite.toml", "[[episodes]]"]),
        ("[[episodes]]\nmap = 'nowhere.yaml'", ["nowhere.yaml", "no such map yaml"]),
        ("[[episodes]]\nmap = 'room.yaml'\nspeed = 3", ["suite.toml", "episodes[0]", "'speed'"]),
        ("[lidar]\nbeams = 0\n[[episodes]]\nmap = 'room.yaml'", ["suite.toml", "lidar", "beams"]),
    ],
)
def test_bench_with_spoilt_suites(good, refused, tmp_path, text, fragments):
    if text is not None:
        (tmp_path / "suite.toml").write_text(text)
    error = refused(bench.main, "--suite", "suite.toml", "--out", "out")
    assert all(fragment in error for fragment in fragments), error


@pytest.mark.parametrize(("folder", "fragment"), [("nowhere", "no such file"), ("far", "range_max 10 m")])
def test_bench_with_a_checkpoint_that_does_not_fit(refused, tmp_path, folder, fragment):
    checkpoint.save(tmp_path / "far", create(DSOMConfig(width=2, headings=4, reach_min=12.0)))
    error = refused(bench.main, "--methods", "adam_dsom", "--checkpoint", folder, "--out", "out")
    assert folder in error and fragment in error


def test_bench_with_a_checkpoint_that_no_method_draws_from(refused):
    error = refused(bench.main, "--methods", "mcl,adam_likelihood_grid", "--checkpoint", "net", "--out", "out")
    assert "--checkpoint net" in error and "no use" in error and "adam_dsom" in error


COMMANDS = ("localize", "bench", "train", "train_filter", "evaluate")


@pytest.mark.parametrize("command", COMMANDS)
def test_words_that_no_command_knows(refused, command):
    main = importlib.import_module(f"dsom_jax.{command}").main
    error = refused(main, "--colour", "blue")
    assert f"python -m dsom_jax.{command} --help" in error and ("--colour" in error or "Missing" in error)


@pytest.mark.parametrize(
    ("words", "fragments"),
    [
        ((), ["--map", "--log", "--out", "Missing"]),
        ((*LOCALIZE, "--runs", "abc"), ["--runs", "abc"]),
        ((*LOCALIZE, "--runs"), ["--runs"]),
        ((*LOCALIZE, "--method", "magic"), ["--method", "'magic'", "adam_robust"]),
        ((*LOCALIZE, "--particels", "5"), ["--particels", "Perhaps you meant", "--particles INT"]),
        ((*LOCALIZE, "extra"), ["Unrecognized options: extra"]),
    ],
)
def test_words_that_cannot_be_read(refused, words, fragments):
    error = refused(localize.main, *words)
    assert all(fragment in error for fragment in fragments), error


@pytest.mark.parametrize("main", [bench.main, train.main, train_filter.main, localize.main, evaluate.main])
def test_help_is_no_error(main, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["command", "--help"])
    with pytest.raises(SystemExit) as stop:
        run_cli(main)
    assert not stop.value.code and "--out" in capsys.readouterr().out


TRAIN = ("--config", "tiny.yaml", "--steps", "2", "--out", "out")


@pytest.mark.parametrize(
    ("words", "fragments"),
    [
        (("--config", "nowhere.yaml"), ["nowhere.yaml", "no such configuration"]),
        (("--config", "room.pgm"), ["room.pgm", "UTF-8"]),
        (("--config", "nan.yaml"), ["nan.yaml", "learning_rate = nan"]),
        (("--config", "pair.yaml"), ["pair.yaml", "scan: obstacles", "expected 2 values"]),
        (("--maps", "nowhere.yaml"), ["nowhere.yaml", "no such map yaml"]),
        (("--init", "net"), ["net", "field model", "width = 2, the run's is 32"]),
        (("--save-steps", "0"), ["--save-steps 0"]),
        (("--save-minutes", "nan"), ["--save-minutes nan"]),
        (("--out", "room.yaml"), ["--out room.yaml", "is a file"]),
        (("--out", "room.yaml/deeper"), ["room.yaml/deeper", "cannot write"]),
    ],
    ids=lambda part: " ".join(part) if isinstance(part, tuple) else "",
)
def test_train_with_wrong_words(good, refused, tmp_path, words, fragments):
    for name, text in (("tiny", "warmup: 3"), ("nan", "learning_rate: .nan"), ("pair", "scan: {obstacles: [1]}")):
        (tmp_path / f"{name}.yaml").write_text(text)
    error = refused(train.main, *TRAIN, *words)
    assert all(fragment in error for fragment in fragments), error


def test_a_run_is_resumed_on_its_own_maps(good, refused, tmp_path):
    facts = {"config": {}, "maps": ["a.yaml"], "total": 2, "seconds": 0.0}
    (tmp_path / "old").mkdir()
    (tmp_path / "old" / "run.json").write_text(json.dumps(facts))
    error = refused(train.main, "--resume", "--out", "old", "--maps", "room.yaml")
    assert "--maps" in error and "a.yaml" in error and "resume without --maps" in error


def test_evaluate_writes_nothing_for_a_map_that_is_none(good, refused):
    error = refused(evaluate.main, "--checkpoint", "net", "--maps", "nowhere.yaml", "--out", "out")
    assert "nowhere.yaml" in error


@pytest.mark.parametrize("error", [MemoryError("99 GB"), RuntimeError("INTERNAL: Out of memory allocating 9 bytes.")])
def test_too_much_asked_of_the_memory(error, capsys):
    def main() -> None:
        raise error

    with pytest.raises(SystemExit) as stop:
        run_cli(main)
    shown = capsys.readouterr().err
    assert stop.value.code == 2 and shown.startswith("error: out of memory") and shown.count("\n") == 1


def test_other_faults_are_not_hidden():
    def main() -> None:
        raise RuntimeError("a fault of ours")

    with pytest.raises(RuntimeError, match="of ours"):
        run_cli(main)


def test_a_terminal_that_knows_ascii_only(tmp_path):
    command = [sys.executable, "-m", "dsom_jax.localize", "--map", "a", "--log", "b", "--out", "c", "--runs", "1.5"]
    plain = {**os.environ, "PYTHONIOENCODING": "ascii"}
    done = subprocess.run(command, cwd=tmp_path, env=plain, capture_output=True, text=True, timeout=300)
    assert done.returncode == 2 and "--runs" in done.stderr and "1.5" in done.stderr and "---" not in done.stderr


def test_errors_of_several_lines_become_one(capsys):
    def main() -> None:
        raise UserError("a.yaml: first\n   second")

    with pytest.raises(SystemExit) as stop:
        run_cli(main)
    assert stop.value.code == 2 and capsys.readouterr().err == "error: a.yaml: first second\n"


def test_as_a_module(good, tmp_path):
    (tmp_path / "room.pgm").unlink()
    command = [sys.executable, "-m", "dsom_jax.localize", *LOCALIZE]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=300)
    assert done.returncode == 2 and done.stdout == "" and not (tmp_path / "out").exists()
    assert done.stderr.startswith("error: room.pgm: ") and done.stderr.count("\n") == 1
