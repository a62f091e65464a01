"""Error boxes, converging steps, error over time, calibration."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from dsom_jax.judging.metrics import Runs, steps_histogram
from dsom_jax.plotting.common import legend, panels

STYLES = {
    "mcl": ("MCL", "#7f7f7f"),
    "mixture_mcl": ("Mixture MCL", "#c5a35a"),
    "mixture_mcl_star": ("Mixture MCL*", "#8c6d31"),
    "mixture_mcl_dsom": ("Mixture MCL + DSOM", "#e377c2"),
    "adam_dsom": ("AdaM + DSOM", "#d62728"),
    "adam_likelihood_grid": ("AdaM + likelihood grid", "#ff7f0e"),
    "adam_hybrid": ("AdaM + hybrid", "#b5179e"),
    "adam_markov_grid": ("AdaM + Markov grid", "#7f3b08"),
    "adam_markov_dsom": ("AdaM + Markov DSOM", "#5e3c99"),
    "adam_markov_hybrid": ("AdaM + Markov hybrid", "#2d004b"),
    "mcl_sharp": ("MCL, sharp", "#4d4d4d"),
    "mixture_mcl_sharp": ("Mixture MCL, sharp", "#a6761d"),
    "mixture_mcl_sharp_star": ("Mixture MCL*, sharp", "#543005"),
    "mixture_mcl_sharp_dsom": ("Mixture MCL + DSOM, sharp", "#c51b7d"),
    "adam_sharp_dsom": ("AdaM + DSOM, sharp", "#99000d"),
    "adam_sharp_likelihood_grid": ("AdaM + likelihood grid, sharp", "#cc4c02"),
    "adam_sharp_hybrid": ("AdaM + hybrid, sharp", "#7a0177"),
    "adam_sharp_markov_grid": ("AdaM + Markov grid, sharp", "#4d2500"),
    "adam_sharp_markov_dsom": ("AdaM + Markov DSOM, sharp", "#3f007d"),
    "adam_sharp_markov_hybrid": ("AdaM + Markov hybrid, sharp", "#1a0033"),
    "robust_dsom": ("robust + DSOM", "#1f77b4"),
    "robust_likelihood_grid": ("robust + likelihood grid", "#2ca02c"),
    "robust_hybrid": ("robust + hybrid", "#17becf"),
    "robust_markov_grid": ("robust + Markov grid", "#006d2c"),
    "robust_markov_dsom": ("robust + Markov DSOM", "#08306b"),
    "robust_markov_hybrid": ("robust + Markov hybrid", "#4292c6"),
    "pf_net": ("PF-Net", "#bcbd22"),
    "pfrnn": ("PFRNN", "#9467bd"),
}
"""Name and colour of each method in figures."""
STEP_COLORS = {"0-20": "#2a7f3f", "20-40": "#8cc56b", "40-60": "#f2c14e", ">60": "#ef8354", "never": "#8d99ae"}
_FLOOR = 1e-2
"""Metres below which an error is drawn as this on a logarithmic axis."""
_FLIERS = {"marker": ".", "markersize": 2.5, "markerfacecolor": "0.3", "markeredgewidth": 0, "alpha": 0.4}
_MEANS = {"marker": "D", "markersize": 4, "markerfacecolor": "white", "markeredgecolor": "black"}


def error_boxes(
    errors: Mapping[str, Mapping[str, np.ndarray]],
    label: str = "final position error $E_{pos}$ [m]",
    floor: float = _FLOOR,
) -> Figure:
    """Final errors of all runs, one panel per phase, one box per method: {phase: {method: (N,)}}.

    ``label`` names the error and its unit; what is below ``floor`` is drawn there.
    """
    widest = max(len(methods) for methods in errors.values())
    figure, axes = panels(len(errors), 1 + 0.7 * widest, 4.0, sharey=True)
    for ax, (phase, methods) in zip(axes, errors.items(), strict=True):
        drawn = [np.clip(e[np.isfinite(e)], floor, None) for e in methods.values()]
        boxes = ax.boxplot(drawn, widths=0.6, patch_artist=True, showmeans=True, flierprops=_FLIERS,
                           meanprops=_MEANS, medianprops={"color": "black"})  # fmt: skip
        for box, name in zip(boxes["boxes"], methods, strict=True):
            box.set(facecolor=_color(name), alpha=0.75)
        ax.set(title=_phase_title(phase), yscale="log")
        ax.set_xticks(range(1, len(methods) + 1), [_label(name) for name in methods], rotation=35, ha="right")
        _metre_ticks(ax)
    axes[0].set_ylabel(label)
    figure.supxlabel("line: median, diamond: mean, whiskers: 1.5 IQR; all runs", fontsize=8, color="0.4")
    return figure


def step_bars(histograms: Mapping[str, Mapping[str, Mapping[str, int]]]) -> Figure:
    """Stacked shares of converging steps, one panel per phase: {phase: {method: {"0-20": count, ...}}}."""
    tallest = max(len(methods) for methods in histograms.values())
    figure, axes = panels(len(histograms), 4.6, 1.3 + 0.34 * tallest, sharey=True)
    for ax, (phase, methods) in zip(axes, histograms.items(), strict=True):
        left = np.zeros(len(methods))
        totals = [max(sum(counts.values()), 1) for counts in methods.values()]
        for name, color in STEP_COLORS.items():
            share = np.array(
                [100 * counts[name] / total for counts, total in zip(methods.values(), totals, strict=True)]
            )
            ax.barh(range(len(methods)), share, left=left, color=color, label=name, edgecolor="white", linewidth=0.5)
            _write_shares(ax, left, share)
            left += share
        ax.set(title=_phase_title(phase), xlabel="share of runs [%]", xlim=(0, 100))
        ax.set_yticks(range(len(methods)), [_label(name) for name in methods])
        ax.tick_params(left=False)
    axes[0].invert_yaxis()
    legend(figure, *axes[0].get_legend_handles_labels(), title="updates until converged", columns=5)
    return figure


Band = np.ndarray
"""(3, T) mean of an error over the updates and its band, low and high, NaN where the truth is unknown."""


def error_evolution(traces: Sequence[Mapping[str, np.ndarray]], kidnapped: Sequence[Any]) -> Figure:
    """Mean E_pos (metres) over the updates with its band: per episode {method: (R, T)} and kidnap flags (T,)."""
    bands = [{name: band_of(errors) for name, errors in by.items()} for by in traces]
    return band_evolution(bands, [np.flatnonzero(np.asarray(moved)).tolist() for moved in kidnapped])


def band_of(errors: np.ndarray) -> Band:
    """Mean of ``errors`` (R, T) over the runs of one drive at each update, and where 95 % of such means would lie.

    That band is about the luck of the runs of this drive alone, and says nothing of other drives.
    """
    time = np.flatnonzero(~np.isnan(errors).all(0))
    known = errors[:, time]
    # An estimate that is no number is drawn as the worst error that was seen.
    known = np.where(np.isfinite(known), known, np.max(known, initial=0.0, where=np.isfinite(known)))
    runs = len(known)
    draws = np.random.default_rng(0).multinomial(runs, np.full(runs, 1 / runs), size=500)
    band = np.full((3, errors.shape[1]), np.nan)
    band[:, time] = known.mean(0), *np.percentile(draws @ known / runs, [2.5, 97.5], axis=0)
    return band


def bands_of(traces: Sequence[np.ndarray]) -> np.ndarray:
    """(S, 3, T) bands of the errors (R, T) of S drives, NaN behind the end of short ones; float32, to be kept."""
    kept = np.full((len(traces), 3, max(trace.shape[1] for trace in traces)), np.nan, np.float32)
    for band, trace in zip(kept, traces, strict=True):
        band[:, : trace.shape[1]] = band_of(trace)
    return kept


def band_evolution(bands: Sequence[Mapping[str, Band]], kidnapped: Sequence[Sequence[int]]) -> Figure:
    """As :func:`error_evolution`, from bands and the updates at which the robot was carried away."""
    columns = min(3, len(bands))
    rows = -(-len(bands) // columns)
    figure = Figure(figsize=(4.2 * columns, 2.7 * rows + 0.6), layout="constrained")
    grid = figure.subplots(rows, columns, squeeze=False, sharey=True)
    for ax, methods, moved, number in zip(grid.flat, bands, kidnapped, range(len(bands)), strict=False):
        for name, band in methods.items():
            _band(ax, band, _color(name), _label(name))
        for t in moved:
            ax.axvline(t, color="black", linestyle=":", linewidth=1, label="kidnapped")
        ax.axhline(2.0, color="0.5", linewidth=0.8, linestyle="--", label="2 m")
        last = max((int(np.flatnonzero(~np.isnan(band[0])).max(initial=0)) for band in methods.values()), default=0)
        ax.set(yscale="log", xlabel="update", title=f"sequence {number + 1}", xlim=(0, last))
        _metre_ticks(ax)
    for ax in grid[:, 0]:
        ax.set_ylabel("mean $E_{pos}$ [m]")
    for ax in list(grid.flat)[len(bands) :]:
        ax.set_axis_off()
    named = {label: handle for ax in grid.flat for handle, label in zip(*ax.get_legend_handles_labels(), strict=True)}
    legend(figure, list(named.values()), list(named), columns=min(6, len(named)))
    return figure


def benchmark_figures(
    runs: Mapping[str, Mapping[str, Runs]], traces: Sequence[Mapping[str, np.ndarray]], kidnapped: Sequence[Any]
) -> dict[str, Figure]:
    """The three figures of a benchmark by file name, from {method: {phase: Runs}} and E_pos per episode."""
    seen = [phase for phase in ("global", "kidnap") if any(len(by[phase].steps) for by in runs.values())]
    errors = {phase: {name: by[phase].e_pos for name, by in runs.items()} for phase in seen}
    steps = {phase: {name: steps_histogram(by[phase].steps) for name, by in runs.items()} for phase in seen}
    return {
        "position_error": error_boxes(errors),
        "converging_steps": step_bars(steps),
        "error_evolution": error_evolution(traces, kidnapped),
    }


def calibration_curves(curves: Mapping[str, tuple[np.ndarray, np.ndarray]]) -> Figure:
    """Share of truths inside the smallest region that holds probability p, against p: {name: (p, share)}."""
    figure, (ax,) = panels(1, 5.0, 4.4)
    ax.plot([0, 1], [0, 1], color="0.6", linestyle="--", linewidth=1, label="calibrated")
    for number, (name, (p, share)) in enumerate(curves.items()):
        ax.plot(p, share, marker=".", color=f"C{number}", label=name)
    ax.set(xlabel="probability p of the region", ylabel="share of scans whose pose lies inside", aspect="equal")
    ax.legend(frameon=False, fontsize=8)
    return figure


def _band(ax: Axes, band: Band, color: str, label: str) -> None:
    """The mean and its band, where the reference is known."""
    time = np.flatnonzero(~np.isnan(band[0]))
    mean, low, high = np.maximum(band[:, time], _FLOOR)
    ax.plot(time, mean, color=color, linewidth=1.4, label=label)
    ax.fill_between(time, low, high, color=color, alpha=0.2, linewidth=0)


def _write_shares(ax: Axes, left: np.ndarray, share: np.ndarray) -> None:
    """The number inside each bar that is wide enough for it."""
    for y, (start, width) in enumerate(zip(left, share, strict=True)):
        if width >= 8:
            ax.text(start + width / 2, y, f"{width:.0f}", ha="center", va="center", fontsize=7)


def _color(method: str) -> str:
    """The method's own colour; strangers get one that depends on their name only."""
    return STYLES[method][1] if method in STYLES else f"C{sum(map(ord, method)) % 10}"


def _label(method: str) -> str:
    return STYLES[method][0] if method in STYLES else method


def _phase_title(phase: str) -> str:
    return {"global": "Global localization", "kidnap": "Kidnapping"}.get(phase, phase)


def _metre_ticks(ax: Axes) -> None:
    ax.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
    ax.grid(axis="y", color="0.9", linewidth=0.6)
    ax.set_axisbelow(True)
