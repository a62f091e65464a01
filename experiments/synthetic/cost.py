"""Time of one update of DSOM, PF-Net and PFRNN, and time and memory of DSOM as the map grows."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import paper
from flax import nnx
from lab import Everything, Lab, Piece, compiled
from matplotlib.figure import Figure
from tables import markdown, number

from dsom_jax.nn import encode_map
from dsom_jax.occupancy import OccupancyGrid
from dsom_jax.plotting.common import log_ticks
from dsom_jax.proposals.dsom import dsom
from dsom_jax.types import prepare_alone

NAME = "cost"
FILTERS = ("mcl", "adam_dsom", "robust_dsom", "pf_net", "pfrnn")


@dataclass(frozen=True)
class Config:
    """Attributes: calls timed; particles; times that a test map of 43 m is laid side by side in either direction."""

    repeats: int = 30
    particles: int = 200
    tiles: tuple[int, ...] = (1, 2, 3, 5, 7)


def jobs(config: Config) -> dict[str, Any]:
    """Updates of the filters, and sizes of the map."""
    return {"update": partial(updates, config), "map_size": partial(sizes, config)}


def updates(config: Config, lab: Lab) -> dict[str, Any]:
    """Seconds of one update of one run, of its two parts: what the scan alone decides, and the particles."""
    where, grid, episode = lab.suite.episodes[0]
    now = jax.tree.map(lambda leaf: leaf[5], episode.inputs)
    times = {}
    for name in FILTERS:
        filter = lab.build(name, where, grid, episode, config.particles)
        prepare, step = compiled(prepare_alone), compiled(lambda f, *rest: f.step(*rest))
        start = time.perf_counter()
        prepared = jax.block_until_ready(prepare(filter, now))
        key = jax.random.key(lab.seed)
        state, _ = step(filter, key, filter.init(key), now, prepared)
        jax.block_until_ready(state)
        compiling = time.perf_counter() - start
        times[name] = {
            "prepare": timed(partial(prepare, filter, now), config.repeats) if prepared is not None else None,
            "step": timed(partial(step, filter, key, state, now, prepared), config.repeats),
            "compiling_s": compiling,
        }
    return {"times": times}


def sizes(config: Config, lab: Lab) -> dict[str, Any]:
    """What PM of one scan takes on maps of growing size, and the features of the map, once."""
    _, grid, episode = lab.suite.episodes[0]
    now = jax.tree.map(lambda leaf: leaf[5], episode.inputs)
    rows = []
    for tiles in config.tiles:
        big = replace(grid, occupied=jnp.tile(grid.occupied, (tiles, tiles)), free=jnp.tile(grid.free, (tiles, tiles)))
        repeats = max(3, config.repeats // tiles**2)
        start = time.perf_counter()
        proposal = jax.block_until_ready(dsom(lab.networks["dsom"], big, lab.suite.lidar))
        encoding = time.perf_counter() - start
        prepare = compiled(prepare_alone).lower(proposal, now).compile()
        row = {"metres": big.size[0], "cells": big.shape[0], "free_m2": float(big.free.sum()) * big.resolution**2,
               "pm_mb": memory(prepare), "pm": timed(partial(prepare, proposal, now), repeats),
               "map_first_s": encoding, "map_mb": memory(map_encoder(lab.networks["dsom"], big))}  # fmt: skip
        rows.append(row)
    return {"rows": rows}


def map_encoder(network: Any, grid: OccupancyGrid) -> Any:
    """The compiled computation of the map's features."""
    graph, weights = nnx.split(network)

    def encode(weights: Any, grid: OccupancyGrid) -> Any:
        return encode_map(nnx.merge(graph, weights), grid.occupied, grid.free)

    return jax.jit(encode).lower(nnx.as_pure(weights), grid).compile()


def memory(program: Any) -> dict[str, float]:
    """Megabytes by XLA's own account: what goes in (weights and features of the map), what comes out, and between."""
    account = program.memory_analysis()
    sides = {"arguments": account.argument_size_in_bytes, "result": account.output_size_in_bytes,
             "between": account.temp_size_in_bytes}  # fmt: skip
    return {name: size / 1e6 for name, size in sides.items()} | {"sum": sum(sides.values()) / 1e6}


def timed(call: Callable[[], Any], repeats: int) -> dict[str, float]:
    """Seconds of one call by the clock: median, quartiles and minimum, and median processor time, compiled before."""
    jax.block_until_ready(call())
    wall, cpu = [], []
    for _ in range(repeats):
        clock, processor = time.perf_counter(), time.process_time()
        jax.block_until_ready(call())
        wall.append(time.perf_counter() - clock)
        cpu.append(time.process_time() - processor)
    low, high = np.percentile(wall, [25, 75])
    return {"median_s": statistics.median(wall), "low_s": float(low), "high_s": float(high), "min_s": min(wall),
            "processor_s": statistics.median(cpu)}  # fmt: skip


def seconds(entry: dict[str, Any], which: str = "median_s") -> float:
    """Of one update: both parts."""
    return sum(entry[part][which] for part in ("prepare", "step") if entry[part])


def figures(everything: Everything) -> dict[str, Figure]:
    """Time and memory over the side of the map."""
    results = everything[NAME]
    if "map_size" not in results:
        return {}
    rows = results["map_size"]["rows"]
    side = [row["metres"] for row in rows]
    figure = Figure(figsize=(9, 3.6), layout="constrained")
    left, right = figure.subplots(1, 2)
    left.plot(side, [row["pm"]["median_s"] for row in rows], "o-", color="#d62728", label="clock, median")
    cores = results["map_size"]["made"]["machine"]["cores"]
    left.plot(side, [row["pm"]["processor_s"] / cores for row in rows], "s--", color="0.4", label="processor / cores")
    left.set(xlabel="side of the map [m]", ylabel="PM of one scan [s]", xscale="log", yscale="log")
    for key, label in (("pm_mb", "PM of one scan"), ("map_mb", "features of the map, once")):
        right.plot(side, [row[key]["sum"] for row in rows], "o-", label=label)
    right.set(xlabel="side of the map [m]", ylabel="memory [MB]", xscale="log", yscale="log")
    for ax in (left, right):
        ax.set_xticks(side, [f"{s:.0f}" for s in side])
        ax.minorticks_off()
        log_ticks(ax.yaxis)
        ax.grid(color="0.9", linewidth=0.6)
        ax.legend(frameon=False, fontsize=8)
    return {"map_size": figure}


def section(everything: Everything) -> str:
    """Times beside the paper's, then the growing map."""
    results, blocks = everything[NAME], []
    if "update" in results:
        lines = []
        for name, entry in results["update"]["times"].items():
            kind = "dsom" if name.endswith("dsom") else name
            prepare = 1e3 * entry["prepare"]["median_s"] if entry["prepare"] else None
            theirs = 1e3 * paper.SECONDS[kind].value if kind in paper.SECONDS else None
            lines.append([f"`{name}`", number(prepare, 1), number(1e3 * entry["step"]["median_s"], 1),
                          number(1e3 * seconds(entry), 1), number(theirs, 0),
                          number(entry["compiling_s"], 1)])  # fmt: skip
        head = ("filter", "the scan, ms", "particles, ms", "update, ms", "paper, ms", "compiling once, s")
        blocks += [UPDATES, markdown(head, lines)]
    if "map_size" in results:
        lines = [[number(r["metres"], 0), number(r["free_m2"], 0), number(1e3 * r["pm"]["median_s"], 0),
                  number(r["pm_mb"]["sum"], 0), number(r["pm_mb"]["between"], 0), number(r["map_first_s"], 1),
                  number(r["map_mb"]["sum"], 0)] for r in results["map_size"]["rows"]]  # fmt: skip
        columns = ("side m", "free m2", "PM of a scan, ms", "memory, MB", "of it temporary, MB",
                "map features once, with compiling, s", "memory, MB")  # fmt: skip
        blocks += [SIZES, markdown(columns, lines), "![Growing map](FIGURES/map_size.png)"]
    return "\n\n".join(blocks)


UPDATES = """\
One update of one run with 200 particles, medians by the clock. The scan: PM for DSOM, the encoding of the scan for
PF-Net and PFRNN. The paper's times are those of one inference on a TITAN GPU, ours of a processor, and its networks are
larger."""

SIZES = """\
DSOM on a test map laid side by side. Memory is XLA's own account of arguments (weights and features of the map), result
(PM) and temporary values of the compiled program."""

PIECE = Piece(NAME, Config(), jobs, figures, section, timed=True)
