"""Figures of the paper: error boxes, converging steps, error over time, and PM over the map with particles.

Every function returns a matplotlib ``Figure`` that no window system knows of; :func:`save` writes it as PNG or PDF.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.transforms import Affine2D

from dsom_jax.episode import Episode
from dsom_jax.geometry import transform_points
from dsom_jax.lidar import LidarConfig, scan_points
from dsom_jax.metrics import Runs, steps_histogram
from dsom_jax.occupancy import OccupancyGrid
from dsom_jax.pose_grid import ProbabilityMap
from dsom_jax.types import Filter, Inputs, Proposal

STYLES = {
    "mcl": ("MCL", "#7f7f7f"),
    "mixture_mcl": ("Mixture MCL", "#c5a35a"),
    "mixture_mcl_star": ("Mixture MCL*", "#8c6d31"),
    "mixture_mcl_dsom": ("Mixture MCL + DSOM", "#e377c2"),
    "adam_dsom": ("AdaM + DSOM", "#d62728"),
    "adam_likelihood_grid": ("AdaM + likelihood grid", "#ff7f0e"),
    "adam_hybrid": ("AdaM + hybrid", "#b5179e"),
    "robust_dsom": ("robust + DSOM", "#1f77b4"),
    "robust_likelihood_grid": ("robust + likelihood grid", "#2ca02c"),
    "robust_hybrid": ("robust + hybrid", "#17becf"),
    "pf_net": ("PF-Net", "#bcbd22"),
    "pfrnn": ("PFRNN", "#9467bd"),
}
"""Name and colour of each method in figures."""
STEP_COLORS = {"0-20": "#2a7f3f", "20-40": "#8cc56b", "40-60": "#f2c14e", ">60": "#ef8354", "never": "#8d99ae"}
FLOOR = 1e-2
"""Metres below which an error is drawn as this on a logarithmic axis."""


def save(figure: Figure, path: Path) -> None:
    """Write PNG at 150 dpi or PDF, as the ending of ``path`` says, whole or not at all."""
    draft = path.with_name(f".{path.name}")
    figure.savefig(draft, format=path.suffix[1:], dpi=150, bbox_inches="tight")
    draft.replace(path)


def error_boxes(errors: Mapping[str, Mapping[str, np.ndarray]]) -> Figure:
    """Final E_pos (metres) of all runs, one panel per phase, one box per method: {phase: {method: (N,)}}."""
    widest = max(len(methods) for methods in errors.values())
    figure, axes = _panels(len(errors), 1 + 0.7 * widest, 4.0, sharey=True)
    for ax, (phase, methods) in zip(axes, errors.items(), strict=True):
        drawn = [np.clip(e[np.isfinite(e)], FLOOR, None) for e in methods.values()]
        boxes = ax.boxplot(drawn, widths=0.6, patch_artist=True, showmeans=True, flierprops=_FLIERS,
                           meanprops=_MEANS, medianprops={"color": "black"})  # fmt: skip
        for box, name in zip(boxes["boxes"], methods, strict=True):
            box.set(facecolor=_color(name), alpha=0.75)
        ax.set(title=_phase_title(phase), yscale="log")
        ax.set_xticks(range(1, len(methods) + 1), [_label(name) for name in methods], rotation=35, ha="right")
        _metre_ticks(ax)
    axes[0].set_ylabel("final position error $E_{pos}$ [m]")
    figure.supxlabel("line: median, diamond: mean, whiskers: 1.5 IQR; all runs", fontsize=8, color="0.4")
    return figure


def step_bars(histograms: Mapping[str, Mapping[str, Mapping[str, int]]]) -> Figure:
    """Stacked shares of converging steps, one panel per phase: {phase: {method: {"0-20": count, ...}}}."""
    tallest = max(len(methods) for methods in histograms.values())
    figure, axes = _panels(len(histograms), 4.6, 1.3 + 0.34 * tallest, sharey=True)
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
    _legend(figure, *axes[0].get_legend_handles_labels(), title="updates until converged", columns=5)
    return figure


def error_evolution(traces: Sequence[Mapping[str, np.ndarray]], kidnapped: Sequence[Any]) -> Figure:
    """Mean E_pos (metres) over the updates with its 95 % band: per episode {method: (R, T)} and kidnap flags (T,)."""
    columns = min(3, len(traces))
    rows = -(-len(traces) // columns)
    figure = Figure(figsize=(4.2 * columns, 2.7 * rows + 0.6), layout="constrained")
    grid = figure.subplots(rows, columns, squeeze=False, sharey=True)
    for ax, methods, moved, number in zip(grid.flat, traces, kidnapped, range(len(traces)), strict=False):
        for name, errors in methods.items():
            _band(ax, errors, _color(name), _label(name))
        for t in np.flatnonzero(np.asarray(moved)):
            ax.axvline(t, color="black", linestyle=":", linewidth=1, label="kidnapped")
        ax.axhline(2.0, color="0.5", linewidth=0.8, linestyle="--")
        ax.set(yscale="log", xlabel="update", title=f"sequence {number + 1}", xlim=(0, len(np.asarray(moved)) - 1))
        _metre_ticks(ax)
    for ax in grid[:, 0]:
        ax.set_ylabel("mean $E_{pos}$ [m]")
    for ax in list(grid.flat)[len(traces) :]:
        ax.set_axis_off()
    named = {label: handle for ax in grid.flat for handle, label in zip(*ax.get_legend_handles_labels(), strict=True)}
    _legend(figure, list(named.values()), list(named), columns=min(6, len(named)))
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
    figure, (ax,) = _panels(1, 5.0, 4.4)
    ax.plot([0, 1], [0, 1], color="0.6", linestyle="--", linewidth=1, label="calibrated")
    for number, (name, (p, share)) in enumerate(curves.items()):
        ax.plot(p, share, marker=".", color=f"C{number}", label=name)
    ax.set(xlabel="probability p of the region", ylabel="share of scans whose pose lies inside", aspect="equal")
    ax.legend(frameon=False, fontsize=8)
    return figure


def map_view(
    ax: Axes,
    grid: OccupancyGrid,
    pm: np.ndarray | None = None,
    pm_origin: Any = None,
    pm_resolution: float | None = None,
    particles: np.ndarray | None = None,
    points: np.ndarray | None = None,
    truth: Any = None,
    estimate: Any = None,
) -> None:
    """One moment of a filter in the map frame (metres).

    pm (H, W) or (H, W, K) probabilities, drawn over four decades below their peak, on a raster whose lower-left corner
    has the pose ``pm_origin`` (default: the map's); particles (N, 3); points (M, 2) scan ends; truth and estimate (3,).
    """
    free, occupied = np.asarray(grid.free), np.asarray(grid.occupied)
    shade = np.where(occupied, 0.15, np.where(free, 1.0, 0.8))
    _raster(ax, shade, np.asarray(grid.origin), grid.resolution, cmap="gray", vmin=0, vmax=1)
    if pm is not None:
        _draw_pm(ax, pm, grid.origin if pm_origin is None else pm_origin, pm_resolution or grid.resolution)
    if points is not None:
        ax.plot(*np.asarray(points).T, ".", color="#1f77b4", markersize=2.5, label="scan", zorder=3)
    if particles is not None:
        _arrows(ax, particles, "#2a7f3f", 1.0, "particles", alpha=0.5)
    if truth is not None:
        _arrows(ax, np.asarray(truth)[None], "#d62728", 3.0, "truth", hollow=True)
    if estimate is not None:
        _arrows(ax, np.asarray(estimate)[None], "#7b2cbf", 2.0, "estimate")
    ax.set(aspect="equal", xlabel="x [m]", ylabel="y [m]")


def map_views(views: Sequence[Mapping[str, Any]], titles: Sequence[str]) -> Figure:
    """Moments side by side: the arguments of :func:`map_view` after ``ax``, and a title each."""
    figure, axes = _panels(len(views), 4.4, 4.9, sharey=True)
    for ax, view, title in zip(axes, views, titles, strict=True):
        map_view(ax, **view)
        ax.set_title(title)
        ax.label_outer()
    named = {label: handle for ax in axes for handle, label in zip(*ax.get_legend_handles_labels(), strict=True)}
    if any(view.get("pm") is not None for view in views):
        named["PM (summed over headings, 4 decades)"] = Patch(color="#fd8d3c")
    _legend(figure, list(named.values()), list(named), columns=max(len(named), 1))
    return figure


def moment_figure(
    grid: OccupancyGrid,
    lidar: LidarConfig,
    episode: Episode,
    filter: Filter,
    times: Sequence[int],
    particles: Any,
    estimates: Any,
) -> Figure:
    """A filter at updates ``times`` (K,): its particles (K, N, 3), estimates (T, 3), and the PM it drew from."""
    proposal = getattr(filter, "proposal", None)
    views, titles = [], []
    for t, poses in zip(times, np.asarray(particles), strict=True):
        truth = np.asarray(episode.poses[t])
        known = bool(np.isfinite(truth).all())
        ends, hit = scan_points(episode.ranges[t], lidar)
        points = transform_points(jnp.asarray(truth if known else estimates[t]), ends)[hit]
        view = {"points": points, "truth": truth if known else None, "estimate": estimates[t], "particles": poses}
        inputs = jax.tree.map(lambda leaf, t=t: leaf[t], episode.inputs)
        views.append({"grid": grid, **view, **(_pm_of(_prepare(proposal, inputs)) if proposal else {})})
        titles.append(f"update {t}" + (", just kidnapped" if bool(episode.kidnapped[t]) and t else ""))
    return map_views(views, titles)


@jax.jit
def _prepare(proposal: Proposal, inputs: Inputs) -> Any:
    """What a proposal makes of one scan; compiled once for each kind of proposal."""
    return proposal.prepare(inputs)


def _pm_of(prepared: Any) -> dict[str, Any]:
    """The first probability map in what a filter prepared, as arguments of :func:`map_view`."""
    leaves = jax.tree.leaves(prepared, is_leaf=lambda leaf: isinstance(leaf, ProbabilityMap))
    for pm in (leaf for leaf in leaves if isinstance(leaf, ProbabilityMap)):
        return {"pm": pm.mass, "pm_origin": pm.pose_grid.origin, "pm_resolution": pm.pose_grid.resolution}
    return {}


_FLIERS = {"marker": ".", "markersize": 2.5, "markerfacecolor": "0.3", "markeredgewidth": 0, "alpha": 0.4}
_MEANS = {"marker": "D", "markersize": 4, "markerfacecolor": "white", "markeredgecolor": "black"}


def _panels(count: int, width: float, height: float, sharey: bool = False) -> tuple[Figure, list[Axes]]:
    figure = Figure(figsize=(width * count, height), layout="constrained")
    return figure, list(figure.subplots(1, count, squeeze=False, sharey=sharey)[0])


def _band(ax: Axes, errors: np.ndarray, color: str, label: str) -> None:
    """Mean over runs (R, T) and its bootstrap 95 % interval, where the reference is known."""
    time = np.flatnonzero(~np.isnan(errors).all(0))
    errors = errors[:, time]
    # An estimate that is no number is drawn as the worst error that was seen.
    errors = np.where(np.isfinite(errors), errors, np.max(errors, initial=0.0, where=np.isfinite(errors)))
    runs = len(errors)
    draws = np.random.default_rng(0).multinomial(runs, np.full(runs, 1 / runs), size=500)
    low, high = np.percentile(draws @ errors / runs, [2.5, 97.5], axis=0)
    ax.plot(time, np.maximum(errors.mean(0), FLOOR), color=color, linewidth=1.4, label=label)
    ax.fill_between(time, np.maximum(low, FLOOR), np.maximum(high, FLOOR), color=color, alpha=0.2, linewidth=0)


def _write_shares(ax: Axes, left: np.ndarray, share: np.ndarray) -> None:
    """The number inside each bar that is wide enough for it."""
    for y, (start, width) in enumerate(zip(left, share, strict=True)):
        if width >= 8:
            ax.text(start + width / 2, y, f"{width:.0f}", ha="center", va="center", fontsize=7)


def _draw_pm(ax: Axes, pm: np.ndarray, origin: Any, resolution: float) -> None:
    """Marginal over headings, logarithmic, transparent where there is next to nothing."""
    mass = np.asarray(pm, np.float64)
    mass = mass.sum(-1) if mass.ndim == 3 else mass
    peak = mass.max() or 1.0
    shown = np.ma.masked_less(mass, 1e-4 * peak)
    _raster(ax, shown, np.asarray(origin), resolution, cmap="YlOrRd", norm=LogNorm(1e-4 * peak, peak), alpha=0.8)


def _raster(ax: Axes, cells: np.ndarray, origin: np.ndarray, resolution: float, **style: Any) -> None:
    """Cells (H, W), row 0 lowest, in the map frame; ``origin`` is the pose of their lower-left corner."""
    height, width = cells.shape[0] * resolution, cells.shape[1] * resolution
    placed = Affine2D().rotate(float(origin[2])).translate(float(origin[0]), float(origin[1]))
    ax.imshow(cells, origin="lower", extent=(0, width, 0, height), interpolation="nearest",
              transform=placed + ax.transData, **style)  # fmt: skip
    corners = placed.transform([(0, 0), (width, 0), (0, height), (width, height)])
    ax.update_datalim(corners)
    ax.set(xlim=(corners[:, 0].min(), corners[:, 0].max()), ylim=(corners[:, 1].min(), corners[:, 1].max()))


def _arrows(ax: Axes, poses: Any, color: str, length: float, label: str, hollow: bool = False, **style: Any) -> None:
    """Dots with a stroke of ``length`` metres along the heading."""
    x, y, theta = np.asarray(poses, np.float64).T
    width = length / 1.5
    ax.plot(x, y, "o", color=color, markersize=11 if hollow else 3 * length, markeredgewidth=2 if hollow else 0,
            fillstyle="none" if hollow else "full", label=label, zorder=5, **style)  # fmt: skip
    # One broken line: an artist for each stroke takes seconds to draw.
    gap = np.full_like(x, np.nan)
    xs = np.stack([x, x + length * np.cos(theta), gap], -1).ravel()
    ys = np.stack([y, y + length * np.sin(theta), gap], -1).ravel()
    ax.plot(xs, ys, color=color, linewidth=width, zorder=5, **style)


def _metre_ticks(ax: Axes) -> None:
    ax.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
    ax.grid(axis="y", color="0.9", linewidth=0.6)
    ax.set_axisbelow(True)


def _legend(figure: Figure, handles: Any, labels: Any, columns: int, title: str | None = None) -> None:
    figure.legend(handles, labels, loc="outside lower center", ncols=columns, title=title, frameon=False, fontsize=8)


def _color(method: str) -> str:
    """The method's own colour; strangers get one that depends on their name only."""
    return STYLES[method][1] if method in STYLES else f"C{sum(map(ord, method)) % 10}"


def _label(method: str) -> str:
    return STYLES[method][0] if method in STYLES else method


def _phase_title(phase: str) -> str:
    return {"global": "Global localization", "kidnap": "Kidnapping"}.get(phase, phase)
