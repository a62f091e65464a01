"""PM over the map, with scan, particles and poses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.transforms import Affine2D

from dsom_jax.episode import Episode
from dsom_jax.geometry import transform_points
from dsom_jax.lidar import LidarConfig, scan_points
from dsom_jax.occupancy import OccupancyGrid
from dsom_jax.plotting.common import legend, panels
from dsom_jax.pose_grid import ProbabilityMap
from dsom_jax.types import Filter, prepare_alone

SCAN_COLOR = "#1f77b4"


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
    raster(ax, shade, np.asarray(grid.origin), grid.resolution, cmap="gray", vmin=0, vmax=1)
    if pm is not None:
        _draw_pm(ax, pm, grid.origin if pm_origin is None else pm_origin, pm_resolution or grid.resolution)
    if points is not None:
        ax.plot(*np.asarray(points).T, ".", color=SCAN_COLOR, markersize=2.5, label="scan", zorder=3)
    if particles is not None:
        _arrows(ax, particles, "#2a7f3f", 1.0, "particles", alpha=0.5)
    if truth is not None:
        _arrows(ax, np.asarray(truth)[None], "#d62728", 3.0, "truth", hollow=True)
    if estimate is not None:
        _arrows(ax, np.asarray(estimate)[None], "#7b2cbf", 2.0, "estimate")
    ax.set(aspect="equal", xlabel="x [m]", ylabel="y [m]")


def map_views(views: Sequence[Mapping[str, Any]], titles: Sequence[str]) -> Figure:
    """Moments side by side: the arguments of :func:`map_view` after ``ax``, and a title each."""
    figure, axes = panels(len(views), 4.4, 5.5, sharey=True)
    for ax, view, title in zip(axes, views, titles, strict=True):
        map_view(ax, **view)
        ax.set_title(title)
        ax.label_outer()
    named = {label: handle for ax in axes for handle, label in zip(*ax.get_legend_handles_labels(), strict=True)}
    if "scan" in named:  # Dots as small as on the map are not to be seen in a legend.
        named["scan"] = Line2D([], [], linestyle="", marker=".", color=SCAN_COLOR, markersize=7)
    if any(view.get("pm") is not None for view in views):
        named["PM (summed over headings, 4 decades)"] = Patch(color="#fd8d3c")
    legend(figure, list(named.values()), list(named), columns=max(len(named), 1))
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
    """A filter at updates ``times`` (K,): its particles (K, N, 3), estimates (T, 3), and the PM it drew from.

    Of a proposal that remembers, PM is that of the scan alone.
    """
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


_prepare = jax.jit(prepare_alone)
"""Compiled once for each kind of proposal."""


def _pm_of(prepared: Any) -> dict[str, Any]:
    """The first probability map in what a filter prepared, as arguments of :func:`map_view`."""
    drawn = getattr(prepared, "posterior", prepared)
    leaves = jax.tree.leaves(drawn, is_leaf=lambda leaf: isinstance(leaf, ProbabilityMap))
    for pm in (leaf for leaf in leaves if isinstance(leaf, ProbabilityMap)):
        return {"pm": pm.mass, "pm_origin": pm.pose_grid.origin, "pm_resolution": pm.pose_grid.resolution}
    return {}


def _draw_pm(ax: Axes, pm: np.ndarray, origin: Any, resolution: float) -> None:
    """Marginal over headings, logarithmic, transparent where there is next to nothing."""
    mass = np.asarray(pm, np.float64)
    mass = mass.sum(-1) if mass.ndim == 3 else mass
    peak = mass.max() or 1.0
    shown = np.ma.masked_less(mass, 1e-4 * peak)
    raster(ax, shown, np.asarray(origin), resolution, cmap="YlOrRd", norm=LogNorm(1e-4 * peak, peak), alpha=0.8)


def raster(ax: Axes, cells: np.ndarray, origin: np.ndarray, resolution: float, **style: Any) -> None:
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
