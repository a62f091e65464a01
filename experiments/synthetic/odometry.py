"""Odometry that is two to five times as wrong as that of the suite, by filter and proposal."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from lab import POWERS, Everything, Lab, Piece, column
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MultipleLocator
from side_by_side import noisier, run_all, with_error
from tables import markdown, percent

from dsom_jax.episode import Episode
from dsom_jax.judging import metrics
from dsom_jax.judging.scores import judge_drive, judged_by, replies
from dsom_jax.occupancy import OccupancyGrid
from dsom_jax.plotting.charts import STYLES
from dsom_jax.plotting.common import legend

NAME = "odometry"
PHASES = {"global": "Global localization", "kidnap": "Kidnapping"}
ROWS = {"within_20": "converged within 20 updates [%]", "retention": "updates kept [%]",
        "strict_success": "last within 0.5 m and 5 deg [%]"}  # fmt: skip


@dataclass(frozen=True)
class Config:
    """Attributes: methods; factors on the error of each increment; runs of each on each sequence; particles; powers."""

    methods: tuple[str, ...] = ("adam_dsom", "adam_likelihood_grid", "adam_hybrid",
                                "robust_dsom", "robust_likelihood_grid", "robust_hybrid")  # fmt: skip
    factors: tuple[float, ...] = (1, 2, 3, 4, 5)
    runs: int = 15
    particles: int = 200
    powers: tuple[float, float] | None = POWERS


def jobs(config: Config) -> dict[str, Any]:
    """One for each method."""
    return {name: partial(disturb, name, config) for name in config.methods}


def disturb(name: str, config: Config, lab: Lab) -> dict[str, Any]:
    """Summaries of one method by factor."""
    sequences = lab.by_sequence(partial(follow, name, config, lab))
    return {
        "by_factor": {
            f"{factor:g}": {phase: summary([runs[phase] for runs in parts]) for phase in PHASES}
            for factor, parts in zip(config.factors, zip(*sequences, strict=True), strict=True)
        }
    }


def follow(
    name: str, config: Config, lab: Lab, number: int, where: str, grid: OccupancyGrid, episode: Episode
) -> list[dict[str, list[metrics.Runs]]]:
    """The runs of one method on one sequence: by factor, then by phase."""
    filter, keys = lab.build(name, where, grid, episode, config.particles), lab.keys(config.runs)[number]
    results = run_all(filter, noisier, config.factors, with_error(episode), keys)
    return [judge_drive(replies(result.info, judged_by(name)), episode, number) for result in results]


def summary(parts: list[list[metrics.Runs]]) -> dict[str, Any]:
    """The runs of one phase on all sequences, summarised."""
    return metrics.summarize(metrics.pool([runs for part in parts for runs in part]))


def figures(everything: Everything) -> dict[str, Figure]:
    """Convergence, retention and strict success by factor."""
    figure = Figure(figsize=(9, 8.6), layout="constrained")
    grid = figure.subplots(len(ROWS), 2, sharex=True, sharey="row", squeeze=False)
    for axes, (key, label) in zip(grid, ROWS.items(), strict=True):
        for ax, (phase, title) in zip(axes, PHASES.items(), strict=True):
            for name, entry in everything[NAME].items():
                _curve(ax, name, {f: m[phase] for f, m in entry["by_factor"].items()}, key)
            ax.set(title=title if ax in grid[0] else "", ylim=(-3, 103))
            ax.grid(axis="y", color="0.9", linewidth=0.6)
        axes[0].set_ylabel(label)
    for ax in grid[-1]:
        ax.set_xlabel("error of the odometry, times that of the suite")
        ax.xaxis.set_major_locator(MultipleLocator(1))
    handles, labels = grid[0][0].get_legend_handles_labels()
    legend(figure, handles, labels, 3)
    return {"odometry": figure}


def _curve(ax: Axes, name: str, by_factor: dict[str, Any], key: str) -> None:
    factors = np.array([float(factor) for factor in by_factor])
    label, color = STYLES[name]
    low, high = (100 * column([m[f"{key}_ci95"][n] for m in by_factor.values()]) for n in (0, 1))
    style = "o-" if name.startswith("adam") else "s--"
    ax.plot(factors, 100 * column([m[key] for m in by_factor.values()]), style, color=color, markersize=4, label=label)
    ax.fill_between(factors, low, high, color=color, alpha=0.12, linewidth=0)


def section(everything: Everything) -> str:
    """Table and figure."""
    results = everything[NAME]
    factors = list(next(iter(results.values()))["by_factor"])
    head = ["method", *(f"x {factor}: 0-20 / kept / strict %" for factor in factors)]
    blocks = [TEXT]
    for phase, title in PHASES.items():
        lines = [
            [f"`{name}`", *(_cell(entry["by_factor"][f][phase]) for f in factors)] for name, entry in results.items()
        ]
        blocks.append(f"**{title}**\n\n{markdown(head, lines)}")
    return "\n\n".join([*blocks, "![Odometry](FIGURES/odometry.png)"])


def _cell(m: dict[str, Any]) -> str:
    return " / ".join(percent(m[key], 0) for key in ROWS)


TEXT = """\
The suite's odometry is off by about 5 % of the way and 10 % of turns (one standard deviation). Here the error of every
increment is multiplied, and the filters are not told: their motion models stay as they are."""

PIECE = Piece(NAME, Config(), jobs, figures, section)
