"""Files, tables and figures of results."""

from __future__ import annotations

import json
from io import StringIO

import jax.numpy as jnp
import numpy as np
import pytest
from rich.console import Console

from dsom_jax import plotting, report
from dsom_jax.errors import UserError
from dsom_jax.judging import metrics
from dsom_jax.occupancy import from_cells

METHODS = ("mcl", "adam_dsom", "robust_likelihood_grid", "somebody_else")


def runs_of(seed: int, count: int = 40) -> metrics.Runs:
    rng = np.random.default_rng(seed)
    e_pos = np.where(np.arange(30) < rng.integers(0, 35, (count, 1)), 20.0, 0.1)
    return metrics.measure_errors(e_pos, 0.1 * (e_pos > 1) + 0.01)


@pytest.fixture(scope="module")
def runs() -> dict:
    return {name: {"global": runs_of(n), "kidnap": runs_of(n + 9)} for n, name in enumerate(METHODS)}


@pytest.fixture(scope="module")
def bench(runs) -> dict:
    methods = {n: {p: metrics.summarize(r) for p, r in by.items()} | {"ms_per_step": 1234.5} for n, by in runs.items()}
    return {"suite": "synthetic-v1", "runs": 40, "particles": 200, "t_cut": 0.6, "seed": 0, "methods": methods}


def shown(bench, width=100) -> str:
    console = Console(width=width, record=True, file=StringIO())
    report.print_tables(bench, console)
    return console.export_text()


def test_tables_fit_100_columns_and_nothing_is_cut(bench):
    text = shown(bench)
    assert max(map(len, text.splitlines())) <= 100
    assert "…" not in text
    for word in (*METHODS, "Global localization", "Kidnapping", "converged %", "ms/step", "40 experiments"):
        assert word in text


def test_a_phase_without_experiments_has_no_table(bench):
    empty = metrics.summarize(metrics.pool([]))
    only = bench | {"methods": {"mcl": bench["methods"]["mcl"] | {"kidnap": empty}}}
    assert "Kidnapping" not in shown(only) and "Global" in shown(only)


def test_a_method_that_never_converged_is_shown_with_dashes(bench):
    lost = metrics.summarize(metrics.measure_errors(np.full((3, 9), 20.0), np.zeros((3, 9))))
    never = {"mcl": {"global": lost, "kidnap": lost, "ms_per_step": 1.0}}
    row = next(line for line in shown(bench | {"methods": never}).splitlines() if line.startswith("mcl"))
    assert row.split() == ["mcl", "0.0", "[0-80]", "0.0", "-", "-", "-", "-", "0.0", "1.0"]


def test_markdown_has_one_row_per_method_and_equal_columns(bench):
    lines = [line for line in report.markdown(bench).splitlines() if line.startswith("|")]
    assert len(lines) == 2 * (2 + len(METHODS))
    assert {line.count("|") for line in lines} == {10}


def test_json_is_strict_and_read_back(tmp_path, bench):
    report.write_json(
        tmp_path / "bench.json", bench | {"nothing": float("nan"), "array": jnp.arange(2), "where": tmp_path}
    )
    data = json.loads((tmp_path / "bench.json").read_text(), parse_constant=pytest.fail)
    assert data["nothing"] is None and data["array"] == [0, 1]
    assert data["methods"]["mcl"]["global"]["converged"] == bench["methods"]["mcl"]["global"]["converged"]
    assert [p.name for p in tmp_path.iterdir()] == ["bench.json"]


def test_a_failed_write_leaves_the_old_file_alone(tmp_path):
    report.write_text(tmp_path / "a.txt", "old")
    with pytest.raises(UnicodeEncodeError):
        report.write_text(tmp_path / "a.txt", "new \ud800")
    assert (tmp_path / "a.txt").read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["a.txt"]


def test_output_folder_is_made(tmp_path):
    assert report.output_folder(tmp_path / "a" / "b").is_dir()
    assert list((tmp_path / "a" / "b").iterdir()) == []


@pytest.mark.parametrize("name", ["file", "file/below"])
def test_an_output_folder_that_cannot_be_written_is_named(tmp_path, name):
    (tmp_path / "file").touch()
    with pytest.raises(UserError, match=r"--out .*file.*cannot write"):
        report.output_folder(tmp_path / name)


@pytest.fixture(scope="module")
def figures(runs):
    rng = np.random.default_rng(0)
    traces = [{name: rng.lognormal(0, 1, (5, 20)) for name in METHODS} for _ in range(4)]
    traces[0]["mcl"][:, 3] = np.nan  # reference unknown
    traces[1]["mcl"][2, 4] = np.inf  # estimate broken
    return plotting.benchmark_figures(runs, traces, [np.arange(20) == 10] * 4)


def test_every_axis_says_what_and_in_which_unit(figures):
    for name, figure in figures.items():
        text = " ".join(ax.get_xlabel() + ax.get_ylabel() for ax in figure.axes)
        assert "[m]" in text or "[%]" in text, name
        assert all(ax.get_xlabel() or ax.get_xticklabels()[0].get_text() for ax in figure.axes if ax.axison), name


def test_figures_are_written(tmp_path, figures):
    for name, figure in figures.items():
        plotting.save_figure(figure, tmp_path / f"{name}.png")
        assert (tmp_path / f"{name}.png").read_bytes().startswith(b"\x89PNG")
    assert len(list(tmp_path.iterdir())) == 3


def test_a_benchmark_without_kidnapping_is_drawn(runs):
    nobody = metrics.pool([])
    only = {name: by | {"kidnap": nobody} for name, by in runs.items()}
    drawn = plotting.benchmark_figures(only, [{"mcl": np.ones((2, 4))}], [np.zeros(4, bool)])
    assert len(drawn["position_error"].axes) == 1


def test_map_is_drawn_in_the_map_frame():
    cells = np.zeros((20, 30), bool)
    grid = from_cells(cells, resolution=0.5, origin=(-4.0, 2.0, np.pi / 2))
    pm = np.zeros((20, 30, 4))
    pm[3, 4, 1] = 1.0
    view = {"grid": grid, "pm": pm, "particles": np.zeros((3, 3)), "points": np.zeros((2, 2)), "truth": np.zeros(3)}
    figure = plotting.map_views([view, {"grid": grid}], ["update 0", "update 1"])
    left, right = figure.axes
    # 30 cells of 0.5 m along x, turned by 90 degrees: they run up from the origin, and the 20 rows to the left.
    np.testing.assert_allclose((*left.get_xlim(), *left.get_ylim()), (-14, -4, 2, 17), atol=1e-5)
    assert left.get_xlabel() == right.get_xlabel() == "x [m]" and left.get_ylabel() == "y [m]"
