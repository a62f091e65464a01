"""The synthetic report: symmetric buildings, side-by-side runs, departures, verdicts, the page from made results."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import tiny_world
from dsom_jax.episode import Episode
from dsom_jax.errors import UserError
from dsom_jax.filters.methods import build_filter
from dsom_jax.geometry import relative
from dsom_jax.judging.metrics import Runs, measure_errors, pool, summarize
from dsom_jax.judging.run_table import RunTable, join, run_rows
from dsom_jax.lidar import LidarConfig
from dsom_jax.montecarlo import run, run_keys
from dsom_jax.occupancy import from_cells
from dsom_jax.raycast import RaycastConfig, cast_rays, make_tables

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "experiments" / "synthetic"))

import comparison  # noqa: E402
import departures  # noqa: E402
import lab  # noqa: E402
import paper  # noqa: E402
import side_by_side  # noqa: E402
import symmetric  # noqa: E402
import verdicts  # noqa: E402

LIDAR = LidarConfig(beams=24, angle_increment=2 * np.pi / 24, range_max=4.0)


def random_map(seed: int = 0) -> Any:
    """A square of 16 cells with some of them occupied, off the origin of the map frame."""
    cells = np.random.default_rng(seed).random((16, 16)) < 0.2
    return from_cells(cells, resolution=0.5, origin=(1.0, -2.0, 0.3))


@pytest.mark.parametrize("order", symmetric.ORDERS)
def test_all_images_of_a_pose_see_the_same(order):
    grid = symmetric.symmetric(random_map(), order)
    turned = [np.rot90(np.asarray(grid.occupied), quarter) for quarter in range(0, 4, 4 // order)]
    assert all((cells == turned[0]).all() for cells in turned)
    if order == 2:
        assert (np.rot90(turned[0]) != turned[0]).any()
    local = jnp.array([[2.3, 3.1, 0.4], [6.2, 1.7, -2.9]])
    poses = symmetric.images(grid, grid.from_grid(local), order)
    assert poses.shape == (2, order, 3)
    np.testing.assert_allclose(poses[:, 0], grid.from_grid(local), atol=1e-5)
    ranges = cast_rays(make_tables(grid, RaycastConfig("exact"), 4.0), poses, LIDAR)
    seen = np.nan_to_num(np.asarray(ranges), posinf=9.0)
    # A beam that grazes a corner may fall on either side of it.
    assert (np.abs(seen - seen[:, :1]) < 1e-3).mean() > 0.95
    middle = np.asarray(grid.from_grid(jnp.array([4.0, 4.0, 0.0])))
    away = np.hypot(*np.moveaxis(np.asarray(poses)[..., :2] - middle[:2], -1, 0))
    np.testing.assert_allclose(away, np.broadcast_to(away[:, :1], away.shape), atol=1e-5)


def test_symmetry_needs_an_even_square():
    with pytest.raises(ValueError, match="even square"):
        symmetric.symmetric(from_cells(np.zeros((16, 15), bool), resolution=1.0), 2)
    with pytest.raises(ValueError, match="order"):
        symmetric.symmetric(random_map(), 3)


def test_cells_near_the_middle_are_left_out():
    away = np.asarray(symmetric.off_middle(random_map(), 1.0))
    assert not away[7:9, 7:9].any() and away[0].all() and (away == np.rot90(away)).all()


@pytest.fixture(scope="module")
def drive() -> Episode:
    """Eight updates in the tiny room, its odometry a little wrong, carried away before the fifth."""
    angles = 0.4 * jnp.arange(8)
    turns = jnp.stack([3.0 + 0.5 * jnp.sin(angles), 2.3 + 0.2 * jnp.cos(angles), angles], -1)
    poses = tiny_world.grid().from_grid(turns)
    moves = jnp.concatenate([jnp.zeros((1, 3)), relative(poses[:-1], poses[1:])])
    noise = 0.05 * jax.random.normal(jax.random.key(3), moves.shape)
    ranges = cast_rays(tiny_world.tables(), poses, LIDAR)
    return Episode(ranges, (moves + noise).at[0].set(0.0), poses, jnp.arange(8) == 4, jnp.arange(8.0))


def test_side_by_side_equals_one_by_one(drive):
    keys, grid = run_keys(0, 0, 3), tiny_world.grid()
    built = {t: build_filter("adam_likelihood_grid", grid, LIDAR, particles=20, t_cut=t) for t in (0.25, 0.75)}
    together = side_by_side.run_all(built[0.25], side_by_side.other_t_cut, (0.25, 0.75), drive, keys)
    for (_, filter), result in zip(built.items(), together, strict=True):
        alone = run(filter, drive, keys)
        np.testing.assert_allclose(result.info.mean, alone.info.mean, atol=1e-4)
        np.testing.assert_array_equal(result.info.redrawn, alone.info.redrawn)


def test_odometry_is_wrong_as_many_times(drive):
    told = side_by_side.with_error(drive)
    true = np.asarray(relative(drive.poses[:-1], drive.poses[1:]))
    for factor in (1.0, 3.0):
        for t in (1, 4, 6):
            inputs = jax.tree.map(lambda leaf, t=t: leaf[t], told.inputs)
            _, changed = side_by_side.noisier(None, inputs, jnp.float32(factor))
            wanted = true[t - 1] + factor * (np.asarray(drive.odometry[t]) - true[t - 1])
            wanted = np.asarray(drive.odometry[t]) if t == 4 else wanted
            np.testing.assert_allclose(changed.odometry, wanted, atol=1e-5)


def test_numbers_of_the_paper():
    assert [paper.PARTICLES[n].of("global", "e_pos") for n in (200, 500, 1000)] == [0.153, 0.088, 0.060]
    assert [paper.PARTICLES[n].of("kidnap", "e_theta") for n in (200, 500, 1000)] == [0.022, 0.016, 0.007]
    assert len(paper.T_CUT) == 5 and paper.T_CUT[0.9].of("kidnap", "e_pos") == 1.133
    assert all(0 < quoted.value <= 1 for by in paper.WITHIN_20.values() for quoted in by.values())


def test_departures_by_hand():
    """One run: found at 0 to 4, away at 6 and 7 (first the mean only), back at 8, away for good at 10."""
    away = {6: 5.0, 7: 5.0, 10: 9.0, 11: 9.0}
    mean = np.zeros((1, 12, 3))
    cluster = np.zeros((1, 12, 3))
    for t, metres in away.items():
        mean[0, t, 0] = metres
        cluster[0, t, 0] = 0.0 if t == 6 else metres
    info = type("Info", (), {"mean": mean, "cluster": cluster, "redrawn": np.full((1, 12), 0.5)})
    episode = Episode(np.zeros((12, 1)), np.zeros((12, 3)), np.zeros((12, 3)), np.zeros(12, bool), np.arange(12.0))
    trust = np.where(np.arange(12) == 5, 0.1, 0.9)
    scene = departures.Scene(np.where(np.arange(12) == 10, 0.01, 0.8), trust)
    result = type("Result", (), {"info": info})
    found = departures.departures([departures.Part("adam_dsom", 0, episode, result, scene)], 0.6)
    assert (found["count"], found["updates_after_convergence"]) == (2, 7)
    assert (found["dragged"], found["pm_poor"], found["doubted"], found["returned"]) == (0.5, 0.5, 0.5, 0.5)
    assert found["length_median"] == 2 and found["pm_poor_otherwise"] == 0
    robust = departures.departures([departures.Part("robust_dsom", 0, episode, result, scene)], None)
    assert np.isnan(robust["doubted"])


def made_runs(seed: int, steps: int, error: float, count: int = 20) -> Runs:
    """Runs that converge after about ``steps`` updates and end about ``error`` metres off."""
    rng = np.random.default_rng(seed)
    start = rng.integers(steps, steps + 5, (count, 1))
    e_pos = np.where(np.arange(40) < start, 20.0, error * (1 + 0.1 * rng.random((count, 40))))
    return measure_errors(e_pos, 0.02 * np.ones_like(e_pos), drive=seed)


def made_results(better: str) -> dict[str, Any]:
    """Results of the comparison in which ``better`` is best in everything and the others are equal."""
    results: dict[str, Any] = {}
    for name in comparison.COMPARED:
        steps, error = (3, 0.05) if name == better else (30, 1.0)
        parts = {phase: [made_runs(n, steps, error) for n in range(6)] for phase in comparison.PHASES}
        rows = [run_rows(name, phase, n, 0, r) for phase, runs in parts.items() for n, r in enumerate(runs)]
        entry = {phase: summarize(pool(runs)) for phase, runs in parts.items()} | {"ms_per_step": 1.0}
        bands = np.tile(np.array([[20.0, error], [19.0, error], [21.0, error]]), (6, 1, 1))
        config = {"runs": 20, "methods": list(comparison.COMPARED)}
        results[name] = {"made": made(config), "summary": entry, "runs": join(rows),
                         "evolution": bands, "kidnapped": [[1]] * 6}  # fmt: skip
    return results


def made(config: dict[str, Any]) -> dict[str, Any]:
    """How a result was made."""
    return {"config": config, "seed": 0, "commit": "0123456789", "machine": lab.machine(), "wall_s": 1.0,
            "processor_s": 2.0}  # fmt: skip


@pytest.fixture(scope="module")
def folders(tmp_path_factory) -> dict[str, Path]:
    """Folders of results in which one method or another is the best."""
    made_folders = {better: tmp_path_factory.mktemp(better) for better in ("adam_dsom", "pfrnn")}
    for better, folder in made_folders.items():
        for name, entry in made_results(better).items():
            lab.write(folder / f"comparison.{name}.json", entry)
    return made_folders


@pytest.mark.parametrize("better", ["adam_dsom", "pfrnn"])
def test_verdicts_follow_the_runs(folders, better):
    import run as script
    import write_report

    found = {v.claim: v for v in verdicts.verdicts(write_report.gather(script.PIECES, folders[better]))}
    (accuracy,) = (v for claim, v in found.items() if "more accurately" in claim)
    (early,) = (v for claim, v in found.items() if "fewer steps" in claim)
    assert accuracy.outcome == early.outcome == ("holds" if better == "adam_dsom" else "does not hold here")
    assert len(accuracy.evidence) == 10
    # Nothing was measured of particles, time and peaks: no verdict on them.
    assert not any("Table" in claim or "quicker" in claim or "peaks" in claim for claim in found)


def test_the_page_is_made_from_results(folders, tmp_path):
    import run as script
    import write_report

    page = tmp_path / "REPORT.md"
    write_report.write(script.PIECES, folders["adam_dsom"], tmp_path / "figures", page)
    text = page.read_text()
    links = re.findall(r"!\[[^\]]*\]\(([^)]+)\)", text)
    assert len(links) == 8 and all((tmp_path / link).stat().st_size > 5000 for link in links)
    assert "`adam_dsom`" in text and "holds" in text
    assert "FIGURES" not in text and "nan" not in text.lower()


@pytest.fixture(scope="module")
def everything() -> dict[str, Any]:
    """Made results of the pieces that the comparison is not, as small as they can be."""
    runs = {phase: [made_runs(n, 3, 0.1)] for n, phase in enumerate(comparison.PHASES)}
    summary = {phase: summarize(pool(some)) for phase, some in runs.items()}
    entry = {"summary": summary, "runs": join([run_rows("x", p, 0, 0, r[0]) for p, r in runs.items()])}
    left = {key: 0.5 for key in ("per_100_updates", "dragged", "returned", "length_median")} | {"count": 3}
    left |= {f"{key}{which}": 0.5 for key in ("pm_poor", "doubted", "redrawn") for which in ("", "_otherwise")}
    keys = ("mass_mean", "mass_gt_1pct", "top1")
    quality = {key: 0.5 for key in keys} | {f"{key}_ci95": [0.4, 0.6] for key in keys}
    point = {name: quality for name in lab.PROPOSALS} | {"contradicting": 0.1}
    seconds = dict.fromkeys(("median_s", "low_s", "high_s", "min_s", "processor_s"), 0.01)
    size = dict.fromkeys(("arguments", "result", "between", "sum"), 10.0)
    rows = [{"metres": m, "cells": 129, "free_m2": 900.0, "pm_mb": size, "pm": seconds, "map_first_s": 1.0,
             "map_mb": size} for m in (43.0, 300.0)]  # fmt: skip
    by_t_cut = {cut: entry | {"departures": left} for cut in ("0.1", "0.5")}
    found: dict[str, Any] = {
        "retention": {"adam_dsom": {"by_t_cut": by_t_cut},
                      "robust_dsom": {"by_t_cut": {"-": entry | {"departures": left | {"doubted": None,
                                                                                      "doubted_otherwise": None}}}}},
        "particles": {"500": entry},
        "odometry": {"adam_dsom": {"by_factor": {"1": summary, "2": summary}}},
        "one_scan": {"fov": {"label": "field of view [deg]", "values": [90, 360], "names": ["90", "360"],
                             "points": [point, point]}},
        "cost": {"update": {"times": {"mcl": {"prepare": None, "step": seconds, "compiling_s": 1.0}}},
                 "map_size": {"rows": rows}},
    }  # fmt: skip
    printed = {"printed": {"mcl": {"made": made({"weight_power": 1.0})} | entry}}
    return printed | {
        piece: {job: {"made": made({})} | entry for job, entry in jobs.items()} for piece, jobs in found.items()
    }


def test_sections_show_the_figures_that_are_drawn(everything):
    import run as script

    for piece in script.PIECES:
        if piece.name in everything:
            text = piece.section(everything)
            assert set(re.findall(r"FIGURES/(\w+)\.png", text)) == set(piece.figures(everything)), piece.name
            assert "nan" not in text.lower() and "None" not in text, piece.name


def test_typical_scans_are_medians():
    import multimodal

    chosen = multimodal.typical([1, 1, 1, 2, 4, 3, 3], [0.9, 0.1, 0.5, 0.3, 0.2, 0.8, 0.4])
    assert chosen == {"1": 2, "2": 3, "3 or more": 6}
    assert multimodal.typical([1], [0.2]) == {"1": 0}


def test_numbers_survive_the_file(tmp_path):
    phases = enumerate(("global", "kidnap"))
    table = join([run_rows("mcl", phase, 3 + n, 1 - n, made_runs(n, 3, 0.1)) for n, phase in phases])
    table.e_pos_m[0], table.e_theta_rad[1], table.steps[2] = np.inf, np.inf, -1
    written = {"made": {}, "by": {"0.5": {"runs": table, "share": np.float64(np.nan)}}, "bands": np.eye(3)}
    lab.write(tmp_path / "x.json", written)
    found = lab.read(tmp_path / "x.json")
    back = found["by"]["0.5"]["runs"]
    assert found["by"]["0.5"]["share"] is None and (found["bands"] == np.eye(3)).all()
    for name, column, other in zip(RunTable._fields, table, back, strict=True):
        assert other.dtype.kind == column.dtype.kind, name
        if column.dtype.kind == "f":
            np.testing.assert_allclose(other, column, rtol=1e-5)
        else:
            np.testing.assert_array_equal(other, column)


def test_retention_of_a_robust_filter_alone_has_a_page():
    import retention

    kept = lab.read(ROOT / "experiments" / "synthetic" / "results" / "retention.robust_dsom.json")
    page = retention.section({"retention": {"robust_dsom": kept}})
    assert "robust_dsom" in page and retention.TABLE_1 not in page


def test_a_damaged_result_is_named(tmp_path):
    (tmp_path / "made.a.json").write_text('{"made": ')
    with pytest.raises(UserError, match=r"made\.a\.json"):
        lab.read(tmp_path / "made.a.json")


def test_spread_of_settings_leaves_out_sequences_in_which_one_never_converged():
    """Means 1 and 3 over the sequences that both have; sequence 1 has runs of the first setting only."""
    sides = [_errors({0: [1.0, 1.0], 1: [1.0]}), _errors({0: [3.0, 3.0]})]
    estimate, low, high = verdicts.spread(sides)
    assert (estimate, low, high) == (2.0, 2.0, 2.0)


def _errors(by_sequence: dict[int, list[float]]) -> Any:
    """Converged runs with these final errors, metres."""
    rows = [(sequence, error) for sequence, errors in by_sequence.items() for error in errors]
    sequence, error = (np.array(column) for column in zip(*rows, strict=True))
    n = len(rows)
    names = np.full(n, "a")
    return RunTable(
        names, names, sequence, np.zeros(n, int), np.arange(n), *[np.zeros(n, int)] * 4, error, *[np.zeros(n)] * 5
    )
