"""Alg 1 by T_cut and proposal (Table I), and how often and why it leaves a place that it had found."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import numpy as np
import paper
from departures import Part, Scene, departures
from lab import POWERS, PROPOSALS, Everything, Lab, Piece, column
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from side_by_side import other_t_cut, run_all
from tables import bounds, markdown, number, percent

from dsom_jax.episode import Episode
from dsom_jax.filters.methods import COMBINATIONS
from dsom_jax.judging import metrics, quality
from dsom_jax.judging.run_table import RunTable, join, run_rows
from dsom_jax.judging.scores import judge_drive, judged_by, replies
from dsom_jax.montecarlo import run
from dsom_jax.occupancy import OccupancyGrid
from dsom_jax.plotting.common import legend, log_ticks

NAME = "retention"
DSOM = "adam_dsom"
"""Of Table I."""


@dataclass(frozen=True)
class Config:
    """Attributes: proposals; values of T_cut; runs of each on each sequence; particles; powers."""

    proposals: tuple[str, ...] = ("dsom", "likelihood_grid", "hybrid")
    t_cuts: tuple[float, ...] = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9)
    runs: int = 25
    particles: int = 200
    powers: tuple[float, float] | None = POWERS


def jobs(config: Config) -> dict[str, Any]:
    """One for each filter: Alg 1 with all values of T_cut, and AdaM robust, with each proposal."""
    methods = [f"{algorithm}_{proposal}" for proposal in config.proposals for algorithm in ("adam", "robust")]
    return {name: partial(keep, name, config) for name in methods if name in COMBINATIONS}


def keep(name: str, config: Config, lab: Lab) -> dict[str, Any]:
    """Results, all runs, and departures of one filter, by T_cut; the robust filter has none and stands under "-"."""
    adam = COMBINATIONS[name][0] == "adam"
    cuts = config.t_cuts if adam else (None,)
    sequences = lab.by_sequence(partial(follow, name, config, lab))
    by_cut = zip(cuts, zip(*sequences, strict=True), strict=True)
    return {"by_t_cut": {"-" if cut is None else f"{cut:g}": told(list(parts), cut) for cut, parts in by_cut}}


def follow(
    name: str, config: Config, lab: Lab, number: int, where: str, grid: OccupancyGrid, episode: Episode
) -> list[Part]:
    """The runs of one filter on one sequence, by T_cut."""
    filter: Any = lab.build(name, where, grid, episode, config.particles)
    keys = lab.keys(config.runs)[number]
    if COMBINATIONS[name][0] == "adam":
        results = run_all(filter, other_t_cut, config.t_cuts, episode, keys)
    else:
        results = [run(filter, episode, keys)]
    # Alg 1 and AdaM robust draw from the same proposals, but for the exponent of a network's PM.
    which = COMBINATIONS[name][1], getattr(filter.proposal, "sharpness", 1.0), number
    scene = lab.shared[which] = lab.shared.get(which) or scene_of(lab, filter, where, grid, episode)
    return [Part(name, number, episode, result, scene) for result in results]


def scene_of(lab: Lab, filter: Any, where: str, grid: OccupancyGrid, episode: Episode) -> Scene:
    """PM and trust at the truth, for every scan of a sequence."""
    found = quality.of_scans(filter.proposal, grid, episode.ranges, episode.poses)
    scored = lab.build("mcl", where, grid, episode)  # Its weights are those of Alg 1.
    return Scene(np.asarray(found.mass), np.asarray(trusts(scored, episode.poses, episode.ranges)))


@jax.jit
def trusts(filter: Any, poses: Any, ranges: Any) -> Any:
    """T = w / w* (T,) of a particle at each pose (T, 3) for its scan (T, B)."""
    return jax.vmap(lambda pose, seen: filter.world.weigh(pose[None], seen)[0])(poses, ranges)


def told(parts: list[Part], t_cut: float | None) -> dict[str, Any]:
    """Summary, rows and departures of one filter at one T_cut."""
    found: list[RunTable] = []
    pooled: dict[str, list[metrics.Runs]] = {"global": [], "kidnap": []}
    for part in parts:
        given = replies(part.result.info, judged_by(part.method))
        for phase, runs in judge_drive(given, part.episode, part.number).items():
            pooled[phase] += runs
            found += [run_rows(part.method, phase, part.number, n, some) for n, some in enumerate(runs)]
    summaries = {phase: metrics.summarize(metrics.pool(runs)) for phase, runs in pooled.items()}
    return {"summary": summaries, "runs": join(found), "departures": departures(parts, t_cut)}


PHASES = {"global": "Global localization", "kidnap": "Kidnapping"}
UNITS = {"e_pos_m": ("e_pos", "mean final $E_{pos}$ [m]"), "e_theta_rad": ("e_theta", r"mean final $E_\theta$ [rad]")}


def figures(everything: Everything) -> dict[str, Figure]:
    """Table I as curves; retention by T_cut and proposal."""
    drawn = {"retention": kept_by_t_cut(everything)}
    return drawn | ({"t_cut": errors_by_t_cut(everything)} if DSOM in everything[NAME] else {})


def errors_by_t_cut(everything: Everything) -> Figure:
    """Errors of converged runs, ours and the paper's."""
    found = everything[NAME][DSOM]["by_t_cut"]
    figure, grid = panels(2)
    for axes, (key, (which, label)) in zip(grid, UNITS.items(), strict=True):
        for ax, (phase, title) in zip(axes, PHASES.items(), strict=True):
            _curve(ax, found, phase, key, f"{which}_ci95", "AdaM + DSOM, ours", PROPOSALS["dsom"][1])
            theirs = [row.of(phase, which) for row in paper.T_CUT.values()]
            ax.plot(list(paper.T_CUT), theirs, "ks--", markersize=4, linewidth=1, label="paper, Table I")
            ax.set(title=title, yscale="log", xlabel="$T_{cut}$", ylabel=label)
            _finish(ax)
            log_ticks(ax.yaxis)
    handles, labels = grid[0][0].get_legend_handles_labels()
    legend(figure, handles, labels, 2)
    return figure


def kept_by_t_cut(everything: Everything) -> Figure:
    """Share of the updates after convergence that are kept, by proposal, Alg 1 and AdaM robust."""
    figure, (axes,) = panels(1)
    for ax, (phase, title) in zip(axes, PHASES.items(), strict=True):
        for name, entry in everything[NAME].items():
            algorithm, proposal = COMBINATIONS[name]
            label, color = PROPOSALS[proposal]
            if algorithm == "adam":
                _curve(ax, entry["by_t_cut"], phase, "retention", "retention_ci95", f"Alg 1 + {label}", color, 100)
            else:
                kept = entry["by_t_cut"]["-"]["summary"][phase]["retention"]
                ax.axhline(100 * (np.nan if kept is None else kept), color=color, linestyle=":", linewidth=1.5,
                           label=f"robust + {label}")  # fmt: skip
        ax.set(title=title, xlabel="$T_{cut}$", ylabel="updates kept after convergence [%]")
        _finish(ax)
    handles, labels = axes[0].get_legend_handles_labels()
    legend(figure, handles, labels, 3)
    return figure


def panels(rows: int) -> tuple[Figure, Any]:
    """Rows of two panels."""
    figure = Figure(figsize=(9, 3.2 * rows + 0.5), layout="constrained")
    return figure, figure.subplots(rows, 2, squeeze=False, sharey="row")


def _curve(ax: Axes, by_t_cut: Any, phase: str, key: str, ci: str, label: str, color: str, scale: float = 1) -> None:
    """A number and its interval over T_cut."""
    cuts = [float(cut) for cut in by_t_cut]
    rows_ = [entry["summary"][phase] for entry in by_t_cut.values()]
    low, high = (scale * column([row[ci][n] for row in rows_]) for n in (0, 1))
    ax.plot(cuts, scale * column([row[key] for row in rows_]), "o-", color=color, markersize=4, label=label)
    ax.fill_between(cuts, low, high, color=color, alpha=0.2, linewidth=0)


def _finish(ax: Axes) -> None:
    ax.grid(axis="y", color="0.9", linewidth=0.6)
    ax.yaxis.set_major_formatter(lambda value, _: f"{value:g}")


def section(everything: Everything) -> str:
    """Table I, retention and causes of departures."""
    first = []
    if DSOM in everything[NAME]:
        first = [TABLE_1, t_cut_table(everything), "![Errors by T_cut](FIGURES/t_cut.png)"]
    last = [RETENTION, departure_table(everything), "![Retention by T_cut](FIGURES/retention.png)"]
    return "\n\n".join([*first, *last])


def t_cut_table(everything: Everything) -> str:
    """Ours beside the paper's."""
    head = ["T_cut"]
    for phase in ("global", "kidnapping"):
        head += [f"E_pos m, {phase}", "paper", f"E_theta rad, {phase}", "paper", "converged %", "kept %"]
    lines = []
    for cut, entry in everything[NAME][DSOM]["by_t_cut"].items():
        line = [cut]
        theirs = paper.T_CUT.get(float(cut))
        for phase, m in entry["summary"].items():
            for key, (which, _) in UNITS.items():
                line.append(number(m[key], 3) + bounds(m[f"{which}_ci95"], 1, 3))
                line.append(number(theirs.of(phase, which) if theirs else None, 3))
            line += [percent(m["converged"]), percent(m["retention"])]
        lines.append(line)
    return markdown(head, lines)


def departure_table(everything: Everything) -> str:
    """Both filters, every proposal, every T_cut."""
    lines = []
    for name, entry in everything[NAME].items():
        for cut, found in entry["by_t_cut"].items():
            d = found["departures"]
            kept = [percent(found["summary"][phase]["retention"], 2) for phase in PHASES]
            causes = [_both(d, key) for key in ("pm_poor", "doubted", "redrawn")]
            lines.append([f"`{name}`", cut, *kept, str(d["count"]), number(d["per_100_updates"], 2),
                          percent(d["dragged"], 0), *causes, percent(d["returned"], 0),
                          number(d["length_median"], 0)])  # fmt: skip
    head = ["filter", "T_cut", "kept %, global", "kept %, kidnapping", "departures", "per 100 updates"]
    head += ["only the mean %", "PM elsewhere %", "truth doubted %", "redrawn %", "came back %", "after updates"]
    return markdown(head, lines)


def _both(d: dict[str, Any], key: str) -> str:
    """At departures, and at the updates that were kept."""
    if all(d[name] is None for name in (key, f"{key}_otherwise")):
        return "-"
    return f"{percent(d[key], 0)} ({percent(d[f'{key}_otherwise'], 0)})"


TABLE_1 = """\
Table I: AdaM + DSOM, 200 particles. All values of T_cut have the same scans, keys and maps."""

RETENTION = """\
**Retention.** A departure is an update outside of 2 m and 10 deg that follows one inside, once the run had converged;
both phases together. *Only the mean*: the heaviest cluster was still right, and only the weighted mean, which the paper
answers with, was not. *PM elsewhere*: less than a tenth of PM within 1 m and 15 deg of the truth at that update. *Truth
doubted*: a particle at the true pose itself would not have had a trust above T_cut at the update before, so that Alg 1
would have redrawn it with probability 1 - T. *Redrawn*: particles drawn from PM. In brackets: the same at the updates
that were kept."""

PIECE = Piece(NAME, Config(), jobs, figures, section)
