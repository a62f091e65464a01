"""Run folders that cannot be hurt: one process at a time, nothing foreign removed, an older state if need be."""

from __future__ import annotations

import errno
import json
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import jax.numpy as jnp
import pytest

from dsom_jax import atomic, checkpoint
from dsom_jax.errors import UserError, run_cli
from dsom_jax.nn import DSOMConfig, create
from dsom_jax.run_folder import LOCK, OWNER, Run, check_new
from dsom_jax.run_folder import create_run as begin
from dsom_jax.run_resume import trim_log
from dsom_jax.train import TrainArgs
from dsom_jax.trainer import Parts, open_run, train
from dsom_jax.training.loop import TrainConfig

NETWORK = create(DSOMConfig(width=2, headings=4), 0)


class Tiny(Run):
    """Its network never changes; nothing is compiled."""

    def model(self, state):
        return NETWORK


def state(step: int) -> SimpleNamespace:
    return SimpleNamespace(step=step)


@pytest.fixture(autouse=True)
def plain_states(monkeypatch):
    """A state is a file with its number: what orbax does with arrays is tested elsewhere."""

    def save(path, state):
        path.mkdir()
        (path / "step").write_text(str(state.step))

    monkeypatch.setattr(checkpoint, "save_state", save)


def read(path: Path) -> int:
    try:
        return int((path / "step").read_text())
    except (OSError, ValueError) as error:
        raise UserError(f"{path}: damaged") from error


def new(folder: Path, total: int = 9) -> Tiny:
    run = Tiny(folder, TrainConfig(), (), total)
    begin(run)
    return run


def everything(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def parts(first: int = 0, at=lambda step: None) -> Parts:
    def forward(now, batch, total):
        at(now.step + 1)
        return state(now.step + 1), {"total": 0.0}

    return Parts(lambda step, total: None, forward, lambda model: {}, state(first), ("total", "total"))


HOLDER = """
import sys, pathlib
from dsom_jax.run_folder import Run, create_run
from dsom_jax.training.loop import TrainConfig
run = Run(pathlib.Path(sys.argv[1]), TrainConfig(), (), 9)
create_run(run)
print("held", flush=True)
sys.stdin.read()
"""


def test_a_second_training_is_refused_in_one_line_and_a_killed_one_holds_nothing(tmp_path):
    out = tmp_path / "run"
    command = [sys.executable, "-c", HOLDER, str(out)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout.readline() == "held\n"
        before = everything(out)
        with pytest.raises(UserError, match=rf"another training \(process {other.pid}\) writes there"):
            open_run(TrainArgs(out=out, resume=True))
        with pytest.raises(UserError, match="add --resume"):
            open_run(TrainArgs(out=out))
        with pytest.raises(UserError, match="another training"):
            new(out)  # as if both had found no folder
        assert everything(out) == before
        other.kill()
    assert open_run(TrainArgs(out=out, resume=True))[0].total == 9


def test_a_folder_with_a_checkpoint_and_no_run_is_not_touched(tmp_path):
    checkpoint.save(tmp_path, NETWORK, {}, tag="weights-5")
    (tmp_path / "weights_backup").mkdir()
    (tmp_path / "weights_backup" / "mine").write_text("precious")
    before = everything(tmp_path)
    for resume in (True, False):
        with pytest.raises(UserError, match=r"not empty \(provenance.json\) and without run.json"):
            open_run(TrainArgs(out=tmp_path, resume=resume))
    assert everything(tmp_path) == before


def test_what_a_start_leaves_that_was_killed_at_once_is_no_obstacle(tmp_path):
    for name in (LOCK, OWNER, ".run.json.123"):
        (tmp_path / name).write_text("")
    check_new(tmp_path)


def test_only_what_the_run_has_written_is_removed(tmp_path):
    run = new(tmp_path)
    run.save(state(1), {})
    foreign = ["weights_backup", "weights-00000099", "weights", "state-mine", "state-00000000"]
    for name in foreign:
        (tmp_path / name).mkdir()
        (tmp_path / name / "mine").write_text("precious")
    (tmp_path / f"state-00000004{checkpoint.DRAFT}").mkdir()  # of a killed process
    for step in (2, 3, 4, 5):
        run.save(state(step), {})
    assert all((tmp_path / name / "mine").read_text() == "precious" for name in foreign)
    ours = {p.name for p in tmp_path.iterdir() if p.is_dir()} - set(foreign)
    assert ours == {"state-00000004", "state-00000005", "weights-00000005"}
    assert set(json.loads((tmp_path / OWNER).read_text())["wrote"]) == ours


def test_a_link_in_the_place_of_a_state_is_not_followed(tmp_path):
    run, away = new(tmp_path / "run"), tmp_path / "away"
    run.save(state(1), {})
    shutil.move(run.out / "state-00000001", away)
    (run.out / "state-00000001").symlink_to(away)
    for step in (2, 3, 4):
        run.save(state(step), {})
    assert (away / "step").read_text() == "1"


def test_a_run_of_an_earlier_version_has_its_states_and_weights_taken_over(tmp_path):
    run = new(tmp_path)
    run.save(state(1), {})
    (tmp_path / OWNER).unlink()
    (tmp_path / "weights_backup").mkdir()
    again = Tiny(tmp_path, TrainConfig(), (), 9)
    for step in (2, 3):
        again.save(state(step), {})
    assert {p.name for p in tmp_path.glob("*-*")} == {"state-00000002", "state-00000003", "weights-00000003"}
    assert (tmp_path / "weights_backup").is_dir()


def test_the_older_state_is_used_when_the_newest_is_damaged_and_the_damaged_one_is_replaced(tmp_path, capsys):
    run = new(tmp_path)
    for step in (2, 4):
        run.save(state(step), {})
    (tmp_path / "state-00000004" / "step").write_text("")
    again = Tiny(tmp_path, TrainConfig(), (), 9)
    assert again.newest(read) == 2
    said = capsys.readouterr().out
    assert said.count("\n") == 1 and "state-00000004: damaged; the run goes on from" in said
    again.save(state(4), {})
    assert again.newest(read) == 4 and read(tmp_path / "state-00000002") == 2
    for path in again.states():
        (path / "step").unlink()
    with pytest.raises(UserError, match="no state can be read"):
        again.newest(read)
    assert Tiny(tmp_path / "none", TrainConfig(), (), 9).newest(read) is None


def test_a_folder_that_another_run_has_taken_is_left_alone(tmp_path):
    run = new(tmp_path)
    run.save(state(1), {})
    record = json.loads((tmp_path / OWNER).read_text())
    (tmp_path / OWNER).write_text(json.dumps({**record, "claim": "another"}))
    before = everything(tmp_path)
    with pytest.raises(UserError, match="was taken by another training"):
        run.save(state(2), {})
    assert everything(tmp_path) == before


def test_a_folder_that_is_removed_while_training_goes_on_is_made_again_with_the_whole_log(tmp_path):
    run = new(tmp_path / "run", 6)
    gone = lambda step: shutil.rmtree(run.out) if step == 4 else None  # noqa: E731
    train(TrainArgs(steps=6, save_steps=2), run, lambda: parts(at=gone))
    assert [json.loads(line)["step"] for line in (run.out / "metrics.jsonl").read_text().splitlines()] == list(
        range(1, 7)
    )
    assert [path.name for path in run.states()] == ["state-00000004", "state-00000006"]
    assert open_run(TrainArgs(out=run.out, resume=True))[0].total == 6


def test_a_full_disk_is_one_line_and_what_was_saved_is_intact(tmp_path, monkeypatch, capsys):
    run = new(tmp_path)
    run.save(state(1), {})
    before = everything(tmp_path)

    def full(path, tree, **options):
        Path(f"{path}{checkpoint.DRAFT}").mkdir()
        raise ValueError("RESOURCE_EXHAUSTED: Error writing: No space left on device [" + "x" * 3000)

    monkeypatch.setattr(checkpoint.ocp, "save", full)
    monkeypatch.setattr(checkpoint, "save_state", lambda path, state: checkpoint._save_tree(path, {}))
    with pytest.raises(SystemExit) as stop:
        run_cli(lambda: run.save(state(2), {}))
    error = capsys.readouterr().err
    assert stop.value.code == 2 and error.count("\n") == 1 and len(error) < 400
    assert "the disk is full" in error and "intact" in error
    after = everything(tmp_path)
    assert {k: v for k, v in after.items() if k != OWNER} == {k: v for k, v in before.items() if k != OWNER}
    assert not list(tmp_path.glob("*-tmp"))


def test_a_log_that_cannot_be_written_is_one_line(tmp_path, monkeypatch):
    run, plain = new(tmp_path), Path.open

    def full(path, *how, **more):
        if path.name == "metrics.jsonl" and how == ("a",):
            raise OSError(errno.ENOSPC, "No space left on device")
        return plain(path, *how, **more)

    monkeypatch.setattr(Path, "open", full)
    with pytest.raises(UserError, match=r"metrics.jsonl: cannot be written \(No space left on device\)"):
        train(TrainArgs(steps=2), run, lambda: parts())


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_training_after_the_step_under_way_and_keeps_it(tmp_path, number, capsys):
    run = new(tmp_path)
    stop = lambda step: os.kill(os.getpid(), number) if step == 3 else None  # noqa: E731
    with pytest.raises(SystemExit) as end:
        train(TrainArgs(steps=9), run, lambda: parts(at=stop))
    assert end.value.code == 128 + number
    assert [path.name for path in run.states()] == ["state-00000003"] and checkpoint.tag_of(
        tmp_path
    ) == "weights-00000003"
    said = capsys.readouterr()
    assert "stopped after step 3" in said.out and "--resume" in said.out and "Traceback" not in said.err
    assert signal.getsignal(number) in (signal.default_int_handler, signal.SIG_DFL)


def test_ctrl_c_in_any_command_is_one_line_and_130(capsys):
    def main():
        raise KeyboardInterrupt

    with pytest.raises(SystemExit) as stop:
        run_cli(main)
    error = capsys.readouterr().err
    assert stop.value.code == 130 and error.count("\n") == 1 and "interrupted" in error


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "not JSON"),
        ("[" * 100_000, "nested too deeply"),
        ('{"total": ' + "9" * 5000 + "}", "not JSON"),
        ("[]", "field maps is missing"),
        ('{"maps": null, "total": 1, "seconds": 0, "config": {}}', "field maps: is None"),
        ('{"maps": [1], "total": 1, "seconds": 0, "config": {}}', "holds no names"),
        ('{"maps": [], "total": 0, "seconds": 0, "config": {}}', "out of range"),
        ('{"maps": [], "total": "9", "seconds": 0, "config": {}}', "field total: is 9"),
        ('{"maps": [], "total": 9, "seconds": NaN, "config": {}}', "out of range"),
        ('{"maps": [], "total": 9, "seconds": 1, "config": [1]}', "field config"),
        ('{"maps": [], "total": 9, "seconds": 1, "config": {"colour": 1}}', "unknown field colour"),
    ],
)
def test_a_damaged_run_json_is_one_line_and_nothing_is_written(tmp_path, text, message):
    (tmp_path / "run.json").write_text(text)
    with pytest.raises(UserError, match=message) as raised:
        open_run(TrainArgs(out=tmp_path, resume=True))
    assert len(str(raised.value)) < 400 and [p.name for p in tmp_path.iterdir()] == ["run.json"]


def test_damaged_lines_of_the_log_are_left_out_and_counted(tmp_path, capsys):
    log = tmp_path / "metrics.jsonl"
    log.write_bytes(b'{"step": 1}\n\0\0\0\n{}\n{"a": }\n\xff\xfe}\n{"step": 2}\n{"step": 3}\n{"st')
    assert trim_log(log, 2) == ['{"step": 1}', '{"step": 2}'] and log.read_text() == '{"step": 1}\n{"step": 2}\n'
    said = capsys.readouterr().out
    assert said.count("\n") == 1 and "4 damaged lines" in said


def test_files_and_their_names_reach_the_disk_before_anything_is_removed(tmp_path, monkeypatch):
    synced, plain = [], os.fsync
    monkeypatch.setattr(
        os, "fsync", lambda handle: (synced.append(os.readlink(f"/proc/self/fd/{handle}")), plain(handle))
    )
    checkpoint.write(tmp_path / "net", NETWORK, {}, "weights-1")
    names = [str(Path(path).relative_to(tmp_path)) for path in synced if path.startswith(str(tmp_path))]
    weights = {str(p.relative_to(tmp_path)) for p in (tmp_path / "net" / "weights-1").rglob("*")}
    assert weights <= set(names) and names.index("net/weights-1") > max(map(names.index, weights))
    # The record that names the weights comes after them, and the folder that names the record last.
    assert names[-2].startswith("net/.provenance.json.") and names[-1] == "net"
    assert atomic.write_atomic(tmp_path / "x", b"1") is None


def test_arrays_of_a_state_are_damaged_or_whole(tmp_path, monkeypatch):
    """Orbax's own files, cut short."""
    monkeypatch.undo()
    tree = {"a": jnp.arange(5000.0)}
    checkpoint.save_state(tmp_path / "state-00000001", tree)
    largest = max((p for p in (tmp_path / "state-00000001").rglob("*") if p.is_file()), key=lambda p: p.stat().st_size)
    largest.write_bytes(largest.read_bytes()[:100])
    with pytest.raises(UserError, match="damaged"):
        checkpoint.load_state(tmp_path / "state-00000001", tree)


@pytest.mark.slow
def test_kills_full_disks_and_races_lose_nothing(tmp_path):
    """A few of each; ``experiments/stress/run_folder.py`` alone does a hundred."""
    script = Path(__file__).resolve().parents[1] / "experiments" / "stress" / "run_folder.py"
    command = [sys.executable, str(script), "--kill", "4", "--fill", "2", "--race", "2", "--no-save"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0 and done.stdout.endswith("0 faults\n"), done.stdout + done.stderr
