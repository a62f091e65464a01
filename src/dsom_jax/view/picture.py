"""``trajectory.png``: one drive over the map, and how far off and how sure the answers were."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from dsom_jax.belief.verdict import CERTAIN
from dsom_jax.judging.metrics import POSITION
from dsom_jax.occupancy import from_cells
from dsom_jax.plotting.common import legend
from dsom_jax.plotting.maps import map_view
from dsom_jax.view.story import DriveStory, Plan

ESTIMATE, TRUTH, LOST = "#0b5cad", "#b3420a", "#b3261e"
_JUMP = 3.0  # metres between two answers beyond which no line was driven


def trajectory_figure(plan: Plan, drive: DriveStory) -> Figure:
    """Map with the path of the answers and of the reference; below it P(lost) and the error over the updates."""
    judged = bool(np.isfinite(drive.truth).any())
    figure = Figure(figsize=(8, 9 if judged else 8), layout="constrained")
    axes = figure.subplots(2 + judged, 1, height_ratios=[6, 1, *[1] * judged], squeeze=False)[:, 0]
    grid = from_cells(jnp.asarray(plan.occupied), jnp.asarray(plan.free), resolution=plan.resolution,
                      origin=tuple(float(v) for v in plan.origin))  # type: ignore[arg-type]  # three of them  # fmt: skip
    map_view(axes[0], grid)
    corners = plan.corners()
    axes[0].set(xlim=(corners[:, 0].min(), corners[:, 0].max()), ylim=(corners[:, 1].min(), corners[:, 1].max()))
    if judged:
        axes[0].plot(*broken(drive.truth, drive.kidnapped).T, "--", color=TRUTH, linewidth=1.5, label="reference")
    axes[0].plot(*broken(drive.estimates, drive.kidnapped).T, color=ESTIMATE, linewidth=2, label="estimate")
    axes[0].plot(*drive.estimates[0, :2], "o", color=ESTIMATE, label="first answer")
    axes[0].set_title(drive.name)
    _over_updates(axes[1], drive, drive.p_lost, CERTAIN, LOST, "P(lost)")
    axes[1].set_ylim(-0.02, 1.02)
    if judged:
        _over_updates(axes[2], drive, np.maximum(drive.errors()[0], 0.01), POSITION, TRUTH, "error [m]")
        axes[2].set_yscale("log")
        axes[2].yaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axes[-1].set_xlabel("update")
    handles, labels = axes[0].get_legend_handles_labels()
    legend(figure, handles, labels, columns=3)
    return figure


def _over_updates(ax: Axes, drive: DriveStory, values: np.ndarray, limit: float, color: str, label: str) -> None:
    ax.plot(values, color=color)
    ax.axhline(limit, color="0.5", linestyle=":", linewidth=1)
    for t in np.flatnonzero(drive.kidnapped):
        ax.axvline(float(t), color="0.2", linewidth=1)
    ax.set(ylabel=label, xlim=(0, max(len(values) - 1, 1)))


def broken(poses: np.ndarray, kidnapped: np.ndarray) -> np.ndarray:
    """(n, 2) the path through ``poses`` (T, 3), with a gap wherever the robot was carried or the answer jumped."""
    xy = np.asarray(poses, float)[:, :2]
    jumps = np.r_[False, np.hypot(*np.diff(xy, axis=0).T) > _JUMP] | np.asarray(kidnapped, bool)
    return np.insert(xy, np.flatnonzero(jumps), np.nan, axis=0)
