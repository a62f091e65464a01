"""Figures of the paper: error boxes, converging steps, error over time, and PM over the map with particles.

Every function returns a matplotlib ``Figure`` that no window system knows of; :func:`save_figure` writes it as PNG.
"""

from dsom_jax.plotting.charts import (
    Band,
    band_evolution,
    band_of,
    bands_of,
    benchmark_figures,
    calibration_curves,
    error_boxes,
    error_evolution,
    step_bars,
)
from dsom_jax.plotting.common import save_figure
from dsom_jax.plotting.maps import map_view, map_views, moment_figure

__all__ = [
    "Band",
    "band_evolution",
    "band_of",
    "bands_of",
    "benchmark_figures",
    "calibration_curves",
    "error_boxes",
    "error_evolution",
    "map_view",
    "map_views",
    "moment_figure",
    "save_figure",
    "step_bars",
]
