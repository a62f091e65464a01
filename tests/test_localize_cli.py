"""``python -m dsom_jax.localize`` on a made-up room: what it writes, with and without reference and kidnapping."""

from __future__ import annotations

import csv
import json
import re
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from evo.tools import file_interface

import tiny_world
from dsom_jax import localize, localize_args
from dsom_jax.diagnosis.findings import Finding
from dsom_jax.errors import run_cli
from dsom_jax.summary_table import times
from tiny_log import START, UPDATES, record

KEYS = {
    "map": str, "log": str, "method": str, "proposal": str, "particles": int, "segments": int, "runs": int,
    "updates": int, "converged": float, "converged_ci95": list, "steps_median": float, "metres_median": float,
    "e_pos_m_median": float, "e_theta_rad_median": float, "retention": float, "strict_success": float,
    "false_confident": float, "ms_per_update": float,
}  # fmt: skip
"""``summary.json`` of DESIGN section 5."""
RATES = ("converged", "retention", "strict_success", "false_confident")


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    return record(tmp_path_factory.mktemp("room"))


@pytest.fixture
def call(room, tmp_path, monkeypatch, capsys):
    """Runs the command; gives summary.json and what was printed."""

    def go(*words: str, reference: bool = True, out: str = "out") -> tuple[dict[str, Any], str]:
        known = ["--reference", str(room.reference)] if reference else []
        common = ["--map", room.map, "--log", room.log, "--out", tmp_path / out, *known, "--runs", 4]
        common += ["--particles", 60, "--segments", 2, "--steps-per-segment", 20, *words]
        monkeypatch.setattr(sys, "argv", ["localize", *map(str, common)])
        run_cli(localize.main)
        text = (tmp_path / out / "summary.json").read_text()
        return json.loads(text, parse_constant=pytest.fail), capsys.readouterr().out

    return go


def test_with_reference(call, room, tmp_path):
    summary, printed = call()
    wrong = {key: summary.get(key) for key, kind in KEYS.items() if not isinstance(summary.get(key), kind)}
    assert not wrong
    assert (summary["map"], summary["log"]) == (str(room.map), str(room.log))
    assert (summary["method"], summary["proposal"]) == ("adam_robust", "likelihood_grid")
    assert any("pose of the laser is that of the odometry" in note for note in summary["notes"])
    counts = [summary[key] for key in ("particles", "segments", "runs", "updates")]
    assert counts == [60, 2, 4, 40] and summary["ms_per_update"] > 0
    assert all(0 <= summary[rate] <= 1 for rate in RATES)
    # 32 exact beams all round of a room without symmetry: whoever misses this one is broken.
    assert summary["converged"] == 1 and summary["strict_success"] == 1 and summary["e_pos_m_median"] < 0.1
    low, high = summary["converged_ci95"]
    assert low < 1 and high == 1
    assert [segment["on_map"] for segment in summary["by_segment"]] == [1, 1]
    assert "100.0%" in printed and "look at" in printed and {p.name for p in (tmp_path / "out").iterdir()} == {
        "summary.json", "estimate.tum", "answers.csv", "report.html", "trajectory.png",
    }  # fmt: skip
    check_answers(tmp_path / "out")
    check_page(tmp_path / "out", summary)
    trajectory = file_interface.read_tum_trajectory_file(tmp_path / "out" / "estimate.tum")
    truth = file_interface.read_tum_trajectory_file(room.reference)
    valid, details = trajectory.check()
    assert valid, details
    # Segments of 20, one at each end of the log.
    expected = [*range(20), *range(UPDATES - 20, UPDATES)]
    np.testing.assert_allclose(trajectory.timestamps, START + np.array(expected), atol=1e-6)
    off = np.linalg.norm(trajectory.positions_xyz - truth.positions_xyz[expected], axis=-1)
    # Only the first answers, after a scan or two, may be wrong.
    assert np.median(off) < 0.1 and (off.reshape(2, 20)[:, 5:] < 0.5).all()


def answers_of(out):
    """Rows of answers.csv, which says what estimate.tum says."""
    with (out / "answers.csv").open() as file:
        rows = list(csv.DictReader(file))
    said = file_interface.read_tum_trajectory_file(out / "estimate.tum")
    for column, expected in zip(("stamp", "x", "y"), (said.timestamps, *said.positions_xyz.T[:2]), strict=True):
        np.testing.assert_allclose([float(row[column]) for row in rows], expected, atol=2e-4)
    return rows


def check_answers(out):
    """How sure run 0 was."""
    rows = answers_of(out)
    later = [row for n, row in enumerate(rows) if n % 20 >= 5]
    assert all(row["verdict"] == "localized" and row["hypotheses"] == "1" for row in later)
    assert all(float(row["p_lost"]) < 0.05 for row in later)
    # 60 particles around a pose that 32 exact beams pin down to some centimetres.
    assert all(0 < float(row[sd]) < 0.3 for row in later for sd in ("sd_x", "sd_y", "sd_theta"))


def check_page(out, summary):
    """report.html has the drives of run 0, and its large numbers are those of summary.json."""
    html = (out / "report.html").read_text()
    tiles = dict(re.findall(r'data-key="(\w+)" data-value="([^"]+)"', html))
    assert {"converged", "e_pos_m_median", "false_confident"} <= set(tiles)
    assert all(float(value) == summary[key] for key, value in tiles.items())
    data = json.loads(re.search(r'id="story">(.*?)</script>', html).group(1))
    assert [drive["name"] for drive in data["drives"]] == ["segment 1", "segment 2"]
    assert data["drives"][0]["particles"]["count"] == 60
    assert (out / "trajectory.png").read_bytes()[:4] == b"\x89PNG"


def test_same_seed_same_summary_and_estimate(call, tmp_path):
    (first, _), (again, _), (other, _) = call(), call(out="again"), call("--seed", "1", out="other")
    assert first.pop("ms_per_update") > 0 and again.pop("ms_per_update") > 0
    assert first == again
    files = [(tmp_path / out / "estimate.tum").read_bytes() for out in ("out", "again", "other")]
    assert files[0] == files[1] != files[2]
    assert other["e_pos_m_median"] != first["e_pos_m_median"]


def test_without_reference(call, tmp_path):
    summary, printed = call(reference=False)
    assert summary["reference"] is None and not set(RATES) & set(summary)
    assert summary["updates"] == 40 and 0 <= summary["confident"] <= 1 and "no reference" in printed
    assert len(file_interface.read_tum_trajectory_file(tmp_path / "out" / "estimate.tum").timestamps) == 40


def test_reference_of_one_segment_only(call, room, tmp_path, recwarn):
    rows = room.reference.read_text().splitlines(keepends=True)
    (tmp_path / "part.tum").write_text("".join(rows[:20]))
    summary, _ = call("--reference", str(tmp_path / "part.tum"), reference=False)
    known, unknown = summary["by_segment"]
    assert summary["experiments"] == 4 and summary["converged"] == 1 and known["converged"] == 1
    assert unknown["on_map"] is unknown["converged"] is unknown["e_pos_m_median"] is None
    assert not [w for w in recwarn if issubclass(w.category, RuntimeWarning)]


def test_kidnapping(call, tmp_path):
    summary, printed = call("--kidnap", "--steps-per-segment", "10")
    assert not {key for key, kind in KEYS.items() if not isinstance(summary.get(key), kind)}
    assert summary["updates"] == 40 and summary["experiments"] == summary["kidnap"]["experiments"] == 8
    phases = [key for key, kind in KEYS.items() if key in summary["kidnap"] and kind in (float, list)]
    assert set(RATES) | {"steps_median", "metres_median"} <= set(phases)
    # 60 particles and 5 updates to spare: 97 % of 80 runs; less than half of 8 would be a fault.
    assert summary["kidnap"]["converged"] >= 0.5 and "carried away" in printed
    # Both halves of the log are driven twice, the estimate tells each moment once.
    stamps = file_interface.read_tum_trajectory_file(tmp_path / "out" / "estimate.tum").timestamps
    assert len(stamps) == 20 and (np.diff(stamps) > 0).all()


def test_live_gives_the_numbers_of_run_0_and_latencies(call, tmp_path):
    call("--runs", "1", out="batch")
    summary, printed = call("--live", out="live")
    for name in ("estimate.tum", "answers.csv"):
        assert (tmp_path / "live" / name).read_bytes() == (tmp_path / "batch" / name).read_bytes()
    assert summary["runs"] == 1 and summary["updates"] == 40 and summary["converged"] == 1
    latency = summary["latency_ms"]
    assert 0 < latency["median"] <= latency["p99"] <= latency["max"] <= latency["first"] and "latency median" in printed


def test_the_filter_of_the_paper(call, tmp_path):
    summary, _ = call("--method", "adam", "--t-cut", "0.7")
    assert summary["method"] == "adam" and summary["experiments"] == 8
    answers_of(tmp_path / "out")


def test_one_segment_of_a_short_log_in_json(call, tmp_path, monkeypatch):
    """The whole of stdout is the JSON; what is odd about the log is in the summary and on the page."""
    odd = Finding("ranges_scaled", "error", "readings are <too long>", "--range-scale 0.001")
    monkeypatch.setattr(localize, "cheap_findings", lambda log, grid: [odd])
    runs, run = [], localize.run
    monkeypatch.setattr(localize, "run", lambda *args: runs.append(args) or run(*args))
    summary, printed = call("--json", "--segments", "3", "--steps-per-segment", str(UPDATES), "--runs", "2")
    assert json.loads(printed) == summary
    few = f"has only 1 different segments of {UPDATES} updates, not 3"
    assert any(few in note for note in summary["notes"]) and odd.line() in summary["notes"]
    html = (tmp_path / "out" / "report.html").read_text()
    assert few in html and "<b>Note</b>error" not in html
    assert '<li class="error"><b>Error</b>readings are &lt;too long&gt; <em>--range-scale 0.001</em></li>' in html
    # It is run once, and how long that takes without compiling is not known.
    assert len(runs) == 1 and summary["ms_per_update"] is None


def test_times_that_were_not_measured_are_not_told():
    assert times({"ms_per_update": None, "runs": 2}) == []
    assert times({"ms_per_update": 2.0, "runs": 2, "latency_ms": {"max": 3.0}}) == [
        "2.0 ms per update of all 2 runs", "latency max 3.0 ms",
    ]  # fmt: skip


def test_floor_plans_get_models_of_their_own(call):
    first, _ = call(out="scanned")
    second, _ = call("--map-kind", "drawn", out="drawn")
    assert first["converged"] == 1 and second["map_kind"] == "drawn" != first["map_kind"]
    assert second["e_pos_m_median"] != first["e_pos_m_median"]


@pytest.mark.parametrize(
    ("fields", "proposal"),
    [
        ({}, "likelihood_grid"),
        ({"memory": False}, "likelihood_grid"),
        ({"proposal": "uniform"}, "uniform"),
        ({"method": "adam"}, "likelihood_grid"),
        ({"method": "mcl", "proposal": "hybrid"}, "uniform"),
    ],
)
def test_what_the_summary_says_of_the_filter_is_so(fields, proposal):
    args = localize_args.LocalizeArgs(Path("m.yaml"), Path("l.log"), Path("out"), particles=8, **fields)
    filter = localize_args.build(args, tiny_world.grid(), tiny_world.LIDAR)
    assert localize_args.remembers(args) == filter.drawn == (fields == {})
    assert localize_args.drawn_from(args) == proposal and not localize_args.needs_network(args)
