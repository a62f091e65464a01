"""All methods on the six sequences, 100 times each: the paper's comparison (Fig 6, 7) and ablation (Fig 5) in one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import paper
from lab import POWERS, Everything, Lab, Piece, Results
from matplotlib.figure import Figure
from tables import bounds, markdown, number, percent

from dsom_jax import bench, plotting
from dsom_jax.filters.methods import METHODS
from dsom_jax.filters.settings import WEIGHT_POWER
from dsom_jax.judging.metrics import STEP_BINS
from dsom_jax.judging.run_table import RunTable, join

NAME = "comparison"
PHASES = ("global", "kidnap")
COMPARED = ("mcl", "mixture_mcl", "mixture_mcl_star", "pfrnn", "pf_net", "adam_dsom")
"""The paper's comparison."""
ABLATED = ("mcl", "mixture_mcl_star", "mixture_mcl_dsom", "adam_dsom", "adam_likelihood_grid", "adam_hybrid",
           "adam_markov_grid", "robust_dsom", "robust_likelihood_grid", "robust_hybrid")  # fmt: skip
"""The paper's ablation, then what is ours."""
OTHERS = ("robust_markov_grid", "adam_markov_dsom", "robust_markov_dsom", "adam_markov_hybrid", "robust_markov_hybrid")
"""Not compared here: AdaM robust with a memory is what localize runs, and memories of DSOM are for floor plans."""


@dataclass(frozen=True)
class Config:
    """Attributes: methods; runs of each on each sequence; particles; T_cut of Alg 1; powers of Eq 15."""

    methods: tuple[str, ...] = tuple(name for name in METHODS if name not in OTHERS)
    runs: int = 100
    particles: int = 200
    t_cut: float = 0.6
    weight_power: float = WEIGHT_POWER
    powers: tuple[float, float] | None = POWERS


def jobs(config: Config) -> dict[str, Any]:
    """One for each method."""
    return {name: partial(compare, name, config) for name in config.methods}


def compare(name: str, config: Config, lab: Lab) -> dict[str, Any]:
    """One method on all sequences: its entry of ``bench.json``, every run, and E_pos over time."""
    settings = bench.BenchSettings(config.runs, config.particles, config.t_cut, lab.seed, config.weight_power)
    entry, record = lab.compare(name, settings)
    bands = plotting.bands_of(record.traces)
    return {"summary": entry, "runs": record.table, "evolution": bands, "kidnapped": kidnappings(lab)}


def kidnappings(lab: Lab) -> list[list[int]]:
    """Updates at which the robot was carried away, by sequence."""
    return [np.flatnonzero(np.asarray(episode.kidnapped)).tolist() for _, _, episode in lab.suite.episodes]


def table_of(results: Results, methods: Sequence[str]) -> RunTable:
    """All runs of ``methods``."""
    return join([results[name]["runs"] for name in methods])


def errors_of(results: Results, methods: Sequence[str], which: str) -> dict[str, dict[str, np.ndarray]]:
    """Final errors of all runs: {phase: {method: (n,)}}; ``which`` is a column."""
    runs = table_of(results, methods)
    return {p: {m: getattr(runs, which)[(runs.phase == p) & (runs.method == m)] for m in methods} for p in PHASES}


def figures(everything: Everything) -> dict[str, Figure]:
    """Box plots, histograms and error over time, of the comparison and of the ablation."""
    results, made = everything[NAME], {}
    for title, chosen in (("comparison", COMPARED), ("ablation", ABLATED)):
        methods = [name for name in chosen if name in results]
        if not methods:
            continue
        made[f"{title}_e_pos"] = plotting.error_boxes(errors_of(results, methods, "e_pos_m"))
        theta = errors_of(results, methods, "e_theta_rad")
        made[f"{title}_e_theta"] = plotting.error_boxes(theta, r"final heading error $E_\theta$ [rad]", 1e-3)
        hists = {p: {m: results[m]["summary"][p]["steps_hist"] for m in methods} for p in PHASES}
        made[f"{title}_steps"] = plotting.step_bars(hists)
        moved = results[methods[0]]["kidnapped"]
        bands = [{m: results[m]["evolution"][n] for m in methods} for n in range(len(moved))]
        made[f"{title}_evolution"] = plotting.band_evolution(bands, moved)
    return made


HEAD = ("method", "converged %", "0-20 %", *(f"{b} %" for b in list(STEP_BINS)[1:]), "never %", "steps", "E_pos m",
        "E_theta rad", "E_pos m, all runs", "kept %", "strict %", "ms/update")  # fmt: skip


def section(everything: Everything) -> str:
    """Tables of both phases and the figures."""
    results = everything[NAME]
    blocks = [INTRODUCTION]
    for phase, title in zip(PHASES, ("Global localization", "Kidnapping"), strict=True):
        methods = [name for name in METHODS if name in results]
        lines = [cells(name, results[name]["summary"][phase], results[name]["summary"]) for name in methods]
        blocks.append(f"**{title}**\n\n" + markdown(HEAD, [*lines, *quoted(phase)]))
    return "\n\n".join([*blocks, FIGURES])


def cells(name: str, m: dict[str, Any], entry: dict[str, Any]) -> list[str]:
    """The row of a method in one phase."""
    bins = [percent(m["steps_hist"][b] / m["experiments"]) for b in (*STEP_BINS, "never")]
    return [
        f"`{name}`", percent(m["converged"]) + bounds(m["converged_ci95"], 100, 0), *bins,
        number(m["steps_median"], 0), number(m["e_pos_m"], 3) + bounds(m["e_pos_ci95"], 1, 3),
        number(m["e_theta_rad"], 3) + bounds(m["e_theta_ci95"], 1, 3),
        number(m["final_e_pos_m_all"], 2), percent(m["retention"]), percent(m["strict_success"]),
        number(entry["ms_per_step"], 1),
    ]  # fmt: skip


def quoted(phase: str) -> list[list[str]]:
    """The paper's rows: what it prints (Table II) and what can be read off its Fig 7."""
    errors = [number(paper.PARTICLES[200].of(phase, which), 3) for which in ("e_pos", "e_theta")]
    rows = []
    for name, share in paper.WITHIN_20[phase].items():
        ours = name in METHODS
        found = {HEAD[2]: f"{percent(share.value, 0)} ({share.source})"}
        found |= dict(zip(("E_pos m", "E_theta rad"), errors, strict=True)) if ours else {}
        rows.append([f"*paper: {f'`{name}`' if ours else name}*", *(found.get(head, "") for head in HEAD[1:])])
    return rows


INTRODUCTION = """\
Six sequences (two buildings that no training of DSOM saw, 20 unknown obstacles, 4 pieces of structure gone, one
kidnapping each), 200 particles, T_cut 0.6. PF-Net and PFRNN were trained in these two buildings, Mixture MCL's samples
were collected in them, those of Mixture MCL* contain the test sequence. All but `robust_*` are judged by the weighted
mean of the particles as in the paper, `robust_*` by the heaviest cluster. E_pos and E_theta: mean final error over
converged runs [95 % interval, by sequence]; whether the paper's means are over all runs it does not say. Its
rows: Table II, and what can be read off its Fig 7, good to a few per cent. Kept: share of the updates after convergence
within 2 m and 10 deg; strict: last estimate within 0.5 m and 5 deg.
ms/update: all runs together."""

FIGURES = """\
Over time: mean over the runs of a sequence, shaded where 95 % of such means would lie (the luck of the runs, not of the
drive); below 2 m (and 10 deg) a run counts as
converged. Paper's comparison (its Fig 6 and 7):

![Final position errors](FIGURES/comparison_e_pos.png)

![Final heading errors](FIGURES/comparison_e_theta.png)

![Converging steps](FIGURES/comparison_steps.png)

![Error over time](FIGURES/comparison_evolution.png)

Ablation (its Fig 5), and the filters and proposals of our own:

![Final position errors](FIGURES/ablation_e_pos.png)

![Final heading errors](FIGURES/ablation_e_theta.png)

![Converging steps](FIGURES/ablation_steps.png)

![Error over time](FIGURES/ablation_evolution.png)"""

PIECE = Piece(NAME, Config(), jobs, figures, section, timed=True)
