"""The way from a drawing and a Rawseeds session, or a bag of several lasers, to results: on data made here.

The paper's own data are not here (``experiments/paper_data/README.md``); these files have their form and nothing else.
"""

from __future__ import annotations

import importlib.util
import json
import math
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import ezdxf
import jax.numpy as jnp
import numpy as np
import pytest
import yaml

from dsom_jax import localize, train
from dsom_jax.cli import parse
from dsom_jax.data import load_map, save_ros_map, save_tum, se2
from dsom_jax.errors import UserError, run_cli
from dsom_jax.filters.methods import DRAWN, REAL
from dsom_jax.lidar import LidarConfig
from dsom_jax.raycast import RaycastConfig, cast_rays, make_tables
from dsom_jax.report import read_runs
from fixtures.make_bag import write_bag
from tiny_log import UPDATES, path

FOLDER = Path(__file__).resolve().parents[1] / "experiments" / "paper_data"
SESSION, START = "Bicocca_2009-02-25b", 1235603336.0
POSE = (7.6, -0.7, -1.2)
"""Of the drawing in the frame of the ground truth."""
PLAN = f"drawing: Drawings_02.dxf\nunits: m\npose: {list(POSE)}\nclearance: 0.25\n"
SICK = LidarConfig(beams=181, angle_min=-math.pi / 2, angle_increment=math.pi / 180, range_max=30.0, mount=(0.08, 0, 0))


def load_script() -> Any:
    """``experiments/paper_data/run.py`` as a module."""
    spec = importlib.util.spec_from_file_location("paper_data_run", FOLDER / "run.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


script = load_script()


def draw(file: Path) -> None:
    """A hall of 7 m x 6 m with a round pillar, a nook and a cupboard in a block; unitless, as old drawings are."""
    document = ezdxf.new("R2010", units=0)
    msp = document.modelspace()
    corners = [(20, 30), (27, 30), (27, 36), (23, 36), (23, 34.5), (20, 34.5)]
    for a, b in zip(corners, [*corners[1:], corners[0]], strict=True):
        msp.add_line(a, b)
    msp.add_circle((25.5, 31.2), 0.4)
    document.blocks.new("CUPBOARD").add_lwpolyline([(0, 0), (1, 0), (1, 0.5), (0, 0.5)], close=True)
    msp.add_blockref("CUPBOARD", (25, 35.5))
    document.saveas(file)


def drive() -> np.ndarray:
    """(T, 3) circle in the hall, in the frame of the ground truth."""
    return se2.compose(np.array(POSE), path(np.array([23.4, 31.4, 0.3])))


def cast(grid, poses, lidar) -> np.ndarray:
    tables = make_tables(grid, RaycastConfig("exact", surface=REAL.robust_raycast.surface), lidar.range_max)
    return np.asarray(cast_rays(tables, jnp.asarray(poses, jnp.float32), lidar))


@pytest.fixture(scope="module")
def bicocca(tmp_path_factory):
    """Drawing, ``plan.yaml`` and session in one folder."""
    folder = tmp_path_factory.mktemp("bicocca")
    draw(folder / "Drawings_02.dxf")
    (folder / "plan.yaml").write_text(PLAN)
    truth = drive()
    ranges = np.minimum(cast(load_map(folder / "plan.yaml"), truth, SICK), 81.91)
    odometry = path(np.array([0.0, 0.0, 0.0]))
    files: dict[str, list[str]] = {"SICK_FRONT": [], "ODOMETRY_XYT": [], "GT-extended": []}
    for n, (scan, odom, pose) in enumerate(zip(ranges, odometry, truth, strict=True)):
        stamp = f"{START + 0.5 * n:.6f}"
        files["SICK_FRONT"].append(f"{stamp}, 181, 0, " + ", ".join(f"{r:.3f}" for r in scan))
        files["ODOMETRY_XYT"].append(f"{stamp}, {n}, 0, 0, " + ", ".join(f"{v:.6f}" for v in odom))
        files["GT-extended"].append(f"{stamp}, " + ", ".join(f"{v:.6f}" for v in pose))
    for kind, lines in files.items():
        (folder / f"{SESSION}-{kind}.csv").write_text("\n".join(lines) + "\n")
    return folder


@pytest.fixture(scope="module")
def upo(tmp_path_factory):
    """A bag with two lasers, its reference and a ROS map."""
    folder = tmp_path_factory.mktemp("upo")
    draw(folder / "plan.dxf")
    (folder / "plan.yaml").write_text(PLAN.replace("Drawings_02", "plan"))
    grid = load_map(folder / "plan.yaml")
    save_ros_map(grid, folder / "map.yaml")
    lidar = LidarConfig(beams=8, angle_min=-1.0, angle_increment=0.5, range_min=0.1, range_max=8.0)
    truth, odometry, entries = drive(), path(np.zeros(3)), []
    for n, scan in enumerate(cast(grid, truth, lidar)):
        stamp = 100.0 + 0.5 * n
        entries += [(stamp, "/pose", "odom", tuple(odometry[n])), (stamp, "/scanfront", "scan", (scan, "base_link"))]
        entries.append((stamp, "/scanback", "scan", (scan + 1, "base_link")))
    save_tum(write_bag(folder, "bag", entries).with_suffix(".tum"), 100.0 + 0.5 * np.arange(UPDATES), truth)
    return folder


def call(monkeypatch, tmp_path, *words) -> dict[str, Any]:
    """``summary.json`` of a call of localize."""
    common = ["--out", tmp_path / "out", "--runs", 3, "--segments", 2, "--steps-per-segment", 15, "--particles", 100]
    monkeypatch.setattr(sys, "argv", ["localize", *map(str, [*words, *common])])
    run_cli(localize.main)
    return json.loads((tmp_path / "out" / "summary.json").read_text())


def test_localize_on_a_drawing_with_a_session(bicocca, monkeypatch, tmp_path):
    summary = call(monkeypatch, tmp_path, "--map", bicocca / "plan.yaml", "--log", bicocca)
    assert [segment["on_map"] for segment in summary["by_segment"]] == [1, 1]
    # Half a turn of exact beams in a hall without symmetry.
    assert summary["converged"] == 1 and summary["e_pos_m_median"] < 0.15


def test_localize_takes_the_laser_that_is_named(upo, monkeypatch, tmp_path):
    seen: list[Any] = []
    monkeypatch.setattr(localize, "cut", lambda log, args: seen.append(log) or {}["enough"])
    for laser, shortest in (("/scanfront", 0.0), ("/scanback", 1.0)):
        words = ("--map", upo / "map.yaml", "--log", upo / "made.bag", "--scan-topic", laser, "--odom-topic", "/pose")
        with pytest.raises(KeyError, match="enough"):
            call(monkeypatch, tmp_path, *words)
        assert np.nanmin(seen[-1].ranges) > shortest
    assert np.nanmin(seen[1].ranges) - np.nanmin(seen[0].ranges) == pytest.approx(1.0, abs=1e-5)


@pytest.mark.parametrize(
    ("words", "fragments"),
    [
        (("--map", "Drawings_02.dxf"), ["Drawings_02.dxf", "$INSUNITS = 0", "units: m"]),
        (("--map", "nowhere.dxf"), ["nowhere.dxf", "no such drawing"]),
        (("--map", "spoilt.yaml"), ["spoilt.yaml", "unknown field scale"]),
        (("--log", f"{SESSION}-SICK_REAR.csv"), ["SICK_REAR.csv", "no such"]),
        (("--log", f"{SESSION}-GT-extended.csv"), ["GT-extended.csv", "SICK_FRONT.csv"]),
        (("--log", "two.bag"), ["two.bag", "scan_topic", "/scanback, /scanfront"]),
    ],
)
def test_bad_input_is_one_line(bicocca, upo, monkeypatch, tmp_path, capfd, words, fragments):
    for file in [*bicocca.iterdir(), *upo.glob("made.bag")]:
        (tmp_path / file.name.replace("made", "two")).symlink_to(file)
    (tmp_path / "spoilt.yaml").write_text(PLAN + "scale: 2\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["localize", "--map", "plan.yaml", "--log", ".", "--out", "out", *words])
    with pytest.raises(SystemExit) as stop:
        run_cli(localize.main)
    error = capfd.readouterr().err
    assert stop.value.code == 2 and error.startswith("error: ") and error.count("\n") == 1
    assert all(fragment in error for fragment in fragments), error
    assert not (tmp_path / "out").exists()


def small(name: str, tmp_path: Path, **changes: Any) -> Path:
    """A shipped configuration, cut down."""
    plan = yaml.safe_load((FOLDER / f"{name}.yaml").read_text())
    plan |= {"runs": 2, "particles": 40, "updates": 8, "adapt_minutes": 0, **changes}
    file = tmp_path / f"{name}.yaml"
    file.write_text(yaml.safe_dump(plan))
    return file


def check_results(folder: Path, methods: list[str], particles: int = 40) -> dict[str, Any]:
    data = json.loads((folder / "bench.json").read_text())
    assert list(data["methods"]) == methods and (data["runs"], data["particles"]) == (2, particles)
    for entry in data["methods"].values():
        assert entry["global"]["experiments"] == entry["kidnap"]["experiments"] == 6
    table = read_runs(folder / "runs.npz")
    assert len(table.run) == 2 * len(methods) * 3 * 2
    assert (folder / "error_evolution.png").is_file() and (folder / "bench.md").is_file()
    return data


def test_bicocca_in_two_parts(bicocca, tmp_path, monkeypatch):
    """The shipped configuration, with the made drawing's pose, and boxes that both hold the drive."""
    maps = yaml.safe_load((FOLDER / "bicocca.yaml").read_text())["maps"]
    boxes = {"part-1": [0, 0.5, 7, 6], "part-2": [1, 1, 7, 6]}
    maps = {name: fields | {"pose": list(POSE), "box": boxes[name], "sight": 0.5} for name, fields in maps.items()}
    suites = []
    monkeypatch.setattr(script, "run_map", lambda plan, suite, network, folder: suites.append((suite, network, folder)))
    script.main(script.Args(small("bicocca", tmp_path, maps=maps, methods=["mcl"]), bicocca, tmp_path / "out"))
    assert [(s.name, network, folder.name) for s, network, folder in suites] == [
        ("bicocca, part-1", None, "part-1"), ("bicocca, part-2", None, "part-2"),
    ]  # fmt: skip
    sizes = [suite.episodes[0][1].size for suite, _, _ in suites]
    # The drawing is 7 m x 6 m, with three cells around it: where the box ends inside of it, half a metre more.
    assert sizes[0] == pytest.approx((7.7, 6.2), abs=0.25) and sizes[1] == pytest.approx((6.75, 5.75), abs=0.25)
    for suite, _, _ in suites:
        for _, _, episode in suite.episodes:
            assert episode.ranges.shape == (16, 181) and np.flatnonzero(episode.kidnapped).tolist() == [8]
            assert np.isfinite(episode.poses).all() and suite.lidar.mount == (0.08, 0.0, 0.0)
        # Each clip is followed by the next one, the last by the first.
        ends = [np.asarray(episode.poses) for _, _, episode in suite.episodes]
        np.testing.assert_allclose(ends[0][8:], ends[1][:8], atol=1e-6)
        np.testing.assert_allclose(ends[2][8:], ends[0][:8], atol=1e-6)


def test_upo_from_a_bag(upo, tmp_path):
    fields = yaml.safe_load((upo / "map.yaml").read_text())
    config = small("upo", tmp_path, maps={"alcazar": fields}, logs=["*.bag"], methods=["mcl"])
    script.main(script.Args(config, upo, tmp_path / "out"))
    data = json.loads((tmp_path / "out" / "alcazar" / "bench.json").read_text())
    assert list(data["methods"]) == ["mcl"] and (data["runs"], data["particles"], data["t_cut"]) == (2, 40, 0.6)
    for phase in ("global", "kidnap"):
        assert data["methods"]["mcl"][phase]["experiments"] == 6
    assert len(read_runs(tmp_path / "out" / "alcazar" / "runs.npz").run) == 2 * 3 * 2
    assert {"error_evolution.png", "bench.md"} <= {p.name for p in (tmp_path / "out" / "alcazar").iterdir()}


def test_every_method_gets_its_proposal_and_the_settings_of_the_map(monkeypatch, tmp_path):
    plan = script.Plan(
        methods=("mixture_mcl", "mixture_mcl_star", "adam_dsom"), map_kind="drawn", particles=7, t_cut=0.5
    )
    suite = SimpleNamespace(lidar="lidar", episodes=(("m", "grid", "episode"),))
    made: list[Any] = []
    monkeypatch.setattr(script, "make_proposal", lambda name, grid, lidar, settings, net: (name, net))
    monkeypatch.setattr(script, "with_episode", lambda proposal, episode: (*proposal, episode))
    monkeypatch.setattr(script, "make_filter", lambda *words: made.append(words))
    monkeypatch.setattr(
        script.bench, "run_method", lambda name, suite, keys, build, bar: build(name, *suite.episodes[0])
    )
    monkeypatch.setattr(script.bench, "summary", lambda *_: {}["enough"])
    with pytest.raises(KeyError, match="enough"):
        script.run_map(plan, suite, "network", tmp_path)
    assert [words[:2] for words in made] == [
        ("mixture_mcl", ("dual_features", "network")), ("mixture_mcl", ("dual_features", "network", "episode")),
        ("adam", ("dsom", "network")),
    ]  # fmt: skip
    assert all((w[4].particles, w[4].t_cut, w[4].robust) == (7, 0.5, DRAWN.robust) for w in made)


@pytest.mark.parametrize("name", ["upo", "bicocca"])
def test_shipped_configurations_are_the_papers(name):
    plan = script.read_plan(SimpleNamespace(config=FOLDER / f"{name}.yaml", runs=None, adapt_minutes=None))
    assert (plan.particles, plan.runs, plan.clips) == (500, 100, 3)
    assert plan.t_cut == {"upo": 0.6, "bicocca": 0.5}[name]
    assert plan.map_kind == {"upo": "scanned", "bicocca": "drawn"}[name]
    assert len(plan.maps) == {"upo": 1, "bicocca": 2}[name]


def test_the_pose_of_the_drawing_undoes_the_authors_transform():
    fields = yaml.safe_load((FOLDER / "bicocca.yaml").read_text())["maps"]["part-2"]
    into_drawing = np.array([-0.7, -7.6, 3.14159 / 2 - 0.005])
    np.testing.assert_allclose(se2.compose(np.array(fields["pose"]), into_drawing), 0.0, atol=1e-5)


def test_training_is_called_with_words_that_it_knows(monkeypatch, tmp_path):
    called: list[list[str]] = []
    monkeypatch.setattr(script.subprocess, "run", lambda words: called.append(words) or SimpleNamespace(returncode=0))
    plan = script.Plan(adapt_minutes=12.0, methods=("mcl", "adam_dsom"))
    folder = script.network_for(plan, tmp_path / "map.yaml", tmp_path / "start", tmp_path / "net")
    monkeypatch.setattr(sys, "argv", called[0][2:])
    arguments = parse(train.Arguments, "python -m dsom_jax.train")
    assert folder == arguments.out == tmp_path / "net" and arguments.init == tmp_path / "start"
    assert arguments.maps == (tmp_path / "map.yaml",) and arguments.minutes == 12.0
    assert script.network_for(replace(plan, adapt_minutes=0.0), Path("m"), Path("start"), tmp_path) == Path("start")
    assert script.network_for(script.Plan(methods=("mcl",)), Path("m"), None, tmp_path) is None
    monkeypatch.setattr(script.subprocess, "run", lambda words: SimpleNamespace(returncode=2))
    with pytest.raises(UserError, match=r"training on map.yaml failed"):
        script.network_for(plan, tmp_path / "map.yaml", tmp_path / "start", tmp_path / "net")


@pytest.mark.parametrize(
    ("changes", "fragments"),
    [
        ({"logs": ["*.bog"]}, ["holds nothing like *.bog", "README"]),
        ({"methods": ["magic"]}, ["upo.yaml", "magic"]),
        ({"clips": 1}, ["upo.yaml", "at least 2"]),
        ({"speed": 1}, ["upo.yaml", "unknown field speed"]),
        ({"updates": 43}, ["alcazar", "clips of 43 updates", "3 are wanted"]),
        ({"maps": {"alcazar": {"image": "gone.pgm"}}}, ["alcazar.yaml", "'resolution'"]),
        ({"maps": {"alcazar": {"drawing": "gone.dxf", "box": [0, 0, 1, 1]}}}, ["gone.dxf", "no such drawing"]),
    ],
)
def test_spoilt_configurations(upo, tmp_path, changes, fragments):
    fields = yaml.safe_load((upo / "map.yaml").read_text())
    config = small("upo", tmp_path, **{"maps": {"alcazar": fields}, "logs": ["*.bag"], "methods": ["mcl"], **changes})
    with pytest.raises(UserError) as error:
        script.main(script.Args(config, upo, tmp_path / "out"))
    assert all(fragment in str(error.value) for fragment in fragments), error.value
    # Nothing is written before the configuration and the logs are known to be good.
    assert (tmp_path / "out").exists() == ("maps" in changes or "updates" in changes)
