"""Good files of every kind, small: what the mutations begin with. No JAX is compiled to make them."""

from __future__ import annotations

import io
import json
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import ezdxf
import numpy as np
from PIL import Image

from dsom_jax import bench, evaluate, localize_args, train, train_filter
from dsom_jax.cli import parse
from dsom_jax.data import load_log, load_map, load_tum
from dsom_jax.data.documents import read_json, read_yaml
from dsom_jax.data.suite import decode
from dsom_jax.data.trajectory import with_reference
from dsom_jax.judging.run_table import RunTable, read_runs
from fixtures.make_bag import write_bag

SCANS, BEAMS = 24, 19
PIXELS = np.full((16, 20), 254, np.uint8)
PIXELS[[0, -1]] = PIXELS[:, [0, -1]] = 0
PIXELS[5:8, 6:9] = 205


@dataclass(frozen=True)
class Target:
    """What is fuzzed.

    Attributes:
        name: of the kind of input.
        files: those that are mutated, one or two at a time.
        load: reads the folder; whatever it returns is well.
    """

    name: str
    files: tuple[str, ...]
    load: Callable[[Path], Any]


def map_yaml(image: str) -> str:
    fields = "resolution: 0.25\norigin: [-1.5, -2.0, 0.1]\nnegate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"
    return f"image: {image}\nmode: trinary\n{fields}"


def drive() -> np.ndarray:
    """(N, 3) poses of a circle."""
    turn = np.linspace(0, 5, SCANS)
    return np.stack([1.5 + np.cos(turn), 1.0 + np.sin(turn), turn + math.pi / 2], axis=-1)


def carmen(kind: str) -> str:
    lines = ["# made by hand", "PARAM robot_frontlaser_offset 0.1"]
    for n, (x, y, theta) in enumerate(drive()):
        ranges = " ".join(f"{1 + 0.1 * ((n + b) % 7):.2f}" for b in range(BEAMS))
        pose, stamp = f"{x:.4f} {y:.4f} {theta:.4f}", f"{100 + n}.5 host {n}"
        head = "0 -1.5708 3.14159 0.174533 8.0 0.01 0 "
        lines += {
            "flaser": [f"FLASER {BEAMS} {ranges} {pose} {pose} {stamp}"],
            "robotlaser": [f"ROBOTLASER1 {head}{BEAMS} {ranges} 0 {pose} {pose} 0 0 0 0 0 {stamp}"],
            "rawlaser": [f"ODOM {pose} 0 0 0 {stamp}", f"RAWLASER1 {head}{BEAMS} {ranges} 0 {stamp}"],
        }[kind]
    return "\n".join(lines) + "\n"


def tum() -> str:
    rows = enumerate(drive())
    return "".join(
        f"{100 + n}.5 {x:.4f} {y:.4f} 0 0 0 {math.sin(a / 2):.6f} {math.cos(a / 2):.6f}\n" for n, (x, y, a) in rows
    )


def drawing(path: Path) -> None:
    document = ezdxf.new("R2010", units=6)
    document.layers.add("WALLS")
    block = document.blocks.new("PILLAR")
    block.add_lwpolyline([(0, 0), (0.3, 0), (0.3, 0.3)], close=True)
    space = document.modelspace()
    space.add_lwpolyline([(0, 0), (6, 0), (6, 4), (0, 4)], close=True, dxfattribs={"layer": "WALLS"})
    space.add_line((3, 0), (3, 2))
    space.add_arc((4, 2), 0.5, 0, 90)
    space.add_circle((1, 1), 0.2)
    space.add_ellipse((4.5, 3), (0.4, 0), 0.5)
    space.add_spline([(1, 3), (1.3, 3.4), (1.6, 3)])
    space.add_blockref("PILLAR", (2, 2), dxfattribs={"column_count": 2, "column_spacing": 0.6})
    space.add_text("room")
    document.saveas(path)


def rawseeds(folder: Path) -> None:
    for name, rows in (
        ("SICK_FRONT", [[100 + n, BEAMS, 0, *(1 + 0.1 * ((n + b) % 7) for b in range(BEAMS))] for n in range(SCANS)]),
        ("ODOMETRY_XYT", [[100 + n, n, n, n, *pose] for n, pose in enumerate(drive().tolist())]),
        ("GROUNDTRUTH", [[100 + n, *pose, *[0] * 9] for n, pose in enumerate(drive().tolist())]),
    ):
        text = "".join(", ".join(f"{v:.6g}" for v in row) + "\n" for row in rows)
        (folder / f"Made-{name}.csv").write_text(text)


def bags(folder: Path) -> None:
    entries: list[Any] = []
    for n, (x, y, theta) in enumerate(drive()):
        entries.append((100.0 + n, "/odom", "odom", (x, y, theta)))
        entries.append((100.0 + n, "/scan", "scan", (np.full(12, 1 + 0.1 * (n % 7)),)))
    for kind in ("bag", "mcap", "db3"):
        (folder / kind).mkdir()
        write_bag(folder / kind, kind, entries)


def make(folder: Path) -> None:
    """Write every seed into ``folder``."""
    for name in ("room.pgm", "room.png", "room.bmp", "room.jpg", "room.tif"):
        Image.fromarray(PIXELS).save(folder / name)
    Image.fromarray(np.dstack([PIXELS] * 3 + [np.full_like(PIXELS, 255)])).save(folder / "rgba.png")
    plain = " ".join(map(str, PIXELS.ravel()))
    (folder / "plain.pgm").write_text(f"P2\n# by hand\n20 16\n255\n{plain}\n")
    for image in ("room.pgm", "room.png", "room.bmp", "room.jpg", "room.tif", "rgba.png", "plain.pgm"):
        (folder / f"{image}.yaml").write_text(map_yaml(image))
    drawing(folder / "plan.dxf")
    fields = "resolution: 0.1\nunits: m\nexclude: [TEXT]\nstart: [1.5, 2.0]\npose: [1, 2, 0.5]\ncrop: [0, 0, 6, 4]\n"
    (folder / "plan.yaml").write_text("drawing: plan.dxf\n" + fields)
    for kind in ("flaser", "robotlaser", "rawlaser"):
        (folder / f"{kind}.log").write_text(carmen(kind))
    (folder / "meta.yaml").write_text(
        f"beams: {BEAMS}\nangle_min: -1.5708\nangle_increment: 0.174533\nrange_min: 0.1\nrange_no_return: 8.0\n"
        "mount: [0.1, 0.0, 0.0]\nupside_down: false\n"
    )
    (folder / "truth.tum").write_text(tum())
    rawseeds(folder)
    bags(folder)
    (folder / "suite.toml").write_text(
        'name = "mine"\n[lidar]\nbeams = 19\nangle_min = -1.5\nangle_increment = 0.17\n'
        '[[episodes]]\nmap = "room.pgm.yaml"\nseed = 3\nupdates = [4, 4]\nobstacles = 1\n'
    )
    columns = dict(method=np.array(["a", "b"]), phase=np.array(["global"] * 2))
    columns |= {name: np.arange(2) for name in RunTable._fields[2:9]}
    columns |= {name: np.ones(2) for name in RunTable._fields[9:]}
    np.savez_compressed(folder / "runs.npz", **columns)
    (folder / "run.json").write_text(json.dumps({"config": {"seed": 1}, "maps": ["a"], "total": None, "seconds": 1.5}))
    suite: Any = dict(lidar=np.array([4.0, -1.0, 0.5, 8.0]), names=np.array(["train-0"]), shape=np.array([4, 4]))
    suite |= dict(resolution=np.array(0.5), occupied=np.zeros((1, 2), np.uint8), free=np.full((1, 2), 255, np.uint8))
    suite |= dict(map_of=np.zeros(0, int))
    np.savez_compressed(buffer := io.BytesIO(), **suite)
    (folder / "suite.npz").write_bytes(buffer.getvalue())
    (folder / "words").write_text("--map a.yaml --log b.log --out c --runs 3 --particles 50 --segments 2 --seed 0")


def reads_words(folder: Path) -> None:
    """The words of a command line, for each command that knows them, as far as they can be judged without files."""
    words = (folder / "words").read_text(errors="surrogateescape").split()
    args = parse(localize_args.LocalizeArgs, "python -m dsom_jax.localize", words)
    localize_args.check(args)


def other_words(folder: Path) -> None:
    """The same, cut short, for one of the other commands."""
    words = (folder / "words").read_text(errors="surrogateescape").split()
    kinds = (bench.BenchArgs, train.TrainArgs, train_filter.TrainFilterArgs, evaluate.EvaluateArgs)
    parse(kinds[len(" ".join(words)) % len(kinds)], "python -m dsom_jax.bench", words[4:12])


def log_with_reference(folder: Path) -> None:
    with_reference(load_log(folder / "flaser.log"), folder / "truth.tum")


def image(name: str) -> Target:
    return Target(f"map {name}", (f"{name}.yaml", name), lambda folder: load_map(folder / f"{name}.yaml"))


TARGETS = (
    *map(image, ("room.pgm", "room.png", "room.bmp", "room.jpg", "room.tif", "rgba.png", "plain.pgm")),
    Target("map yaml", ("room.pgm.yaml",), lambda folder: load_map(folder / "room.pgm.yaml")),
    Target("drawing", ("plan.dxf",), lambda folder: load_map(folder / "plan.dxf")),
    Target("drawing yaml", ("plan.yaml",), lambda folder: load_map(folder / "plan.yaml")),
    *(
        Target(kind, (f"{kind}.log", "meta.yaml"), lambda folder, kind=kind: load_log(folder / f"{kind}.log"))
        for kind in ("flaser", "robotlaser", "rawlaser")
    ),
    Target("meta", ("meta.yaml",), lambda folder: load_log(folder / "flaser.log")),
    Target("trajectory", ("truth.tum",), lambda folder: load_tum(folder / "truth.tum")),
    Target("reference", ("truth.tum", "flaser.log"), log_with_reference),
    Target(
        "rawseeds",
        ("Made-SICK_FRONT.csv", "Made-ODOMETRY_XYT.csv", "Made-GROUNDTRUTH.csv"),
        lambda folder: load_log(folder / "Made-SICK_FRONT.csv"),
    ),
    Target("runs", ("runs.npz",), lambda folder: read_runs(folder / "runs.npz")),
    Target("suite npz", ("suite.npz",), lambda folder: decode("made", (folder / "suite.npz").read_bytes())),
    Target("json", ("run.json",), lambda folder: read_json(folder / "run.json", "record")),
    Target("yaml", ("plan.yaml",), lambda folder: read_yaml(folder / "plan.yaml", "configuration")),
    Target("bag 1", ("bag/made.bag",), lambda folder: load_log(folder / "bag" / "made.bag")),
    Target("bag 2", ("db3/made/made.db3", "db3/made/metadata.yaml"), lambda folder: load_log(folder / "db3" / "made")),
    Target("mcap", ("mcap/made/made.mcap",), lambda folder: load_log(folder / "mcap" / "made" / "made.mcap")),
    Target("words", ("words",), reads_words),
    Target("other words", ("words",), other_words),
)
