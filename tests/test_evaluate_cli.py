"""Quality of probability maps made by hand, and ``python -m dsom_jax.evaluate``."""

from __future__ import annotations

import json
import math
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dsom_jax import checkpoint, evaluate
from dsom_jax import pose_grid as pg
from dsom_jax.errors import run_cli
from dsom_jax.judging import quality
from dsom_jax.lidar import LidarConfig
from dsom_jax.nn import DSOMConfig, create
from dsom_jax.occupancy import from_cells

SIDE, HEADINGS, RESOLUTION = 40, 8, 0.25
KEYS = {
    "scans", "mass_median", "mass_mean", "mass_gt_1pct", "mass_gt_10pct", "top1", "kld", "peaks_mean", "ms_per_scan",
}  # fmt: skip


def judged(masses, cell):
    """Quality of PM with the given masses for a truth in the middle of ``cell``."""
    grid = from_cells(np.zeros((SIDE, SIDE), bool), resolution=RESOLUTION, origin=(3.0, -2.0, 0.7))
    poses = pg.over(grid, HEADINGS)
    mass = np.zeros((SIDE, SIDE, HEADINGS), np.float32)
    for place, weight in masses.items():
        mass[place] = weight
    truth = pg.cell_pose(poses, *(jnp.float32(c) for c in cell))
    return jax.jit(quality.quality)(pg.probability_map(poses, jnp.asarray(mass)), grid.free, truth)


def test_all_probability_at_the_truth():
    score = judged({(10, 20, 3): 5.0}, (10, 20, 3))
    assert float(score.mass) == pytest.approx(1.0) and bool(score.top1) and int(score.peaks) == 1
    assert float(score.level) == pytest.approx(0.5)


def test_three_places_of_which_the_second_is_right():
    score = judged({(5, 5, 0): 6.0, (30, 30, 4): 3.0, (5, 30, 2): 1.0}, (30, 30, 4))
    assert float(score.mass) == pytest.approx(0.3) and not bool(score.top1)
    assert int(score.peaks) == 3 and float(score.level) == pytest.approx(0.6 + 0.15)


def test_places_below_a_tenth_of_the_best_are_no_peaks_and_neighbours_are_one():
    masses = {(5, 5, 0): 10.0, (6, 5, 0): 9.0, (30, 30, 4): 1.0}
    assert int(judged(masses, (5, 5, 0)).peaks) == 1
    assert int(judged({**masses, (30, 30, 4): 4.0}, (5, 5, 0)).peaks) == 2


@pytest.mark.parametrize(("offset", "inside"), [(3, True), (5, False)])
def test_mass_counts_up_to_a_metre(offset, inside):
    assert float(judged({(10 + offset, 20, 3): 1.0}, (10, 20, 3)).mass) == float(inside)


def test_divergence_of_the_ground_truth_itself_is_nothing_and_of_ignorance_the_missing_information():
    grid = from_cells(np.zeros((SIDE, SIDE), bool), resolution=RESOLUTION)
    poses, free = pg.over(grid, HEADINGS), jnp.ones((SIDE, SIDE), bool)
    truth = pg.cell_pose(poses, jnp.float32(20), jnp.float32(20), jnp.float32(3))
    even = jnp.full(poses.shape, 1.0 / math.prod(poses.shape))
    # Eq 7 at a heading of the grid: 7 x 7 cells of a separable Gaussian with sigma 3.
    kernel = np.exp(-0.5 * (np.arange(-3, 4) / 3.0) ** 2)
    kernel /= kernel.sum()
    ground = np.zeros(poses.shape)
    ground[17:24, 17:24, 3] = np.outer(kernel, kernel)
    assert float(quality.divergence(jnp.asarray(ground, jnp.float32), free, poses, truth)) == pytest.approx(0, abs=1e-4)
    entropy = -2 * (kernel * np.log(kernel)).sum()
    missing = math.log(math.prod(poses.shape)) - entropy
    assert float(quality.divergence(even, free, poses, truth)) == pytest.approx(missing, rel=1e-4)


def test_calibration_of_levels_that_are_uniform_is_the_diagonal():
    p, share = quality.calibration((np.arange(1000) + 0.5) / 1000)
    np.testing.assert_allclose(share, p, atol=1e-3)


@pytest.mark.parametrize("fov", [360.0, 180.0, 91.0])
def test_a_narrow_view_looks_ahead(fov):
    whole = LidarConfig(360, -math.pi, math.radians(1), 0.0, 10.0)
    angles = evaluate.narrowed(whole, fov).angles()
    assert len(angles) == fov and abs(angles.mean()) < math.radians(1)
    assert np.isin(angles.round(4), whole.angles().round(4)).all()


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """A small map and a network that knows nothing."""
    folder = tmp_path_factory.mktemp("evaluate")
    cells = np.full((40, 48), 254, np.uint8)
    cells[[0, -1]] = cells[:, [0, -1]] = cells[10, 5:20] = 0
    (folder / "map.pgm").write_bytes(b"P5\n48 40\n255\n" + cells.tobytes())
    (folder / "map.yaml").write_text(
        "image: map.pgm\nresolution: 0.25\norigin: [1.0, 0.0, 0.0]\n"
        "negate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"
    )
    checkpoint.save(folder / "network", create(DSOMConfig(width=2, headings=4, resolution=0.25, fov_min=1.0)))
    return folder


def call(files, monkeypatch, *words):
    monkeypatch.chdir(files)
    monkeypatch.setattr(sys, "argv", ["evaluate", *words])
    run_cli(evaluate.main)


def test_command_line(files, monkeypatch, capsys):
    words = ("--checkpoint", "network", "--maps", "map.yaml", "--scans", "3", "--fov", "180", "--obstacles", "0")
    results = []
    for out in ("a", "b"):
        call(files, monkeypatch, *words, "--out", out)
        results.append(json.loads((files / out / "evaluate.json").read_text()))
    assert list(results[0]) == list(evaluate.PROPOSALS) and all(set(row) == KEYS for row in results[0].values())
    without_times = [{name: row | {"ms_per_scan": 0} for name, row in result.items()} for result in results]
    assert without_times[0] == without_times[1]
    assert results[0]["likelihood_grid"]["mass_median"] > 10 * results[0]["uniform"]["mass_median"]
    pictures = {path.name for path in (files / "a").glob("*.png")}
    assert {"calibration.png", "worst_dsom.png", "worst_likelihood_grid.png"} <= pictures
    assert "likelihood_grid" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "fragment"),
    [
        (("--fov", "0"), "--fov 0"),
        (("--scans", "0"), "--scans 0"),
        (("--obstacles", "-1"), "--obstacles -1"),
        (("--maps", "nowhere.yaml"), "nowhere.yaml"),
        (("--fov", "30"), "field of view 30"),
    ],
)
def test_bad_input(files, monkeypatch, capsys, words, fragment):
    with pytest.raises(SystemExit) as stop:
        call(files, monkeypatch, "--checkpoint", "network", "--out", "c", *words)
    error = capsys.readouterr().err
    assert stop.value.code == 2 and fragment in error and error.count("\n") == 1
