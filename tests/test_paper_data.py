"""The way from a drawing and a Rawseeds session, or a bag of several lasers, to results: on data made here.

The paper's own data are not here (``experiments/paper_data/README.md``); these files have their form and nothing else.
"""

from __future__ import annotations

import importlib.util
import json
import math
import shutil
import sys
from pathlib import Path
from typing import Any

import ezdxf
import jax.numpy as jnp
import numpy as np
import pytest
import yaml

from dsom_jax import localize
from dsom_jax.data import load_map, save_ros_map, save_tum, se2
from dsom_jax.errors import UserError, run_cli
from dsom_jax.filters.settings import REAL
from dsom_jax.judging.run_table import read_runs
from dsom_jax.lidar import LidarConfig
from dsom_jax.protocol import command
from dsom_jax.raycast import RaycastConfig, cast_rays, make_tables
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
    monkeypatch.setattr(localize, "segments_of", lambda log, args: seen.append(log) or {}["enough"])
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
        (("--log", "two.bag"), ["two.bag", "--scan-topic", "/scanback, /scanfront"]),
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
    plan |= {"runs": 2, "particles": 40, "updates": 8, "adapt_minutes": 0, "shown": [], **changes}
    file = tmp_path / f"{name}.yaml"
    file.write_text(yaml.safe_dump(plan))
    return file


def call_script(config: Path, data: Path, folder: Path) -> None:
    script.main(script.Args(config, data, folder / "out", folder / "work"))


def test_bicocca_in_two_parts(bicocca, tmp_path, monkeypatch):
    """The shipped configuration, with the made drawing's pose, and boxes that both hold the drive."""
    maps = yaml.safe_load((FOLDER / "bicocca.yaml").read_text())["maps"]
    boxes = {"part-1": [0, 0.5, 7, 6], "part-2": [1, 1, 7, 6]}
    maps = {name: fields | {"pose": list(POSE), "box": boxes[name], "sight": 0.5} for name, fields in maps.items()}
    suites = []
    monkeypatch.setattr(command, "run_map", lambda plan, suite, *others: suites.append(suite))
    call_script(small("bicocca", tmp_path, maps=maps, methods=["mcl"]), bicocca, tmp_path)
    assert [suite.name for suite in suites] == ["bicocca, part-1", "bicocca, part-2"]
    sizes = [suite.episodes[0][1].size for suite in suites]
    # The drawing is 7 m x 6 m, with three cells around it: where the box ends inside of it, half a metre more.
    assert sizes[0] == pytest.approx((7.7, 6.2), abs=0.25) and sizes[1] == pytest.approx((6.75, 5.75), abs=0.25)
    for suite in suites:
        for _, _, episode in suite.episodes:
            assert episode.ranges.shape == (16, 181) and np.flatnonzero(episode.kidnapped).tolist() == [8]
            assert np.isfinite(episode.poses).all() and suite.lidar.mount == (0.08, 0.0, 0.0)
        # Each clip is followed by the next one, the last by the first.
        ends = [np.asarray(episode.poses) for _, _, episode in suite.episodes]
        np.testing.assert_allclose(ends[0][8:], ends[1][:8], atol=1e-6)
        np.testing.assert_allclose(ends[2][8:], ends[0][:8], atol=1e-6)


def test_upo_from_a_bag(upo, tmp_path, capsys):
    fields = yaml.safe_load((upo / "map.yaml").read_text())
    methods = ["mcl", "adam_likelihood_grid", "robust_likelihood_grid"]
    changes: dict[str, Any] = {"maps": {"alcazar": fields}, "logs": ["*.bag"], "methods": methods, "t_cuts": [0.6, 0.5]}
    config = small("upo", tmp_path, **changes)
    call_script(config, upo, tmp_path)
    out, work = tmp_path / "out" / "upo" / "alcazar", tmp_path / "work" / "upo" / "alcazar"
    stems = ["mcl", "adam_likelihood_grid-0.6", "adam_likelihood_grid-0.5", "robust_likelihood_grid"]
    for stem in stems:
        data = json.loads((out / f"{stem}.json").read_text())
        assert (data["runs"], data["particles"], data["updates"]) == (2, 40, 8)
        assert data["global"]["experiments"] == data["kidnap"]["experiments"] == 6
        assert len(read_runs(out / f"{stem}.npz").run) == 2 * 3 * 2
        assert np.load(out / f"{stem}.npz")["evolution"].shape == (3, 3, 16)
        assert (work / f"{stem}.png").is_file()
    assert {"error_evolution.png", "position_error.png"} <= {path.name for path in out.iterdir()}
    text = (tmp_path / "out" / "upo" / "REPORT.md").read_text()
    assert (
        text.count("| `adam_likelihood_grid` |  | 0.5 |") == 2
        and "`robust_likelihood_grid`, `adam_likelihood_grid-0.6`" in text
    )
    # What exists is kept; what was made otherwise is made again.
    made = {stem: (out / f"{stem}.json").stat().st_mtime_ns for stem in stems}
    data = json.loads((out / "mcl.json").read_text())
    (out / "mcl.json").write_text(json.dumps(data | {"runs": 3}))
    capsys.readouterr()
    call_script(config, upo, tmp_path)
    assert [line.split(": ")[1] for line in capsys.readouterr().out.splitlines() if line.startswith("alcazar")] == [
        "done", "kept", "kept", "kept",
    ]  # fmt: skip
    assert {stem: (out / f"{stem}.json").stat().st_mtime_ns for stem in stems[1:]} == {s: made[s] for s in stems[1:]}
    # The page comes from the results alone: a checkout without pictures and networks draws it again.
    shutil.rmtree(tmp_path / "work")
    call_script(config, upo, tmp_path)
    assert capsys.readouterr().out.count("kept") == 4
    assert (tmp_path / "out" / "upo" / "REPORT.md").read_text() == text


def test_the_pose_of_the_drawing_undoes_the_authors_transform():
    fields = yaml.safe_load((FOLDER / "bicocca.yaml").read_text())["maps"]["part-2"]
    into_drawing = np.array([-0.7, -7.6, 3.14159 / 2 - 0.005])
    np.testing.assert_allclose(se2.compose(np.array(fields["pose"]), into_drawing), 0.0, atol=1e-5)


@pytest.mark.parametrize(
    ("changes", "fragments"),
    [
        ({"logs": ["*.bog"]}, ["holds nothing like *.bog", "README"]),
        ({"methods": ["magic"]}, ["upo.yaml", "magic"]),
        ({"clips": 1}, ["upo.yaml", "at least 2"]),
        ({"methods": ["mcl@shipped"]}, ["upo.yaml", "mcl@shipped"]),
        ({"shown": ["adam_dsom"]}, ["upo.yaml", "adam_dsom"]),
        ({"t_cuts": [1.5]}, ["upo.yaml", "t_cuts between 0 and 1"]),
        ({"map_kind": "guessed"}, ["upo.yaml", "alcazar needs logs"]),
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
        call_script(config, upo, tmp_path)
    assert all(fragment in str(error.value) for fragment in fragments), error.value
    # Nothing is written before the configuration and the logs are known to be good.
    assert (tmp_path / "out").exists() == ("maps" in changes or "updates" in changes)
