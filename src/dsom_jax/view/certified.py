"""The page and the picture of ``certify``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure
from scipy.spatial import cKDTree

from dsom_jax.ambiguity import Tried
from dsom_jax.lidar import LidarConfig
from dsom_jax.occupancy import OccupancyGrid
from dsom_jax.plotting.common import legend
from dsom_jax.plotting.maps import map_view, raster
from dsom_jax.view.localized import plan_of
from dsom_jax.view.page import readable
from dsom_jax.view.story import Field, Lookalike, Story

_TILES = (
    ("0", "found at first sight", "percent"),
    ("2", "found after 2 m", "percent"),
    ("5", "found after 5 m", "percent"),
    ("10", "found after 10 m", "percent"),
)
LIMIT = 12.0
"""Metres that stand for "not found" in a picture."""


def certificate(
    path: Path,
    grid: OccupancyGrid,
    lidar: LidarConfig,
    tried: Tried,
    result: dict[str, Any],
    pairs: list[Lookalike],
    settings: dict[str, Any],
) -> Story:
    """What a page says of a building."""
    found, bounds = result["found_after_m"], result["found_after_m_ci95"]
    large = {**found, **{f"{name}_ci95": interval for name, interval in bounds.items()}}
    soon = readable(found["5"], "percent")
    text = f"A robot that wakes up anywhere in here is found after 5 m of driving in {soon} of"
    text += f" {result['drives']} drives."
    after = f"{result['look_alikes_after_m']:g} m"
    text += f" {len(pairs)} pairs of places still look alike after {after}." if pairs else " No two places look alike."
    return Story(
        f"Can a robot be found in {path.stem}?",
        text,
        plan_of(grid, lidar, f"{path.name} · {result['area_m2']:.0f} m² of free space"),
        summary=large | {name: result[name] for name in ("metres_median", "area_m2", "drives")},
        tiles=_TILES,
        settings=settings,
        overlay=Field("metres to drive until found, from the nearest start", "m", metres_map(grid, tried),
                      np.asarray(grid.origin), grid.resolution),
        lookalikes=tuple(pairs),
    )  # fmt: skip


def metres_map(grid: OccupancyGrid, tried: Tried) -> np.ndarray:
    """(H, W) metres until found of the drive that starts nearest to a free cell, NaN elsewhere."""
    i, j = np.nonzero(np.asarray(grid.free))
    metres = np.minimum(tried.metres_until_found(), LIMIT)
    starts = np.asarray(grid.to_grid(jnp.asarray(tried.poses[:, 0])))[:, :2]
    _, nearest = cKDTree(starts).query((np.stack([j, i], -1) + 0.5) * grid.resolution)
    values = np.full(grid.shape, np.nan)
    values[i, j] = metres[nearest]
    return values


def map_figure(grid: OccupancyGrid, tried: Tried, pairs: list[Lookalike]) -> Figure:
    """``certify.png``: metres to drive until found over the map, and the pairs of places that look alike."""
    figure = Figure(figsize=(8, 8), layout="constrained")
    ax = figure.subplots()
    map_view(ax, grid)
    values = metres_map(grid, tried)
    raster(ax, np.ma.masked_invalid(values), np.asarray(grid.origin), grid.resolution, cmap="cividis", vmin=0,
           vmax=LIMIT, alpha=0.85)  # fmt: skip
    figure.colorbar(ax.images[-1], ax=ax, label=f"metres to drive until found ({LIMIT:g}: not within 10)", shrink=0.7)
    ax.plot(*tried.poses[:, 0, :2].T, ".", color="0.2", markersize=3, label="starts")
    for n, pair in enumerate(pairs, 1):
        ends = np.stack([pair.a, pair.b])
        ax.plot(*ends[:, :2].T, "-o", color="#b3261e", linewidth=1, label="look alike" if n == 1 else None)
        ax.quiver(*ends[:, :2].T, np.cos(ends[:, 2]), np.sin(ends[:, 2]), color="#b3261e", angles="xy", scale=25)
    corners = plan_of(grid, LidarConfig(), "").corners()
    ax.set(xlim=(corners[:, 0].min(), corners[:, 0].max()), ylim=(corners[:, 1].min(), corners[:, 1].max()))
    handles, labels = ax.get_legend_handles_labels()
    legend(figure, handles, labels, columns=2)
    return figure
