"""The loop around the training step: how long a run gets, what is saved when, and what a resumed run begins with."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import NamedTuple

import pytest

from dsom_jax import checkpoint
from dsom_jax.errors import UserError
from dsom_jax.run_folder import Run, create_run
from dsom_jax.train import TrainArgs
from dsom_jax.trainer import CALIBRATION_STEPS, Parts, Trainer, open_run, train
from dsom_jax.training.loop import TrainConfig


class State(NamedTuple):
    """All that the loop looks at."""

    step: int


class Folder(Run):
    """A run whose network is nothing; says what it saves."""

    def save(self, state, metrics):
        self.saved = [*getattr(self, "saved", []), state.step]


def parts(step: int) -> Parts:
    def forward(state, batch, total):
        return State(state.step + 1), {"total": 0.0}

    return Parts(lambda step, total: None, forward, lambda model: {}, State(step), ("total", "total"))


@pytest.fixture
def run(tmp_path, monkeypatch):
    monkeypatch.setattr(Folder, "model", lambda self, state: None)
    return Folder(tmp_path, TrainConfig(), (), 6)


@pytest.mark.parametrize(("every", "saved"), [(3, [3, 6]), (4, [4, 6]), (100, [6])])
def test_the_last_step_is_saved_once(run, every, saved):
    train(TrainArgs(steps=6, save_steps=every), run, lambda: parts(0))
    assert run.saved == saved


def test_a_run_resumed_before_its_length_is_known_gets_all_of_its_minutes(run):
    run.total = None
    trainer = Trainer(TrainArgs(minutes=1.0), run, parts(20))
    trainer.calibrate(20 + 5, 100.0)
    trainer.calibrate(20 + 5 + CALIBRATION_STEPS, 100.0 + CALIBRATION_STEPS)  # one second for each step
    assert run.total == 20 + 5 + CALIBRATION_STEPS + int(60 * 0.95)


def test_a_run_resumed_before_its_length_is_known_takes_the_steps_that_are_asked_for(tmp_path):
    create_run(Run(tmp_path, TrainConfig(), (), None))
    assert open_run(TrainArgs(out=tmp_path, resume=True, steps=7))[0].total == 7
    assert open_run(TrainArgs(out=tmp_path, resume=True))[0].total is None


def test_a_checkpoint_is_not_written_over_in_place(tmp_path, monkeypatch):
    tags = []
    monkeypatch.setattr(checkpoint, "save_state", lambda path, state: path.mkdir(exist_ok=True))
    monkeypatch.setattr(checkpoint, "write", lambda out, model, provenance, tag: tags.append(tag))
    monkeypatch.setattr(Run, "model", lambda self, state: None)
    run = Run(tmp_path, TrainConfig(), (), 6)
    run.save(SimpleNamespace(step=5), {})
    (tmp_path / checkpoint.PROVENANCE).write_text(json.dumps({"weights": "weights-00000006"}))
    run.save(SimpleNamespace(step=6), {})
    run.save(SimpleNamespace(step=7), {})
    assert tags == ["weights-00000005", "weights-00000007"]


def resume(folder: Path, init: str | None):
    return open_run(TrainArgs(out=folder, resume=True, init=None if init is None else folder / init))


def test_a_resumed_run_begins_with_the_weights_that_it_names(tmp_path, capsys):
    create_run(Run(tmp_path, TrainConfig(), (), 6, init="mine"))
    with pytest.raises(UserError, match="begins with mine and has saved no state"):
        resume(tmp_path, None)
    with pytest.raises(UserError, match=r"--init .*other: the run in .* began with mine"):
        resume(tmp_path, "other")
    (tmp_path / "state-00000003").mkdir()
    assert resume(tmp_path, None)[0].init == "mine" and not capsys.readouterr().out
    assert resume(tmp_path, "mine")[1].network is None
    said = capsys.readouterr().out
    assert said.count("\n") == 1 and "mine: not read" in said and "state-00000003" in said


def test_a_run_that_began_with_fresh_weights_takes_no_others(tmp_path):
    create_run(Run(tmp_path, TrainConfig(), (), 6))
    with pytest.raises(UserError, match="began with fresh weights"):
        resume(tmp_path, "mine")


def test_a_checkpoint_that_is_none_has_no_tag(tmp_path):
    assert checkpoint.tag_of(tmp_path) is None
    for text in ("{half", "[]", "{}"):
        (tmp_path / checkpoint.PROVENANCE).write_text(text)
        assert checkpoint.tag_of(tmp_path) is None


def test_batches_follow_the_step_that_was_reached(run):
    asked = []
    made = parts(4)._replace(batches=lambda step, total: asked.append((step, total)))
    train(TrainArgs(steps=6), run, lambda: made)
    assert asked[:2] == [(4, 6), (5, 6)]
    assert [json.loads(line)["step"] for line in (run.out / "metrics.jsonl").read_text().splitlines()] == [5, 6]
