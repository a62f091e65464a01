"""The protocol on real logs: what a configuration means, which filter is built of it, how a network is adapted."""

from __future__ import annotations

import json
import math
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
import yaml
from scipy.stats import binomtest

from dsom_jax import checkpoint, plotting, report, train, train_filter
from dsom_jax.cli import parse
from dsom_jax.data.suite import Suite
from dsom_jax.episode import Episode
from dsom_jax.errors import UserError
from dsom_jax.filters.methods import LEARNED
from dsom_jax.filters.settings import DRAWN
from dsom_jax.judging.metrics import measure_errors, pool, summarize
from dsom_jax.judging.run_table import join, run_rows, write_runs
from dsom_jax.lidar import LidarConfig
from dsom_jax.occupancy import from_cells
from dsom_jax.protocol import adapting, clips, command, reporting, running
from dsom_jax.protocol.plan import ProtocolPlan, Variant, read_plan, variants
from dsom_jax.run_folder import read_fields
from dsom_jax.run_resume import load_init

ROOT = Path(__file__).resolve().parents[1]
FILES = ("paper_data/upo.yaml", "paper_data/bicocca.yaml", "real/paper.yaml")
CONFIGS = {name: ROOT / "experiments" / name for name in FILES}


def test_every_method_gets_its_proposal_and_the_settings_of_the_map(monkeypatch):
    plan = ProtocolPlan(map_kind="drawn", particles=7)
    made: list[Any] = []
    monkeypatch.setattr(running, "make_proposal", lambda name, grid, lidar, settings, net, made: (name, net))
    monkeypatch.setattr(running, "with_episode", lambda proposal, episode: (*proposal, episode))
    monkeypatch.setattr(running, "make_filter", lambda *words: made.append(words))
    monkeypatch.setattr(running.checkpoint, "load", lambda folder, lidar, kind: (kind, folder))
    build = running.Builder(plan, SimpleNamespace(lidar="lidar"), lambda v: Path("old" if v.shipped else "new"))
    for variant in (
        Variant("mixture_mcl"),
        Variant("mixture_mcl_star"),
        Variant("adam_dsom", True, 0.5),
        Variant("adam_dsom", False, 0.4),
    ):
        build(variant, "grid", "episode")
    assert [words[:2] for words in made] == [
        ("mixture_mcl_sharp", ("dual_features", None)), ("mixture_mcl_sharp", ("dual_features", None, "episode")),
        ("adam_sharp", ("dsom", ("dsom", Path("old")))), ("adam_sharp", ("dsom", ("dsom", Path("new")))),
    ]  # fmt: skip
    assert all((w[4].particles, w[4].robust) == (7, DRAWN.robust) for w in made)
    assert [w[4].t_cut for w in made[2:]] == [0.5, 0.4]


@pytest.mark.parametrize("config", CONFIGS)
def test_shipped_configurations_are_the_papers(config):
    plan = read_plan(CONFIGS[config], {"runs": None})
    assert (plan.particles, plan.runs, plan.clips) == (500, 100, 3)
    assert plan.t_cuts == {"upo": (0.6,), "bicocca": (0.5,), "real": (0.6, 0.5)}[plan.name]
    kinds = {"upo": ["scanned"], "bicocca": ["drawn"] * 2, "real": ["scanned", "scanned", "drawn"]}
    assert [plan.on(name)[0].map_kind for name in plan.maps] == kinds[plan.name]


def test_t_cut_is_alg_1s_alone():
    plan = ProtocolPlan(methods=("mcl", "adam_dsom@shipped", "adam_dsom", "robust_dsom"), t_cuts=(0.6, 0.5))
    assert [v.stem for v in variants(plan)] == [
        "mcl", "adam_dsom-shipped-0.6", "adam_dsom-shipped-0.5", "adam_dsom-0.6", "adam_dsom-0.5", "robust_dsom",
    ]  # fmt: skip
    assert len({v.name for v in variants(plan)}) == len(plan.methods)


def test_a_map_replaces_what_it_names():
    own = {"learn": {"data": {"removed": 9}}}
    maps = {"a": {"yaml": "a.yaml", "logs": ["x.log"], "adapt": {"seed": 3}}, "b": {"yaml": "b.yaml", **own}}
    adapt, learn = {"seed": 1, "warmup": 5}, {"data": {"short": 0.1}}
    plan = ProtocolPlan(maps=maps, logs=("all.log",), adapt=adapt, learn=learn)
    assert plan.on("b")[0].learn == {"data": {"short": 0.1, "removed": 9}} and plan.on("a")[0].learn == plan.learn
    own, fields = plan.on("a")
    assert (own.logs, own.adapt, fields) == (("x.log",), {"seed": 3, "warmup": 5}, {"yaml": "a.yaml"})
    assert plan.on("b")[0].logs == ("all.log",) and plan.on("b")[0].adapt == plan.adapt


def made_suite(grid, far=1.0) -> Suite:
    """Two clips of three scans."""
    still = jnp.zeros((3, 3))
    clip = Episode(jnp.full((3, 4), far), still, still, jnp.zeros(3, bool), jnp.arange(3.0))
    return Suite("made, m", LidarConfig(4), (), (("m", grid, clip),) * 2)


def test_results_are_kept_only_of_the_same_map_logs_and_network(tmp_path):
    plan, variant, start = ProtocolPlan(), Variant("adam_dsom", True, 0.6), tmp_path / "net"
    start.mkdir()
    (start / "provenance.json").write_text("{}")
    grid = from_cells(np.eye(8, dtype=bool), ~np.eye(8, dtype=bool), resolution=0.1)
    first = running.identity(variant, plan, made_suite(grid), start)
    (tmp_path / f"{variant.stem}.json").write_text(json.dumps(first))
    assert not running.is_done(variant, first, tmp_path)  # no runs to compare
    (tmp_path / f"{variant.stem}.npz").touch()
    assert running.is_done(variant, first, tmp_path)
    again = running.identity(variant, plan, made_suite(grid), start)
    moved = from_cells(grid.occupied, grid.free, resolution=0.1, origin=(0.01, 0.0, 0.0))
    changed = [
        running.identity(variant, plan, made_suite(moved), start),
        running.identity(variant, plan, made_suite(grid, far=2.0), start),
        running.identity(variant, replace(plan, seed=1), made_suite(grid), start),
    ]
    (start / "provenance.json").write_text("{ }")
    changed.append(running.identity(variant, plan, made_suite(grid), start))
    assert first["powers"] == [8.0, 16.0]
    assert again == first and not any(running.is_done(variant, c, tmp_path) for c in changed)


def test_mounts_that_differ_by_rounding_are_one_lidar():
    """Two cuts of a log whose poses have six decimals."""
    a, b, c = (LidarConfig(4, mount=(x, 0.0, 0.0)) for x in (0.19999992857, 0.19999986657, 0.21))
    assert a != b and clips.rounded_mount(a) == clips.rounded_mount(b) != clips.rounded_mount(c)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ("map.yaml", "give fields, at least yaml"),
        ("{image_file: a.png}", "at least yaml, image or drawing"),
        ("{yaml: a.yaml, box: [0, 0, 1, 1]}", "box needs a drawing"),
        ("{drawing: a.dxf, units: miles, box: [0, 0, 1, 1]}", "units out of mm"),
        ("{drawing: a.dxf, box: [0, 0, 1]}", "box = "),
        ("{yaml: a.yaml, learn: }", "learn = None: give fields"),
        ("{yaml: a.yaml, adapt: 3}", "adapt = 3: give fields"),
    ],
)
def test_maps_that_are_described_wrongly(tmp_path, fields, message):
    config = tmp_path / "c.yaml"
    config.write_text(f"maps: {{hall: {fields}}}\nlogs: [a.log]\nmethods: [mcl]\nt_cuts: [0.6]\n")
    with pytest.raises(UserError, match=message) as error:
        read_plan(config, {})
    assert "hall" in str(error.value)


def test_training_is_called_with_words_that_it_knows(monkeypatch, tmp_path):
    called: list[list[str]] = []
    monkeypatch.setattr(adapting.subprocess, "run", lambda words: called.append(words) or SimpleNamespace(returncode=0))
    start, lidar = ROOT / "checkpoints" / "dsom", LidarConfig(180, -math.pi / 2, math.pi / 180)
    plan = ProtocolPlan(adapt_minutes=12.0, adapt={"learning_rate": 1e-4, "scan": {"removed": [0, 9]}})
    site = adapting.Site(tmp_path / "map.yaml", "a", lidar, tmp_path / "net")
    folder = adapting.adapt(plan, site, start)
    monkeypatch.setattr(sys, "argv", called[0][2:])
    arguments = parse(train.TrainArgs, "python -m dsom_jax.train")
    assert folder == arguments.out == tmp_path / "net-12-min" and arguments.init == start
    assert arguments.maps == (tmp_path / "map.yaml",) and arguments.minutes == 12.0
    config = arguments.read_config(read_fields(arguments.config), "c.yaml")
    assert config.scan.fov_min == config.scan.fov_max == config.model.fov_min == pytest.approx(math.pi)
    assert (config.learning_rate, config.scan.removed, config.maps_share) == (1e-4, (0, 9), 1.0)
    # It continues what is shipped, and takes its scans from the lidar.
    assert load_init(start, config.model) is not None and config.model.misfit(lidar) is None
    assert adapting.adapt(replace(plan, adapt_minutes=0.0), site, start) == start
    monkeypatch.setattr(adapting.subprocess, "run", lambda words: SimpleNamespace(returncode=2))
    with pytest.raises(UserError, match=r"training on map.yaml failed"):
        adapting.adapt(plan, site, start)
    folder.mkdir()
    with pytest.raises(UserError, match="another map"):
        adapting.adapt(plan, site._replace(map_digest="b"), start)
    written = folder.with_suffix(".json").read_bytes()
    folder.with_suffix(".json").unlink()
    with pytest.raises(UserError, match="another map"):
        adapting.adapt(plan, site, start)
    adapting.write_atomic(folder.with_suffix(".json"), written)
    with pytest.raises(UserError, match="other fields"):
        adapting.adapt(replace(plan, adapt={"warmup": 7}), site, start)


@pytest.mark.parametrize("kind", LEARNED)
def test_filters_are_trained_on_with_words_that_their_training_knows(kind, monkeypatch, tmp_path):
    called: list[list[str]] = []
    monkeypatch.setattr(adapting.subprocess, "run", lambda words: called.append(words) or SimpleNamespace(returncode=0))
    start, lidar = ROOT / "checkpoints" / kind.replace("_", "-"), LidarConfig(361, -math.pi / 2, math.pi / 360)
    plan = ProtocolPlan(learn_steps=7, learn={"warmup": 2, "data": {"removed": 9, "drive": {"update_min_d": 0.25}}})
    site = adapting.Site(tmp_path / "map.yaml", "a", lidar, tmp_path / "net")
    folder = adapting.adapt_filter(plan, site, start, kind)
    monkeypatch.setattr(sys, "argv", called[0][2:])
    arguments = parse(train_filter.TrainFilterArgs, "python -m dsom_jax.train_filter")
    assert (arguments.filter, arguments.init, arguments.steps, arguments.resume) == (kind, start, 7, True)
    assert folder == arguments.out == tmp_path / f"net-{kind}-7-steps" and arguments.maps == (tmp_path / "map.yaml",)
    config = arguments.read_config(yaml.safe_load(arguments.config.read_text()), "c.yaml")
    assert (config.warmup, config.data.removed, config.data.drive.update_min_d) == (2, 9, 0.25)
    # Half a turn in 361 beams, of which the network wants at most 120; all else is the drive's and the network's own.
    assert config.data.lidar == lidar and config.data.beam_step == 4 and config.data.drive.lidar == LidarConfig()
    assert config.model.misfit(lidar) is None and load_init(start, config.model, kind) is not None
    assert checkpoint.load(start, kind=kind).config.misfit(lidar) is not None
    assert adapting.adapt_filter(replace(plan, learn_steps=0), site, start, kind) == start


def made_like(**changes: Any) -> dict[str, Any]:
    """A result as far as comparisons ask for it."""
    same = {"map_digest": "m", "clips_digest": "c", "seed": 0, "runs": 2, "particles": 9, "clips": 3, "updates": 8}
    return same | {"network": None} | changes


@pytest.mark.parametrize(
    ("one", "other", "alike"),
    [
        ({}, {}, True),
        ({}, {"runs": 3}, False),
        ({"clips_digest": "d"}, {}, False),
        ({}, {"network": {"shipped": True, "digest": "s"}}, True),
        ({"network": {"shipped": True, "digest": "s"}}, {"network": {"shipped": False, "digest": "a"}}, True),
        ({"network": {"shipped": False, "digest": "a"}}, {"network": {"shipped": False, "digest": "a"}}, True),
        ({"network": {"shipped": False, "digest": "b"}}, {"network": {"shipped": False, "digest": "a"}}, False),
    ],
)
def test_only_what_was_made_alike_is_compared(one, other, alike):
    a, b = Variant("adam_dsom", False, 0.6), Variant("adam_hybrid", False, 0.6)
    assert reporting.comparable({a: made_like(**one), b: made_like(**other)}, a, b) == alike


@pytest.mark.parametrize("kind", LEARNED)
def test_results_of_filters_depend_on_their_own_training_alone(kind):
    plan = ProtocolPlan(learn_steps=5, learn={"warmup": 1}, adapt={"warmup": 2})
    mine, network = (running.trained_on(Variant(name), plan) for name in (kind, "adam_dsom"))
    assert mine == {"learn_steps": 5, "learn": {"warmup": 1}}
    assert network == {"adapt_minutes": 30.0, "adapt_steps": 0, "adapt": {"warmup": 2}}
    assert not running.trained_on(Variant(kind, shipped=True), plan) and not running.trained_on(Variant("mcl"), plan)


def test_each_kind_of_network_is_trained_on_once_in_a_map(monkeypatch, tmp_path):
    trained, used = [], {}
    monkeypatch.setattr(command, "adapt", lambda plan, site, start: trained.append("dsom") or Path("new-dsom"))
    monkeypatch.setattr(command, "adapt_filter", lambda *words: trained.append(words[-1]) or Path(f"new-{words[-1]}"))

    def note(variant, plan, suite, build, made_of, out, work):
        used[variant.stem] = build.networks(variant), made_of["start_digest"]

    monkeypatch.setattr(command, "run_variant", note)
    methods = ("mcl", "adam_dsom@shipped", "adam_dsom", "pf_net", "pf_net@shipped", "pfrnn")
    grid = from_cells(np.zeros((4, 4), bool), np.ones((4, 4), bool), resolution=0.1)
    start, plan = ROOT / "checkpoints" / "dsom", ProtocolPlan(methods=methods, t_cuts=(0.6, 0.5), learn_steps=3)
    command.run_map(plan, made_suite(grid), tmp_path / "m.yaml", start, "hall", tmp_path / "out", tmp_path / "work")
    shipped = {kind: checkpoint.shipped(kind) for kind in LEARNED}
    assert {stem: folder for stem, (folder, _) in used.items()} == {
        "mcl": None, "pf_net": Path("new-pf_net"), "pf_net-shipped": shipped["pf_net"], "pfrnn": Path("new-pfrnn"),
        **{f"adam_dsom-{cut}": Path("new-dsom") for cut in (0.6, 0.5)},
        **{f"adam_dsom-shipped-{cut}": start for cut in (0.6, 0.5)},
    }  # fmt: skip
    assert trained == ["dsom", "pf_net", "pfrnn"] and used["pfrnn"][1] == checkpoint.digest(shipped["pfrnn"])


@pytest.mark.parametrize(
    ("methods", "lost", "message"),
    [(("adam_dsom",), "dsom", "name the folder"), (("mcl", "pfrnn"), "pfrnn", "no pfrnn is shipped; leave it out"),
     (("mcl",), "pfrnn", None)],
)  # fmt: skip
def test_what_methods_need_is_asked_for_before_anything_runs(monkeypatch, methods, lost, message):
    monkeypatch.setattr(command.checkpoint, "shipped", lambda kind="dsom": None if kind == lost else Path(kind))
    plan, args = ProtocolPlan(methods=methods, t_cuts=(0.6,)), SimpleNamespace(checkpoint=None, config="c.yaml")
    if message is None:
        assert command.start_network(plan, args) == Path("dsom")
        return
    with pytest.raises(UserError, match=message):
        command.start_network(plan, args)


def test_networks_of_two_kinds_need_not_be_one():
    sides = {
        Variant(name, False): made_like(network={"shipped": False, "digest": name}) for name in ("pf_net", "adam_dsom")
    }
    assert reporting.comparable(sides, *sides)


def test_the_report_of_results_is_written_by_clip(tmp_path):
    (tmp_path / "hall").mkdir()
    plan = ProtocolPlan(methods=("mcl", "adam_likelihood_grid"), maps={"hall": {}}, t_cuts=(0.6,))
    rng = np.random.default_rng(0)
    for variant, off in zip(variants(plan), (1.9, 0.1), strict=True):
        rows, phases = [], {}
        for phase in reporting.CLIP_PHASES:
            parts = [measure_errors(off + 0.05 * rng.random((4, 9)), np.zeros((4, 9)), drive=clip) for clip in range(3)]
            rows += [run_rows(variant.method, phase, clip, 0, runs) for clip, runs in enumerate(parts)]
            phases[phase] = summarize(pool(parts))
        report.write_json(tmp_path / "hall" / f"{variant.stem}.json", made_like(commit="c", map_kind="s", **phases))
        bands = plotting.bands_of([off + rng.random((4, 18)) for _ in range(3)])
        write_runs(tmp_path / "hall" / f"{variant.stem}.npz", join(rows), evolution=bands)
    reporting.write_report(plan, tmp_path)
    text = (tmp_path / "REPORT.md").read_text()
    # Three clips out of three: Wilson's interval of drives, however many runs there are.
    low = 100 * binomtest(3, 3).proportion_ci(method="wilson").low
    assert text.count(f"| `mcl` |  |  | 12 | 100.0 [{low:.1f}-100.0]") == 2
    assert {"error_evolution.png", "position_error.png"} <= {path.name for path in (tmp_path / "hall").iterdir()}
    (tmp_path / "hall" / "mcl.json").write_text("[]")
    with pytest.raises(UserError, match=r"mcl\.json: not a result"):
        reporting.write_report(plan, tmp_path)


def test_a_difference_of_three_clips_is_undecided_and_of_eight_not():
    table = {}
    for count in (3, 8):
        for name, off in (("mcl", 1.5), ("pf_net", 0.2)):
            parts = [measure_errors(off + 0.01 * np.ones((2, 9)), np.zeros((2, 9))) for _ in range(count)]
            table[name] = join([run_rows(name, "global", clip, 0, runs) for clip, runs in enumerate(parts)])
        both = join([table["pf_net"], table["mcl"]])
        _, error = reporting.compare(both, Variant("pf_net"), Variant("mcl"), "global", 0)
        # All signs agree: 2 / 2^clips.
        assert error.p == pytest.approx(2 / 2**count) and error.estimate == pytest.approx(-1.3)
        row = reporting.line(Variant("pf_net"), Variant("mcl"), "global", error)
        assert row.endswith("| undecided |" if count == 3 else "| a better |")
