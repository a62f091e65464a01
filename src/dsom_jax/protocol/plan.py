"""What is run: a configuration file of maps, logs and methods, read and checked before anything is written."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from dsom_jax.atomic import write_atomic
from dsom_jax.data import LogOptions, RawLog, load_log
from dsom_jax.data.bag_file import is_bag
from dsom_jax.data.documents import read_yaml
from dsom_jax.data.dxf import UNITS
from dsom_jax.data.log import limited
from dsom_jax.errors import UserError
from dsom_jax.filters.methods import METHODS, network_of
from dsom_jax.training.options import override

_SHIPPED = "@shipped"
"""Behind the name of a method: its network as it is in the repository, not adapted to the map."""
_KINDS = ("scanned", "drawn")


@dataclass(frozen=True)
class ProtocolPlan:
    """A configuration file.

    Attributes:
        name: of the data set.
        maps: name -> ``yaml``, the map's file in the data folder, or the fields of one (``image`` or ``drawing``,
            relative to the data folder). A drawing may have ``box``: [left, top, right, bottom] in metres from its
            upper left corner, in place of ``crop``. ``logs`` and ``map_kind`` of a map replace those below,
            ``adapt`` and ``learn`` add to them.
        logs: patterns of files or folders in the data folder; FILE.tum beside FILE is its reference, if it is there.
        scan_topic, odom_topic: of bags; empty where there is no choice.
        methods: names as in the benchmark; ``NAME@shipped`` takes a network as it is shipped.
        shown: those of the methods that stand in the figure of errors; empty for all.
        map_kind: scanned or drawn.
        t_cuts: values of T_cut; methods without it run once.
        particles, runs, seed: as in the benchmark.
        clips: drives chosen from all logs together, each of ``updates`` updates.
        on_map: share of a clip's reference that must lie on free cells.
        laser_max_range: metres; longer readings count as no return.
        adapt_minutes: of training on each map before it is used, where a method needs the network; 0 for none.
        adapt_steps: of that training in place of minutes, so that any machine does the same; 0 goes by the clock.
        adapt: fields of ``TrainConfig`` for that training that differ from those of :func:`.adapting.settings`.
        learn_steps: of training PF-Net and PFRNN on in each map before they are used; 0 takes them as they are shipped.
        learn: fields of ``FilterTrainConfig`` for it that differ from those of :func:`.adapting.filter_settings`.
    """

    name: str = "data"
    maps: dict[str, Any] = field(default_factory=dict)
    logs: tuple[str, ...] = ()
    scan_topic: str = ""
    odom_topic: str = ""
    methods: tuple[str, ...] = ()
    shown: tuple[str, ...] = ()
    map_kind: str = "scanned"
    t_cuts: tuple[float, ...] = ()
    particles: int = 500
    runs: int = 100
    seed: int = 0
    clips: int = 3
    updates: int = 60
    on_map: float = 0.95
    laser_max_range: float = 30.0
    adapt_minutes: float = 30.0
    adapt_steps: int = 0
    adapt: dict[str, Any] = field(default_factory=dict)
    learn_steps: int = 0
    learn: dict[str, Any] = field(default_factory=dict)

    def on(self, name: str) -> tuple[ProtocolPlan, dict[str, Any]]:
        """The plan of one map with what it replaces, and the fields that describe the map itself."""
        fields = dict(self.maps[name])
        own = {key: fields.pop(key) for key in ("logs", "map_kind") if key in fields}
        own |= {key: merged(getattr(self, key), fields.pop(key, {})) for key in ("adapt", "learn")}
        # An empty tuple or mapping takes any.
        return override(replace(self, logs=(), adapt={}, learn={}), {"logs": list(self.logs), **own}, name), fields


def merged(given: dict[str, Any], changes: dict[str, Any]) -> dict[str, Any]:
    """Fields with those that ``changes`` replace; fields of fields alike."""
    both = [name for name, value in changes.items() if isinstance(value, dict) and isinstance(given.get(name), dict)]
    return given | changes | {name: merged(given[name], changes[name]) for name in both}


@dataclass(frozen=True)
class Variant:
    """One method as it is run: with which network, and with which T_cut."""

    method: str
    shipped: bool = False
    t_cut: float | None = None

    @property
    def name(self) -> str:
        """As it stands in the configuration."""
        return self.method + _SHIPPED * self.shipped

    @property
    def stem(self) -> str:
        """Name of its files, and of its rows in tables of runs."""
        return self.name.replace("@", "-") + ("" if self.t_cut is None else f"-{self.t_cut:g}")


def variants(plan: ProtocolPlan) -> list[Variant]:
    """All that is run on a map; T_cut is Alg 1's and nobody else's."""
    chosen = []
    for name in plan.methods:
        method = name.removesuffix(_SHIPPED)
        cuts = plan.t_cuts if method.startswith("adam_") else (None,)
        chosen += [Variant(method, name.endswith(_SHIPPED), cut) for cut in cuts]
    return chosen


def read_plan(config: Path, changes: dict[str, Any]) -> ProtocolPlan:
    """The configuration with what the command line changes (values that are not None)."""
    plan: ProtocolPlan = override(ProtocolPlan(), read_yaml(config, "configuration"), str(config))
    plan = replace(plan, **{name: value for name, value in changes.items() if value is not None})
    unknown = [name for name in plan.methods if name.removesuffix(_SHIPPED) not in METHODS]
    shipped = [name for name in plan.methods if name.endswith(_SHIPPED)]
    unknown += [name for name in shipped if not network_of(name.removesuffix(_SHIPPED))]
    unknown += [name for name in plan.shown if name not in plan.methods]
    if unknown or not (plan.maps and plan.methods and plan.t_cuts):
        raise UserError(f"{config}: needs maps, t_cuts, and known methods; got {unknown}")
    for name, fields in plan.maps.items():
        check_map(config, name, fields)
        one = plan.on(name)[0]
        if not one.logs or one.map_kind not in _KINDS:
            raise UserError(f"{config}: {name} needs logs, and map_kind scanned or drawn")
    if plan.clips < 2 or plan.updates < 6:
        raise UserError(f"{config}: give clips of at least 2 (a kidnapping joins two) and updates of at least 6")
    if not (plan.runs >= 1 and plan.particles >= 1 and all(0 < cut < 1 for cut in plan.t_cuts)):
        raise UserError(f"{config}: give runs and particles of at least 1 and t_cuts between 0 and 1")
    return plan


def check_map(config: Path, name: str, fields: Any) -> None:
    """UserError unless the map called ``name`` is described by fields that :func:`map_file` can use."""
    if not isinstance(fields, Mapping) or not fields.keys() & {"yaml", "image", "drawing"}:
        raise UserError(f"{config}: maps: {name} = {fields!r}: give fields, at least yaml, image or drawing: FILE")
    for part in ("adapt", "learn"):
        if not isinstance(fields.get(part, {}), Mapping):
            raise UserError(f"{config}: maps: {name}: {part} = {fields[part]!r}: give fields, or leave it out")
    if "box" not in fields:
        return
    if "drawing" not in fields or fields.get("units", "m") not in UNITS:
        raise UserError(f"{config}: maps: {name}: box needs a drawing, and units out of {', '.join(UNITS)}")
    box = fields["box"]
    if not (isinstance(box, list) and len(box) == 4 and all(isinstance(side, int | float) for side in box)):
        raise UserError(f"{config}: maps: {name}: box = {box!r}: give [left, top, right, bottom] in metres")


def map_file(name: str, fields: dict[str, Any], data: Path, out: Path) -> Path:
    """The map's yaml in the data folder, or one written to ``out``/maps with its image or drawing by its full path."""
    if set(fields) == {"yaml"}:
        return data / str(fields["yaml"])
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

    So the released code of the paper's authors counts the pixels of its two parts of Bicocca.
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


def read_logs(plan: ProtocolPlan, data: Path) -> Iterator[RawLog]:
    """The logs, one after another, limited to the range that is used."""
    paths = sorted({path for pattern in plan.logs for path in data.glob(pattern) if path.suffix != ".tum"})
    if not paths:
        raise UserError(f"{data}: holds nothing like {', '.join(plan.logs)}; see README.md for the layout")
    for path in paths:
        beside = path.with_suffix(".tum")
        of_bags = LogOptions(scan_topic=plan.scan_topic or None, odom_topic=plan.odom_topic or None)
        options = of_bags if is_bag(path) else LogOptions()
        log = load_log(path, options, reference=beside if beside.is_file() else None)
        for line in log.report.lines():
            print(f"{path.name}: {line}")
        yield limited(log, plan.laser_max_range)
