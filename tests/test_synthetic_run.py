"""Running the synthetic experiments: jobs that fail, processes that share them, results that are kept."""

from __future__ import annotations

import os
import sys
from functools import partial
from pathlib import Path
from typing import Any

from dsom_jax.errors import UserError

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "experiments" / "synthetic"))

import comparison  # noqa: E402
import lab  # noqa: E402
import one_scan  # noqa: E402
import run as script  # noqa: E402


def test_pieces_shrink_together():
    for piece in script.PIECES:
        small = lab.scaled(piece.config, 2)
        assert all(getattr(small, name, 1) >= 1 for name in lab.SCALED)
        assert list(piece.jobs(small)) == list(piece.jobs(piece.config))


def test_a_job_that_fails_stops_no_other(tmp_path, capsys):
    calls = []

    def job(name: str, error: Exception | None, _: lab.Lab) -> dict[str, Any]:
        calls.append(name)
        if error:
            raise error
        return {"value": 1.5}

    def jobs(_: Any) -> dict[str, Any]:
        errors = {"a": ValueError("too odd"), "b": None, "c": UserError("no network"), "d": None}
        return {name: partial(job, name, error) for name, error in errors.items()}

    piece = lab.Piece("made", comparison.Config(), jobs, lambda _: {}, lambda _: "")
    assert script.run_pieces([piece], lab.Lab(), script.Args(workers=1), tmp_path) == ["made.a", "made.c"]
    assert "ValueError: too odd" in capsys.readouterr().err
    assert sorted(path.name for path in tmp_path.iterdir()) == ["made.b.json", "made.d.json"]
    # Again: what is there is kept, what failed is tried.
    assert script.run_pieces([piece], lab.Lab(), script.Args(workers=1), tmp_path) == ["made.a", "made.c"]
    assert calls == ["a", "b", "c", "d", "a", "c"]


def test_processes_give_the_numbers_of_one(tmp_path):
    found = []
    for workers in (1, 2):
        folder = tmp_path / str(workers)
        folder.mkdir()
        args = script.Args(only=("printed.mcl", "printed.adam_dsom"), runs=1, workers=workers)
        assert script.run_pieces(script.PIECES, lab.Lab(seed=1), args, folder) == []
        results = {path.name: lab.read(path) for path in folder.glob("*.json")}
        for result in results.values():
            assert len(result["runs"].steps) == 12
            # As text, in which no number equals no number.
            result["runs"] = {name: repr(column.tolist()) for name, column in result["runs"]._asdict().items()}
            result["made"] = {name: result["made"][name] for name in ("config", "seed", "networks", "commit")}
            del result["summary"]["ms_per_step"]
        found.append(results)
    assert found[0] == found[1] and len(found[0]) == 2
    assert {r["made"]["seed"] for r in found[0].values()} == {1}


def dying(piece: str, job: str, *others: Any) -> bool:
    """A job of a process that is killed, or one that is not."""
    if job == "bad":
        os._exit(1)
    return job == "good"


def test_a_process_that_is_killed_takes_no_other_job_with_it(monkeypatch, capsys):
    monkeypatch.setattr(script, "in_worker", dying)
    jobs = [("made", name, 0, 1, Path()) for name in ("bad", "good", "wrong")]
    assert script.shared(jobs, 2) == ["made.bad", "made.wrong"]
    assert capsys.readouterr().out == "made.bad: failed: its process was killed; is there enough memory?\n"
    assert script.shared([], 2) == []


def test_what_is_timed_runs_alone(monkeypatch, tmp_path):
    here: list[str] = []
    there: list[str] = []
    monkeypatch.setattr(script, "run_job", lambda piece, name, *words: here.append(f"{piece.name}.{name}") or True)
    monkeypatch.setattr(script, "shared", lambda jobs, workers: there.extend(f"{j[0]}.{j[1]}" for j in jobs) or [])
    assert script.run_pieces(script.PIECES, lab.Lab(), script.Args(), tmp_path) == []
    assert {name.split(".")[0] for name in here} == {"comparison", "cost"}
    assert {name.split(".")[0] for name in here + there} == {piece.name for piece in script.PIECES}


def test_curves_of_one_process_share_maps_and_proposals(monkeypatch):
    beds: list[one_scan.Bed] = []
    monkeypatch.setattr(one_scan.Bed, "point", lambda bed, condition, lab: beds.append(bed) or {})
    jobs, some = one_scan.jobs(one_scan.Config()), lab.Lab()
    for name in ("short", "scale"):
        some.enter("one_scan")
        jobs[name](some)
    some.enter("retention")
    jobs["scale"](some)
    assert len(beds) == 14 and all(bed is beds[0] for bed in beds[:9]) and beds[0] is not beds[9]


def test_results_of_another_network_are_told(tmp_path, capsys):
    piece = lab.Piece(
        "made", comparison.Config(), lambda _: {"a": lambda _: {"value": 1.5}}, lambda _: {}, lambda _: ""
    )
    for some, told in ((lab.Lab(), "made.a: kept\n"), (lab.Lab(), "other settings or networks")):
        script.run_pieces([piece], lab.Lab(), script.Args(workers=1), tmp_path)
        capsys.readouterr()
        if "networks" in told:
            some.__dict__["origins"] = {"dsom": "0" * 12}
        script.run_pieces([piece], some, script.Args(workers=1), tmp_path)
        assert told in capsys.readouterr().out
