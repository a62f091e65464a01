"""The paper's own real data: ``python experiments/paper_data/run.py --config upo.yaml --data DIR``.

For each map of the configuration: the network is adapted to it, clips of the logs that lie on it are chosen, each is
joined to the next one as a kidnapping, and all methods run on them as in the benchmark. ``OUT/MAP`` then holds
``bench.json``, ``bench.md``, ``runs.npz`` and the figures. See README.md beside this file: the data are not here.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import tyro
import yaml

from dsom_jax import bench, checkpoint, report
from dsom_jax.atomic import write_atomic
from dsom_jax.cli import progress_bar
from dsom_jax.data import RawLog, load_log, load_map
from dsom_jax.data.cut import splice, thin, to_episode
from dsom_jax.data.dxf import UNITS
from dsom_jax.data.files import read_yaml
from dsom_jax.data.log import limited
from dsom_jax.data.suite import Suite
from dsom_jax.episode import Episode
from dsom_jax.errors import UserError, run_cli
from dsom_jax.filters.methods import COMBINATIONS, DRAWN, REAL, make_filter, make_proposal, network_of
from dsom_jax.montecarlo import run_keys
from dsom_jax.occupancy import OccupancyGrid, is_free
from dsom_jax.proposals.dual_features import with_episode
from dsom_jax.run_table import join
from dsom_jax.training.options import override
from dsom_jax.types import Filter

HERE = Path(__file__).parent


@dataclass(frozen=True)
class Args:
    """Run one configuration."""

    config: Path
    """upo.yaml or bicocca.yaml."""
    data: Path
    """Folder of the data set, as README.md lays it out."""
    out: Path | None = None
    """Folder for the results; default: results/NAME beside this script."""
    checkpoint: Path | None = None
    """Network to start from; default: the one in the repository."""
    adapt_minutes: float | None = None
    """Minutes of training on each map, in place of the configuration's; 0 takes the network as it is."""
    runs: int | None = None
    """Monte-Carlo runs of each clip, in place of the configuration's."""


@dataclass(frozen=True)
class Plan:
    """A configuration file.

    Attributes:
        name: of the data set.
        maps: name -> fields of a map yaml (``image`` or ``drawing``, relative to the data folder). A drawing may have
            ``box``: [left, top, right, bottom] in metres from its upper left corner, in place of ``crop``.
        logs: patterns of files or folders in the data folder; FILE.tum beside FILE is its reference, if it is there.
        scan_topic, odom_topic: of bags; empty where there is no choice.
        methods: names as in the benchmark.
        map_kind: scanned or drawn.
        particles, t_cut, runs, seed: as in the benchmark.
        clips: drives chosen from all logs together, each of ``updates`` updates.
        on_map: share of a clip's reference that must lie on free cells.
        laser_max_range: metres; longer readings count as no return.
        adapt_minutes: of training on each map before it is used, where a method needs the network.
    """

    name: str = "data"
    maps: dict[str, Any] = field(default_factory=dict)
    logs: tuple[str, ...] = ()
    scan_topic: str = ""
    odom_topic: str = ""
    methods: tuple[str, ...] = ()
    map_kind: str = "scanned"
    particles: int = 500
    t_cut: float = 0.6
    runs: int = 100
    seed: int = 0
    clips: int = 3
    updates: int = 60
    on_map: float = 0.95
    laser_max_range: float = 30.0
    adapt_minutes: float = 30.0


def read_plan(args: Args) -> Plan:
    """The configuration with what the command line changes."""
    plan: Plan = override(Plan(), read_yaml(args.config, "configuration"), str(args.config))
    changes = {name: getattr(args, name) for name in ("runs", "adapt_minutes") if getattr(args, name) is not None}
    unknown = [name for name in plan.methods if name not in COMBINATIONS]
    lacking = not (plan.maps and plan.logs and plan.methods)
    if unknown or lacking or plan.map_kind not in ("scanned", "drawn"):
        raise UserError(f"{args.config}: needs maps, logs, map_kind scanned or drawn, and known methods; got {unknown}")
    if plan.clips < 2 or plan.updates < 6:
        raise UserError(f"{args.config}: give clips of at least 2 (a kidnapping joins two) and updates of at least 6")
    return replace(plan, **changes)


def write_map(name: str, fields: dict[str, Any], data: Path, out: Path) -> Path:
    """The map's yaml in ``out``/maps, with its image or drawing by its full path."""
    fields = dict(fields)
    for kind in ("image", "drawing"):
        if kind in fields:
            fields[kind] = str((data / str(fields[kind])).resolve())
    if "box" in fields:
        fields["crop"] = crop_of(Path(fields["drawing"]), fields.pop("box"), str(fields.get("units", "m")))
    path = out / "maps" / f"{name}.yaml"
    write_atomic(path, yaml.safe_dump(fields).encode())
    return path


def crop_of(drawing: Path, box: list[float], units: str) -> list[float]:
    """``crop`` of a box in metres from the upper left corner of all ends of lines and centres of arcs.

    So the authors' released code counts the pixels of its two parts of Bicocca.
    """
    import ezdxf

    if not drawing.is_file():
        raise UserError(f"{drawing}: no such drawing; check the path")
    shapes = ezdxf.readfile(drawing).modelspace().query("LINE ARC")
    ends = [(s.dxf.start, s.dxf.end) if s.dxftype() == "LINE" else (s.dxf.center,) for s in shapes]
    corners = np.array([(p.x, p.y) for points in ends for p in points]).reshape(-1, 2)
    if not len(corners):
        raise UserError(f"{drawing}: holds neither lines nor arcs; give crop in place of box")
    x, y, scale = corners[:, 0].min(), corners[:, 1].max(), UNITS[units]
    left, top, right, bottom = (float(side) / scale for side in box)
    return [float(x + left), float(y - bottom), float(x + right), float(y - top)]


def read_logs(plan: Plan, data: Path) -> Iterator[RawLog]:
    """The logs, one after another, limited to the range that is used."""
    paths = sorted({path for pattern in plan.logs for path in data.glob(pattern) if path.suffix != ".tum"})
    if not paths:
        raise UserError(f"{data}: holds nothing like {', '.join(plan.logs)}; see README.md for the layout")
    for path in paths:
        beside = path.with_suffix(".tum")
        log = load_log(
            path,
            reference=beside if beside.is_file() else None,
            scan_topic=plan.scan_topic or None,
            odom_topic=plan.odom_topic or None,
        )
        for line in log.report.lines():
            print(f"{path.name}: {line}")
        yield limited(log, plan.laser_max_range)


def windows(log: RawLog, grid: OccupancyGrid, plan: Plan) -> Iterator[np.ndarray]:
    """Indices (T,) of pieces of a log that overlap by half, have a reference throughout, and lie on the map."""
    if log.reference is None:
        return
    used = thin(log)
    poses = log.reference[used]
    known = np.isfinite(poses).all(-1)
    free = np.asarray(is_free(grid, jnp.asarray(poses, jnp.float32)))
    for start in range(0, len(used) - plan.updates + 1, max(plan.updates // 2, 1)):
        piece = slice(start, start + plan.updates)
        if known[piece].all() and free[piece].mean() >= plan.on_map:
            yield used[piece]


def choose(plan: Plan, logs: list[RawLog], name: str, grid: OccupancyGrid) -> Suite:
    """``plan.clips`` pieces of all logs, evenly spread, each joined to the next by a kidnapping."""
    found = [(log, rows) for log in logs for rows in windows(log, grid, plan)]
    if len(found) < plan.clips:
        raise UserError(
            f"{name}: {len(found)} clips of {plan.updates} updates have their reference on free cells of this map, "
            f"{plan.clips} are wanted; check the pose of the map, the reference, updates and on_map"
        )
    chosen = [found[n] for n in np.linspace(0, len(found) - 1, plan.clips).round().astype(int)]
    if len({log.lidar for log, _ in chosen}) > 1:
        raise UserError(f"{name}: the logs are of different lidars; give one configuration for each")
    clips = [to_episode(log, rows) for log, rows in chosen]
    drives = [splice(clip, after) for clip, after in zip(clips, [*clips[1:], clips[0]], strict=True)]
    return Suite(f"{plan.name}, {name}", chosen[0][0].lidar, (), tuple((name, grid, drive) for drive in drives))


def network_for(plan: Plan, map_yaml: Path, start: Path | None, folder: Path) -> Path | None:
    """Folder of the network for this map: adapted to it, or as it is; None if no method draws from one."""
    if not any(network_of(name) == "dsom" for name in plan.methods):
        return None
    if start is None:
        raise UserError("--checkpoint: no network is shipped; name the folder of one")
    if not plan.adapt_minutes > 0:
        return start
    words = ["--maps", map_yaml, "--init", start, "--minutes", plan.adapt_minutes, "--out", folder, "--resume"]
    done = subprocess.run([sys.executable, "-m", "dsom_jax.train", *map(str, words)])
    if done.returncode:
        raise UserError(f"{folder}: training on {map_yaml.name} failed; its message is above")
    return folder


def run_map(plan: Plan, suite: Suite, network: Any, folder: Path) -> None:
    """All methods on the clips of one map; results and figures in ``folder``."""
    base = DRAWN if plan.map_kind == "drawn" else REAL
    settings = replace(base, particles=plan.particles, t_cut=plan.t_cut, seed=plan.seed)

    def build(name: str, where: str, grid: OccupancyGrid, episode: Episode) -> Filter:
        algorithm, source = COMBINATIONS[name]
        proposal = make_proposal(source.removesuffix("_star"), grid, suite.lidar, settings, network)
        starred = source.endswith("_star")
        proposal = with_episode(proposal, episode) if starred else proposal  # type: ignore[arg-type]
        return make_filter(algorithm, proposal, grid, suite.lidar, settings)

    keys = [run_keys(plan.seed, number, plan.runs) for number in range(len(suite.episodes))]
    bar, advance = progress_bar(len(plan.methods) * len(suite.episodes))
    with bar:
        records = {name: bench.run_method(name, suite, keys, build, advance) for name in plan.methods}
    data = bench.summary(suite, records, bench.Settings(plan.runs, plan.particles, plan.t_cut, plan.seed))
    report.print_tables(data)
    bench.save(folder, suite, records, data)
    report.write_runs(folder / "runs.npz", join([record.table for record in records.values()]))


def main(args: Args | None = None) -> None:
    """All maps of a configuration."""
    args = args or tyro.cli(Args, description=__doc__)
    plan = read_plan(args)
    if not args.data.is_dir():
        raise UserError(f"--data {args.data}: no such folder")
    logs = list(read_logs(plan, args.data))
    out = report.output_folder(args.out or HERE / "results" / plan.name)
    for name, fields in plan.maps.items():
        map_yaml = write_map(name, fields, args.data, out)
        suite = choose(plan, logs, name, load_map(map_yaml))
        folder = network_for(plan, map_yaml, args.checkpoint or checkpoint.shipped(), out / "networks" / name)
        network = checkpoint.load(folder, suite.lidar) if folder else None
        run_map(plan, suite, network, report.output_folder(out / name))


if __name__ == "__main__":
    run_cli(main)
