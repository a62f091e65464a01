"""What each proposal makes of one scan as one thing after another gets worse: curves, no filter."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import jax
import numpy as np
from lab import PROPOSALS, Everything, Lab, Piece, column
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scenes import Change, Condition, Scans, beams_of, map_and_building, take
from tables import markdown, percent

from dsom_jax.filters.methods import make_proposal
from dsom_jax.filters.settings import DRAWN, Settings
from dsom_jax.judging import quality
from dsom_jax.judging.statistics import interval, rate_interval
from dsom_jax.nn import DSOM
from dsom_jax.plotting.common import legend
from dsom_jax.types import Key

NAME = "one_scan"
_UNSEEN = 0x0E5C
"""Folded into the seed, so that these buildings are none that anything else draws."""


@dataclass(frozen=True)
class Axis:
    """One curve: what its abscissa is called, the condition at a value of it, and names of values that are no sizes."""

    label: str
    values: tuple[float, ...]
    condition: Callable[[float], Condition]
    names: tuple[str, ...] = ()


def changed(name: str) -> Callable[[float], Condition]:
    """Conditions that differ in one field of :class:`scenes.Change`."""
    return lambda value: Condition(replace_field(Change(), name, value))


def replace_field(change: Change, name: str, value: float) -> Change:
    """``change`` with another value of a field."""
    return change._replace(**{name: value})


AXES = {
    "fov": Axis("field of view [deg]", (90, 135, 180, 270, 360), lambda v: Condition(fov=v)),
    "range": Axis("range of the lidar [m]", (2.5, 5.0, 7.5, 10.0), lambda v: Condition(range_max=v)),
    "obstacles": Axis("unknown obstacles per 43 m x 43 m", (0, 20, 60, 120, 200, 320), changed("obstacles")),
    "short": Axis("beams returned early [share]", (0.0, 0.1, 0.2, 0.4), changed("short")),
    "gone": Axis("pieces of structure gone", (0, 20, 40, 80, 160), changed("gone")),
    "moved": Axis("walls stand elsewhere [m r.m.s.]", (0.0, 0.2, 0.4, 0.7, 1.0), changed("moved")),
    "closed": Axis("doors closed [share]", (0.0, 0.5, 1.0), changed("closed")),
    "scale": Axis("factor on the ranges", (0.9, 0.95, 1.0, 1.05, 1.1), changed("scale")),
    "deep": Axis("beams end behind walls [m]", (0.0, 0.1, 0.2, 0.3), changed("deep")),
    "symmetry": Axis("landmarks that break a 2-fold symmetry", (0, 1, 2, 4, 8, 16),
                     lambda v: Condition(landmarks=int(v))),
    "floor plan": Axis("what the map shows", (0, 1, 2), lambda v: Condition(bare=v > 0, drawn=v > 1),
                       ("all", "walls", "walls, told")),
}  # fmt: skip


@dataclass(frozen=True)
class Config:
    """Attributes: curves; buildings; scans in each."""

    axes: tuple[str, ...] = tuple(AXES)
    worlds: int = 8
    scans: int = 8


def jobs(config: Config) -> dict[str, Any]:
    """One for each curve; those of one process share maps and proposals."""
    return {name: partial(draw, AXES[name], config) for name in config.axes}


def draw(axis: Axis, config: Config, lab: Lab) -> dict[str, Any]:
    """Every point of a curve."""
    bed: Bed = lab.shared.setdefault(config, Bed(config))
    return bed.curve(axis, lab)


class Bed:
    """Maps and proposals that were made, for all curves."""

    def __init__(self, config: Config) -> None:
        self.config = config
        self.places: dict[Any, Any] = {}
        self.made: dict[Any, dict[str, Any]] = {}
        self.judged: dict[Condition, dict[str, Any]] = {}

    def curve(self, axis: Axis, lab: Lab) -> dict[str, Any]:
        """Every point of a curve."""
        return {"label": axis.label, "values": axis.values, "names": axis.names or [f"{v:g}" for v in axis.values],
                "points": [self.point(axis.condition(value), lab) for value in axis.values]}  # fmt: skip

    def point(self, condition: Condition, lab: Lab) -> dict[str, Any]:
        """Quality of all proposals under one condition, all on the same scans."""
        if condition not in self.judged:
            root = jax.random.fold_in(jax.random.key(lab.seed), _UNSEEN)
            keys = jax.random.split(root, self.config.worlds)
            network = lab.networks["dsom"]
            worlds = [self.world(n, key, condition, network) for n, key in enumerate(keys)]
            parts = {name: [found[name] for _, found in worlds] for name in PROPOSALS}
            self.judged[condition] = {name: told(part) for name, part in parts.items()}
            self.judged[condition]["contradicting"] = beams_of([scans for scans, _ in worlds])
        return self.judged[condition]

    def world(
        self, number: int, key: Key, condition: Condition, network: DSOM
    ) -> tuple[Scans, dict[str, quality.Quality]]:
        """Scans in one building and what the proposals make of them."""
        k_place, k_scans = jax.random.split(key)
        place = number, condition.shown
        if place not in self.places:
            self.places[place] = map_and_building(k_place, condition)
        shown, world = self.places[place]
        scans = take(k_scans, shown, world, condition, self.config.scans)
        made = self.proposals((*place, condition.lidar, condition.drawn), condition, network)
        return scans, {
            name: jax.tree.map(np.asarray, quality.of_scans(made[name], shown, scans.ranges, scans.poses))
            for name in PROPOSALS
        }

    def proposals(self, place: Any, condition: Condition, network: DSOM) -> dict[str, Any]:
        """Proposals of one map and lidar; PM of DSOM is not sharpened, as it is the network that is judged."""
        if place in self.made:
            return self.made[place]
        settings = replace(DRAWN if condition.drawn else Settings(), sharpness=1.0)
        made: dict[str, Any] = {}
        for name in PROPOSALS:
            grid = self.places[place[:2]][0]
            made[name] = make_proposal(name, grid, condition.lidar, settings, network, made)
        # Only what most curves use is worth its memory.
        if (condition.shown, condition.lidar) == (Condition().shown, Condition().lidar):
            self.made[place] = made
        return made


def told(parts: list[quality.Quality]) -> dict[str, Any]:
    """Numbers of one proposal over all buildings; intervals draw buildings first, then their scans."""
    mass, top = (np.concatenate([getattr(p, name) for p in parts]).astype(float) for name in ("mass", "top1"))
    world = np.repeat(np.arange(len(parts)), [len(p.mass) for p in parts])
    above = (mass > 0.01).astype(float)
    joined = jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)
    return {
        **quality.totals(joined),
        "mass_mean_ci95": interval(mass, world),
        "mass_gt_1pct_ci95": rate_interval(above, world),
        "top1_ci95": rate_interval(top, world),
    }


SHOWN = {"mass_mean": "mean PM at the truth [%]", "mass_gt_1pct": "scans with > 1 % [%]", "top1": "top-1 right [%]"}
LINES = {"dsom": "o-", "likelihood_grid": "s--", "hybrid": "^:"}


def figures(everything: Everything) -> dict[str, Figure]:
    """A row of three panels for every curve, in figures of four rows."""
    results = everything[NAME]
    names = [name for name in AXES if name in results]
    groups = [names[start : start + 4] for start in range(0, len(names), 4)]
    return {f"one_scan_{n + 1}": _rows({name: results[name] for name in group}) for n, group in enumerate(groups)}


def _rows(curves: dict[str, Any]) -> Figure:
    figure = Figure(figsize=(11, 2.7 * len(curves) + 0.5), layout="constrained")
    figure.get_layout_engine().set(wspace=0.05)  # type: ignore[union-attr, call-arg]  # it is the constrained one
    grid = figure.subplots(len(curves), len(SHOWN), squeeze=False, sharey=True)
    for axes, curve in zip(grid, curves.values(), strict=True):
        for ax, (key, label) in zip(axes, SHOWN.items(), strict=True):
            for name in PROPOSALS:
                _curve(ax, curve, name, key)
            ax.set(xlabel=curve["label"], ylabel=label, ylim=(-3, 103))
            ax.set_xticks(curve["values"], curve["names"])
            ax.grid(axis="y", color="0.9", linewidth=0.6)
    handles, labels = grid[0][0].get_legend_handles_labels()
    legend(figure, handles, labels, len(PROPOSALS))
    return figure


def _curve(ax: Axes, curve: dict[str, Any], name: str, key: str) -> None:
    (label, color), style = PROPOSALS[name], LINES[name]
    points = [point[name] for point in curve["points"]]
    low, high = (100 * column([point[f"{key}_ci95"][n] for point in points]) for n in (0, 1))
    ax.plot(curve["values"], 100 * column([p[key] for p in points]), style, color=color, markersize=4, label=label)
    ax.fill_between(curve["values"], low, high, color=color, alpha=0.12, linewidth=0)


def section(everything: Everything) -> str:
    """All points in one table, and the figures."""
    head = ["condition", "beams off %"]
    head += [f"{PROPOSALS[name][0]}: mass / > 1 % / top-1 %" for name in PROPOSALS]
    lines = []
    for name in AXES:
        curve = everything[NAME].get(name, {"names": (), "points": ()})
        for value, point in zip(curve["names"], curve["points"], strict=True):
            cells = [" / ".join(percent(point[p][key], 0) for key in SHOWN) for p in PROPOSALS]
            lines.append([f"{curve['label']}: {value}", percent(point["contradicting"]), *cells])
    pictures = [f"![One scan, curves](FIGURES/{name}.png)" for name in figures(everything)]
    return "\n\n".join([TEXT, markdown(head, lines), *pictures])


TEXT = """\
Quality of single scans in procedural buildings of 43 m that no training draws, one thing changed at a time from a full
turn of 10 m range with 20 unknown obstacles. Mass: mean probability within 1 m and 15 deg of the truth; > 1 %: share of
the scans with at least that much there; top-1: the most probable pose is within 2 m and 10 deg. Beams off: share of the
beams of the full turn that end more than 0.3 m from where the map says, before noise. PM of DSOM is not sharpened.
Shaded: 95 % bootstrap interval, buildings drawn first. Where walls stand elsewhere, the truth is the place on the map
where what is around the robot is mapped. With symmetry there are two right poses until landmarks tell them apart, so
that 50 % of PM at the truth is all that can be had without them. What the map shows: all, walls only, or walls only and
the likelihood grid is told that the map is a floor plan."""

PIECE = Piece(NAME, Config(), jobs, figures, section)
