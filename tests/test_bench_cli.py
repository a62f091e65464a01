"""The benchmark on filters whose results are known beforehand, and its command line."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from dsom_jax import bench, checkpoint
from dsom_jax.episode import Episode
from dsom_jax.errors import UserError, run_cli
from dsom_jax.judging.run_table import paired, read_runs
from dsom_jax.lidar import LidarConfig
from dsom_jax.occupancy import from_cells

STEPS, MOVED = 24, 12
M_KEYS = {
    "experiments", "converged", "converged_ci95", "steps_median", "steps_hist", "e_pos_m", "e_theta_rad", "e_pos_ci95",
    "retention", "strict_success",
}  # fmt: skip


class State(NamedTuple):
    poses: Any


class Info(NamedTuple):
    mean: Any
    cluster: Any
    lost: Any


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Oracle:
    """Reads the truth, ``delay`` updates after the start and after the kidnapping; the mean is off by 1 m."""

    truth: Any
    delay: int = field(metadata={"static": True})
    particles: int = field(metadata={"static": True})

    def begin(self):
        return ()

    def prepare(self, memory, inputs):
        return self.truth[inputs.index], memory

    def init(self, key):
        return State(jax.random.uniform(key, (self.particles, 3)))

    def step(self, key, state, inputs, prepared):
        late = (inputs.index % MOVED) < self.delay
        luck = 0.01 * jax.random.uniform(key, ())
        place = prepared + jnp.where(late, 20.0, luck) * jnp.array([1.0, 0, 0])
        return state, Info(place + jnp.array([1.0, 0, 0]), place, jnp.where(late, 0.9, 0.0))


# Filters of the fake suite are built once per map, so all its episodes follow one path.
DELAYS = {"mcl": 99, "adam_likelihood_grid": 3, "robust_likelihood_grid": 0, "adam_dsom": 0}


def drive() -> Episode:
    rng = np.random.default_rng(0)
    poses = np.c_[rng.uniform(2, 8, (STEPS, 2)), rng.uniform(-3, 3, STEPS)]
    return Episode(
        jnp.full((STEPS, 8), 2.0), jnp.zeros((STEPS, 3)), jnp.asarray(poses, jnp.float32),
        jnp.arange(STEPS) == MOVED, jnp.arange(STEPS, dtype=jnp.float32),
    )  # fmt: skip


@pytest.fixture
def suite(monkeypatch):
    grid = from_cells(np.zeros((20, 20), bool), resolution=0.5)
    lidar = LidarConfig(beams=8, angle_increment=0.7)
    made = SimpleNamespace(name="made-up", lidar=lidar, episodes=tuple(("m", grid, drive()) for _ in range(3)))

    def load(name):
        if name != "made-up":
            raise UserError(f"--suite {name}: no such suite")
        return made

    def build(name, grid, lidar, *, particles, t_cut, weight_power, episode, checkpoint, sources):
        return Oracle(episode.poses, DELAYS[name], particles)

    monkeypatch.setattr(bench, "load_suite", load)
    monkeypatch.setattr(bench, "build_filter", build)
    return made


def command(monkeypatch, *words: str) -> None:
    monkeypatch.setattr(sys, "argv", ["bench", "--suite", "made-up", "--runs", "4", "--particles", "5", *words])
    run_cli(bench.main)


def benchmark(suite, methods, runs, particles, seed=0, progress=None):
    """The contents of ``bench.json``."""
    settings = bench.BenchSettings(runs, particles, seed=seed)
    return bench.summary(suite, bench.collect(suite, methods, settings, progress), settings)


def test_known_filters_get_their_numbers(suite):
    data = benchmark(suite, ("mcl", "adam_likelihood_grid", "robust_likelihood_grid"), runs=4, particles=5)
    assert set(data) >= {"suite", "runs", "particles", "t_cut", "seed", "weight_power", "device", "methods"}
    assert (data["suite"], data["runs"], data["particles"], data["t_cut"], data["seed"]) == ("made-up", 4, 5, 0.6, 0)
    lost, late, soon = data["methods"].values()
    for phase in ("global", "kidnap"):
        for entry in (lost, late, soon):
            assert set(entry[phase]) >= M_KEYS and entry[phase]["experiments"] == 12
            assert entry["ms_per_step"] > 0
        assert (lost[phase]["converged"], late[phase]["converged"], soon[phase]["converged"]) == (0, 1, 1)
        assert (late[phase]["steps_median"], soon[phase]["steps_median"]) == (3, 0)
        assert lost[phase]["steps_hist"] == {"0-20": 0, "20-40": 0, "40-60": 0, ">60": 0, "never": 12}
        # The paper's filters are judged by the weighted mean, ours by the heaviest cluster.
        assert late[phase]["e_pos_m"] == pytest.approx(1.005, abs=0.01) and late["estimate"] == "mean"
        assert soon[phase]["e_pos_m"] < 0.01 and soon["estimate"] == "cluster"
        assert late["estimates"]["cluster"][phase]["strict_success"] == 1 and late[phase]["strict_success"] == 0
        assert soon[phase]["retention"] == 1


def test_same_seed_same_numbers_and_methods_share_their_luck(suite):
    def numbers(seed, *methods):
        data = benchmark(suite, methods, runs=3, particles=5, seed=seed)["methods"]
        return [entry["estimates"]["cluster"] for entry in data.values()]

    first, again = (numbers(3, "adam_likelihood_grid", "robust_likelihood_grid") for _ in range(2))
    assert first == again
    assert first[0]["global"]["e_pos_m"] == first[1]["global"]["e_pos_m"]
    assert numbers(4, "robust_likelihood_grid")[0] != first[1]


def test_filters_are_built_once_per_map_unless_they_know_the_episode(suite, monkeypatch):
    built, build = [], bench.build_filter
    monkeypatch.setattr(bench, "build_filter", lambda name, *a, **k: built.append(name) or build("mcl", *a, **k))
    benchmark(suite, ("mcl", "mixture_mcl_star"), runs=1, particles=5)
    assert built == ["mcl", *["mixture_mcl_star"] * 3]


def test_one_compilation_for_episodes_of_one_shape(suite):
    data = benchmark(suite, ("robust_likelihood_grid",), runs=2, particles=6)
    assert data["methods"]["robust_likelihood_grid"]["compilations"] == 1


def test_progress_names_every_drive(suite):
    seen = []
    benchmark(suite, ("mcl",), runs=1, particles=5, progress=lambda *now: seen.append(now))
    assert seen == [("mcl", 0), ("mcl", 1), ("mcl", 2)]


def test_command_line(suite, monkeypatch, tmp_path, capsys):
    command(monkeypatch, "--methods", "mcl, robust_likelihood_grid", "--out", str(tmp_path / "out"), "--seed", "2")
    shown = capsys.readouterr().out
    assert "Global localization" in shown and "Kidnapping" in shown and "robust_likelihood_grid" in shown
    data = json.loads((tmp_path / "out" / "bench.json").read_text(), parse_constant=pytest.fail)
    assert list(data["methods"]) == ["mcl", "robust_likelihood_grid"] and data["seed"] == 2
    assert data["methods"]["mcl"]["global"]["e_pos_m"] is None
    assert {p.name for p in (tmp_path / "out").iterdir()} == {
        "bench.json", "bench.md", "report.html", "position_error.png", "converging_steps.png", "error_evolution.png",
        "map_mcl.png", "map_robust_likelihood_grid.png",
    }  # fmt: skip


def test_the_page_has_the_numbers_and_the_worst_runs(suite, monkeypatch, tmp_path, capsys):
    methods = "mcl,adam_likelihood_grid,robust_likelihood_grid"
    command(monkeypatch, "--methods", methods, "--out", str(tmp_path), "--per-run")
    assert f"look at {tmp_path / 'report.html'}" in capsys.readouterr().out.splitlines()
    data, html = json.loads((tmp_path / "bench.json").read_text()), (tmp_path / "report.html").read_text()
    marked = re.findall(r'data-key="([^"]+)" data-value="([^"]+)"', html)
    for key, value in marked:
        held: Any = data
        for part in key.split("."):
            held = held[int(part)] if isinstance(held, list) else held[part]
        assert float(value) == held
    assert len(marked) > 3 * 2 * 5 and len(data["digests"]["drives"]) == 12 and data["digests"]["networks"] == {}
    table = read_runs(tmp_path / "runs.npz")
    for method, entry in data["methods"].items():
        for n, part in enumerate(entry["by_drive"]):
            rows = table.rows((table.method == method) & (table.sequence == n))
            for phase in ("global", "kidnap"):
                assert part[phase]["converged"] == rows.converged[rows.phase == phase].mean()
            ends = rows.e_pos_m[rows.phase == "kidnap"]
            assert part["worst"]["e_pos_m"] == pytest.approx(ends[part["worst"]["run"]])
            # Runs of this suite are right at the same updates: the worst is the one that ends farthest off.
            assert part["worst"]["e_pos_m"] == pytest.approx(ends.max())
    late = data["methods"]["adam_likelihood_grid"]["by_drive"][0]["worst"]
    assert late["right"] == (STEPS - 2 * 3) / STEPS


def test_per_run_values_are_those_of_the_table(suite, monkeypatch, tmp_path):
    methods = "mcl,adam_likelihood_grid,robust_likelihood_grid"
    command(monkeypatch, "--methods", methods, "--out", str(tmp_path), "--per-run")
    data = json.loads((tmp_path / "bench.json").read_text())["methods"]
    table = read_runs(tmp_path / "runs.npz")
    # 3 methods x 2 phases x 3 sequences x 4 runs.
    assert len(table.run) == 72 and (table.part == 0).all()
    for method in methods.split(","):
        for phase in ("global", "kidnap"):
            rows = table.rows((table.method == method) & (table.phase == phase))
            assert rows.sequence.tolist() == [0] * 4 + [1] * 4 + [2] * 4 and rows.run.tolist() == [0, 1, 2, 3] * 3
            told = data[method][phase]
            assert rows.converged.mean() == told["converged"]
            if rows.converged.any():
                assert rows.e_pos_m[rows.converged].mean() == pytest.approx(told["e_pos_m"])
                assert np.median(rows.steps) == told["steps_median"] and np.nanmean(rows.retention) == told["retention"]
    late, soon = paired(table, "adam_likelihood_grid", "robust_likelihood_grid", "kidnap")
    # The mean of this made-up filter is 1 m beside its cluster, with the same luck.
    np.testing.assert_allclose(late.e_pos_m - soon.e_pos_m, 1.0, atol=1e-5)


def test_default_methods_are_those_that_can_be_run(tmp_path):
    assert "adam_dsom" not in bench.chosen_methods("", None) and "mcl" in bench.chosen_methods("", None)
    assert bench.chosen_methods("", tmp_path) == bench.STANDARD and len(bench.STANDARD) == 10
    assert bench.chosen_methods("robust_hybrid", tmp_path) == ("robust_hybrid",)
    assert bench.chosen_methods("mcl,mcl", None) == ("mcl",)


@pytest.mark.parametrize(
    ("words", "field"),
    [
        (("--runs", "0"), "--runs"),
        (("--particles", "-3"), "--particles"),
        (("--t-cut", "1.5"), "--t-cut"),
        (("--t-cut", "nan"), "--t-cut"),
        (("--weight-power", "0"), "--weight-power"),
        (("--weight-power", "nan"), "--weight-power"),
        (("--seed", "-1"), "--seed"),
        (("--methods", "mcl,magic"), "magic"),
        (("--methods", "adam_dsom"), "--checkpoint"),
        (("--methods", "robust_hybrid"), "--checkpoint"),
        (("--methods", "mcl,pf_net"), "--pf-net"),
        (("--methods", "pfrnn"), "--pfrnn"),
        (("--methods", "pfrnn", "--pfrnn", "FILE"), "FILE"),
        (("--suite", "nowhere"), "nowhere"),
        (("--out", "FILE"), "--out"),
        (("--per-run",), "--out"),
        (("--checkpoint", "FILE"), "FILE"),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2_before_any_work(suite, monkeypatch, tmp_path, capsys, words, field):
    (tmp_path / "FILE").touch()
    monkeypatch.setattr(bench, "collect", lambda *_: pytest.fail("work was begun"))
    monkeypatch.setattr(checkpoint, "shipped", lambda *_: None)
    with pytest.raises(SystemExit) as stop:
        command(monkeypatch, *(word.replace("FILE", str(tmp_path / "FILE")) for word in words))
    error = capsys.readouterr().err
    assert stop.value.code == 2
    assert error.startswith("error: ") and error.count("\n") == 1 and field in error


def test_as_a_module():
    done = subprocess.run(
        [sys.executable, "-m", "dsom_jax.bench", "--methods", "magic"], capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 2 and done.stdout == ""
    assert done.stderr.startswith("error: --methods") and done.stderr.count("\n") == 1
