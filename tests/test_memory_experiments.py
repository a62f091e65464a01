"""Scripts beside the memories: the exact filter on the grid finds and is judged, estimates are summed up."""

from __future__ import annotations

import math
import sys
from importlib import import_module
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

import tiny_world
from dsom_jax.geometry import wrap_angle
from dsom_jax.judging.run_table import RunTable, join
from dsom_jax.nn import create, evaluation_view
from dsom_jax.proposals.dsom import dsom
from dsom_jax.proposals.hybrid import Hybrid
from dsom_jax.proposals.likelihood_grid import likelihood_grid
from dsom_jax.proposals.markov_grid import MarkovGridConfig
from filters_kit import GRID, LIDAR, NETWORK

FOLDER = Path(__file__).resolve().parents[1] / "experiments"


@pytest.fixture
def script(request):
    """A script of ``experiments`` by its folder and name."""
    folder, name = request.param
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(FOLDER / folder)
        yield import_module(name)
        del sys.modules[name]


belief = pytest.mark.parametrize("script", [("robust", "belief")], indirect=True)
estimates = pytest.mark.parametrize("script", [("dsom", "estimates")], indirect=True)


@belief
def test_the_exact_filter_follows_a_drive_by_its_likelihood(script):
    episode, grid = tiny_world.drive(), tiny_world.grid()
    pool = Hybrid(likelihood_grid(grid, LIDAR, GRID), dsom(evaluation_view(create(NETWORK, 3)), grid, LIDAR))
    scans = episode.inputs._replace(ranges=script.judged_scans(pool, episode.inputs))
    layers = np.asarray(scans.ranges)
    plain = np.asarray(pool.likelihood.log_likelihood(episode.ranges[4])) / GRID.model.temper
    np.testing.assert_allclose(layers[4, 0], plain, rtol=1e-4, atol=1e-3)
    found = script.follow(script.Judged(pool.likelihood, MarkovGridConfig(), weights=jnp.array([0.5, 0.0])), scans)
    off = np.asarray(found - episode.poses)[-5:]
    # The middle of the cell that holds the truth, or of one beside it.
    assert (np.hypot(off[:, 0], off[:, 1]) < 2 * 0.25).all() and (np.abs(wrap_angle(off[:, 2])) < math.tau / 16).all()
    # An untrained network says the same of all places: nothing is found.
    lost = script.follow(script.Judged(pool.likelihood, MarkovGridConfig(), weights=jnp.array([0.0, 1.0])), scans)
    assert np.abs(np.asarray(lost - episode.poses)[-5:, :2]).max() > 0.5


@belief
def test_a_belief_is_judged_in_each_phase(script):
    """Seven updates at the truth, then carried away: two astray, five back that count as found, two kept, one not."""
    episode = tiny_world.drive(17)
    carried = jnp.zeros(17, bool).at[7].set(True)
    poses = np.array(episode.poses)
    poses[[7, 8, 16], 0] += 3.0
    found = script.judge(poses, episode._replace(kidnapped=carried))
    first, second = found["global"][0], found["kidnap"][0]
    assert (first["steps"], first["kept"], first["inside"]) == (0, 1.0, 1.0)
    assert (second["steps"], second["kept"], second["inside"]) == (2, pytest.approx(2 / 3), pytest.approx(0.7))
    assert second["e_pos_m"] == pytest.approx(3.0, abs=1e-5)
    row = {"temper": 0.05, "power": 0.3, "phases": found}
    assert script.show(row, "kidnap").endswith("converged 1 of 1, kept 0.67, inside 0.70  [2/0.70/3.0]")


def runs_of(phase, retention):
    """Two drives of two runs each in one phase; the last run is found late."""
    return RunTable(
        np.full(4, "adam_dsom"), np.full(4, phase), np.array([0, 0, 1, 1]), np.zeros(4, int), np.array([0, 1, 0, 1]),
        np.array([2, 20, 3, 21]), np.array([0.1, 0.2, 0.3, 0.6]), np.full(4, 0.01), np.array(retention),
    )  # fmt: skip


@estimates
def test_rows_of_estimates_are_summed_up_by_phase_and_drive(script):
    table = join([runs_of("global", [1, 1, np.nan, 0.5]), runs_of("kidnap", [1] * 4)])
    found = script.summary(table)["global"]
    assert found["e_pos_m"] == pytest.approx(0.3) and found["e_pos_m_of_drives"] == pytest.approx([0.15, 0.45])
    assert (found["within_20"], found["retention"]) == (0.75, pytest.approx(2.5 / 3))
    result = {"global": found | {"retention": None}, "kidnap": found}
    line = script.show({"variant": "16", "suite": "s", "particles": 200, "runs": 2, "result": result})
    assert line.split(" | ")[3:] == ["0.300 / 0.300", "0.750 / 0.750", "- / 0.833"]
