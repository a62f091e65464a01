"""The case study of multimodality (Fig 3): how many peaks PM has, on test scans and where the right number is known."""

from __future__ import annotations

import base64
from dataclasses import dataclass
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from lab import PROPOSALS, Everything, Lab, Piece, compiled
from matplotlib.figure import Figure
from scenes import WORLD, Change, Condition, building, take
from symmetric import images, off_middle, symmetric
from tables import bounds, markdown, number, percent

from dsom_jax import plotting
from dsom_jax import pose_grid as pg
from dsom_jax.filters.methods import make_proposal
from dsom_jax.filters.settings import Settings
from dsom_jax.geometry import transform_points
from dsom_jax.judging import quality
from dsom_jax.judging.statistics import interval, rate_interval
from dsom_jax.lidar import LidarConfig, scan_points
from dsom_jax.occupancy import OccupancyGrid, from_cells
from dsom_jax.plotting.common import legend
from dsom_jax.types import Array, Inputs, Key, Proposal, prepare_alone

NAME = "multimodal"
_UNSEEN = 0x3A5E
"""Folded into the seed, so that these buildings are none that anything else draws."""
DRAWN = 1e-4
"""Cells of a picture are kept if they have this share of the most probable one's probability."""


@dataclass(frozen=True)
class Config:
    """Attributes: every so many-th scan of the test sequences is judged; symmetric buildings of each order; scans in
    each; orders; least distance from the middle of a symmetric building, metres."""

    every: int = 8
    worlds: int = 8
    scans: int = 12
    orders: tuple[int, ...] = (1, 2, 4)
    apart: float = 2.5


def jobs(config: Config) -> dict[str, Any]:
    """Test scans, and symmetric buildings by order."""
    orders = {f"order_{order}": partial(judge_order, order, config) for order in config.orders}
    return {"scenes": partial(judge_scenes, config), **orders}


def proposals(lab: Lab, grid: OccupancyGrid) -> dict[str, Proposal]:
    """The proposals on a map; PM of DSOM as the network gives it."""
    made: dict[str, Proposal] = {}
    for name in PROPOSALS:
        made[name] = make_proposal(name, grid, lab.suite.lidar, Settings(sharpness=1.0), lab.networks["dsom"], made)
    return made


def judge_scenes(config: Config, lab: Lab) -> dict[str, Any]:
    """Numbers of peaks on the test sequences, and pictures of typical scans with one, two, and more peaks."""
    counts: dict[str, list[int]] = {name: [] for name in PROPOSALS}
    mass: dict[str, list[float]] = {name: [] for name in PROPOSALS}
    scans: list[tuple[str, OccupancyGrid, Array, Array]] = []
    made: dict[str, dict[str, Proposal]] = {}
    for where, grid, episode in lab.suite.episodes:
        made[where] = made.get(where) or proposals(lab, grid)
        ranges, poses = episode.ranges[:: config.every], episode.poses[:: config.every]
        for name in PROPOSALS:
            found = quality.of_scans(made[where][name], grid, ranges, poses)
            counts[name] += np.asarray(found.peaks).tolist()
            mass[name] += np.asarray(found.mass).tolist()
        scans += [(where, grid, *scan) for scan in zip(ranges, poses, strict=True)]
    shown = {label: scans[n] for label, n in typical(counts["dsom"], mass["dsom"]).items()}
    pictures = {
        label: picture(made[where]["dsom"], grid, seen, pose, lab.suite.lidar)
        for label, (where, grid, seen, pose) in shown.items()
    }
    return {"peaks": counts, "mass": mass, "pictures": pictures}


def typical(peaks: list[int], mass: list[float]) -> dict[str, int]:
    """Of the scans with one, two, three or more peaks, the one whose probability at the truth is the median."""
    chosen = {}
    for label, low, high in (("1", 1, 1), ("2", 2, 2), ("3 or more", 3, quality.MAX_PEAKS)):
        found = sorted((mass[n], n) for n, count in enumerate(peaks) if low <= count <= high)
        if found:
            chosen[label] = found[len(found) // 2][1]
    return chosen


def judge_order(order: int, config: Config, lab: Lab) -> dict[str, Any]:
    """Peaks and probability at each right pose in buildings of one order of symmetry, scans that fit the map."""
    keys = jax.random.split(jax.random.fold_in(jax.random.key(lab.seed), _UNSEEN), config.worlds)
    worlds = [judge_building(order, config, lab, key, drawn=n == 0) for n, key in enumerate(keys)]
    numbers = {name: told([found[name] for found, _ in worlds], order) for name in PROPOSALS}
    return {"order": order, "pictures": {str(order): worlds[0][1]}, **numbers}


def judge_building(order: int, config: Config, lab: Lab, key: Key, drawn: bool) -> tuple[dict[str, Any], Any]:
    """What :func:`shares` gives in one building, by proposal; the picture of a scan, if ``drawn``."""
    k_world, k_scans = jax.random.split(key)
    grid = symmetric(building(k_world, WORLD), order)
    stand = OccupancyGrid(grid.occupied, grid.free & off_middle(grid, config.apart), grid.origin, grid.resolution)
    scans = take(k_scans, stand, grid, Condition(Change(obstacles=0)), config.scans)
    right, made = images(grid, scans.poses, order), proposals(lab, grid)
    found = {name: jax.tree.map(np.asarray, _shares()(made[name], scans.ranges, right)) for name in PROPOSALS}
    shown = picture(made["dsom"], grid, scans.ranges[0], scans.poses[0], lab.suite.lidar) if drawn else None
    return found, shown


@cache
def _shares() -> Any:
    return compiled(shares)


def shares(proposal: Any, ranges: Array, right: Array) -> tuple[Array, Array]:
    """Number of peaks (S,) and probability near each right pose (S, m), for scans (S, B) and poses (S, m, 3)."""

    def one(scan: tuple[Array, Array]) -> tuple[Array, Array]:
        pm = prepare_alone(proposal, Inputs(scan[0], jnp.zeros(3), jnp.int32(0)))
        return quality.peaks(pm), jax.vmap(lambda pose: pg.mass_near(pm, pose, *quality.MASS))(scan[1])

    return jax.lax.map(one, (ranges, right))


def told(parts: list[tuple[np.ndarray, np.ndarray]], order: int) -> dict[str, Any]:
    """Numbers of one proposal in buildings of one order."""
    peaks, mass = (np.concatenate([part[n] for part in parts]) for n in (0, 1))
    world = np.repeat(np.arange(len(parts)), [len(part[0]) for part in parts])
    # A right pose is found if a peak could count there: a tenth of the probability of the best right one.
    all_found = (mass >= quality.PEAK_SHARE * mass.max(-1, keepdims=True)).all(-1) & (mass.sum(-1) > 0.5)
    exact = peaks == order
    return {
        "peaks": peaks.tolist(),
        "world": world.tolist(),
        "exact": float(exact.mean()),
        "exact_ci95": rate_interval(exact, world),
        "peaks_mean": float(peaks.mean()),
        "peaks_ci95": interval(peaks, world),
        "all_found": float(all_found.mean()),
        "all_found_ci95": rate_interval(all_found, world),
        "truth": float(mass[:, 0].mean()),
        "right": float(mass.sum(-1).mean()),
        "least": float(mass.min(-1).mean()),
    }


def picture(proposal: Any, grid: OccupancyGrid, ranges: Array, pose: Array, lidar: LidarConfig) -> dict[str, Any]:
    """A scan, its true pose and PM summed over headings, as few numbers as a figure needs."""
    pm = quality.prepare(proposal, ranges)
    mass = np.asarray(pm.mass).sum(-1).ravel()
    cells = np.flatnonzero(mass >= DRAWN * mass.max())
    ends, hit = scan_points(ranges, lidar)
    points = np.asarray(transform_points(pose, ends))[np.asarray(hit)]
    return {"occupied": packed(grid.occupied), "free": packed(grid.free), "shape": grid.shape,
            "resolution": grid.resolution, "origin": np.asarray(grid.origin), "pose": np.asarray(pose),
            "points": points, "pm_shape": pm.mass.shape[:2], "pm_resolution": pm.pose_grid.resolution,
            "pm_cells": cells, "pm_mass": mass[cells] / mass.sum(),
            "mass": float(pg.mass_near(pm, pose, *quality.MASS)), "peaks": int(quality.peaks(pm))}  # fmt: skip


def packed(cells: Array) -> str:
    """Boolean cells as text."""
    return base64.b64encode(np.packbits(np.asarray(cells)).tobytes()).decode()


def unpacked(text: str, shape: list[int]) -> np.ndarray:
    """What :func:`packed` made of cells of ``shape``."""
    bits = np.unpackbits(np.frombuffer(base64.b64decode(text), np.uint8), count=shape[0] * shape[1])
    return bits.reshape(shape).astype(bool)


def view(kept: dict[str, Any]) -> dict[str, Any]:
    """Arguments of :func:`dsom_jax.plotting.map_view`."""
    cells = [jnp.asarray(unpacked(kept[name], kept["shape"])) for name in ("occupied", "free")]
    grid = from_cells(*cells, resolution=kept["resolution"], origin=tuple(kept["origin"]))
    pm = np.zeros(int(np.prod(kept["pm_shape"])))
    pm[kept["pm_cells"]] = kept["pm_mass"]
    return {"grid": grid, "pm": pm.reshape(kept["pm_shape"]), "pm_resolution": kept["pm_resolution"],
            "points": np.array(kept["points"]), "truth": np.array(kept["pose"])}  # fmt: skip


def figures(everything: Everything) -> dict[str, Figure]:
    """Three scenes, symmetric buildings, and how often PM has how many peaks."""
    results, made = everything[NAME], {}
    if "scenes" in results:
        kept = results["scenes"]["pictures"].values()
        titles = [f"{plural(p['peaks'], 'peak')}, {100 * p['mass']:.0f} % at the truth" for p in kept]
        made["scenes"] = plotting.map_views([view(p) for p in kept], titles)
        made["peaks"] = histogram(results["scenes"]["peaks"])
    orders = [entry for name, entry in results.items() if name != "scenes"]
    if orders:
        kept = [next(iter(entry["pictures"].values())) for entry in orders]
        titles = [
            f"{plural(entry['order'], 'right pose')}: {plural(p['peaks'], 'peak')}"
            for entry, p in zip(orders, kept, strict=True)
        ]
        made["symmetric"] = plotting.map_views([view(p) for p in kept], titles)
    return made


def plural(count: int, what: str) -> str:
    """``1 peak``, ``2 peaks``."""
    return f"{count} {what}{'s' * (count != 1)}"


def histogram(counts: dict[str, list[int]]) -> Figure:
    """Share of the test scans with each number of peaks."""
    figure = Figure(figsize=(6.5, 3.2), layout="constrained")
    ax = figure.subplots()
    numbers = np.arange(1, quality.MAX_PEAKS + 1)
    for n, (name, peaks) in enumerate(counts.items()):
        share = [100 * np.mean(np.array(peaks) == k) for k in numbers]
        ax.bar(numbers + 0.27 * (n - 1), share, width=0.25, color=PROPOSALS[name][1], label=PROPOSALS[name][0])
    ax.set(xlabel=f"peaks of PM ({quality.MAX_PEAKS}: as many or more)", ylabel="share of the test scans [%]")
    ax.set_xticks(numbers)
    handles, labels = ax.get_legend_handles_labels()
    legend(figure, handles, labels, 3)
    return figure


def section(everything: Everything) -> str:
    """Numbers and pictures."""
    results, lines = everything[NAME], []
    for entry in (entry for name, entry in results.items() if name != "scenes"):
        for name in PROPOSALS:
            m = entry[name]
            lines.append([str(entry["order"]), f"`{name}`", number(m["peaks_mean"], 2) + bounds(m["peaks_ci95"], 1, 2),
                          percent(m["exact"]) + bounds(m["exact_ci95"], 100, 0), percent(m["all_found"]),
                          percent(m["right"]), percent(m["truth"]), percent(m["least"])])  # fmt: skip
    head = ("right poses", "proposal", "peaks, mean", "exactly so many %", "all found %", "PM at right poses %",
            "at the true one %", "at the least likely one %")  # fmt: skip
    orders = [SYMMETRIC, markdown(head, lines), "![Symmetric](FIGURES/symmetric.png)"]
    return "\n\n".join([*([SCENES] if "scenes" in results else []), *(orders if lines else [])])


SCENES = """\
A peak is a place (apart from others by more than 2 m or 30 deg) that has at least a tenth of the probability of the
best place within 1 m and 15 deg. The pictures are of typical scans of the test sequences on which PM of DSOM has one,
two, and three or more peaks: of all such scans those whose probability at the truth (within 1 m and 15 deg) is the
median. PM as the network gives it, not sharpened.

![Three scenes](FIGURES/scenes.png)

![Number of peaks](FIGURES/peaks.png)"""

SYMMETRIC = """\
Where the right number is known: a half or a quarter of a procedural building and its images under turns by 180 or 90
deg. Scans fit the map (noise of 0.02 m, nothing unknown), so that two or four poses are right and nothing but
resemblance within the part decides for another number; order 1 is the building as drawn. All found: every right pose
has at least a tenth of the probability of the most probable right one, and together they have more than half."""

PIECE = Piece(NAME, Config(), jobs, figures, section)
