"""Figures of the paper: error boxes, converging steps, error over time, and PM over the map with particles.

Every function returns a matplotlib ``Figure`` that no window system knows of; :func:`save` writes it as PNG or PDF.
"""

from dsom_jax.plotting.charts import (
    band_evolution,
    band_of,
    benchmark_figures,
    calibration_curves,
    error_boxes,
    error_evolution,
    step_bars,
)
from dsom_jax.plotting.common import save
from dsom_jax.plotting.maps import map_view, map_views, moment_figure

__all__ = [
    "band_evolution",
    "band_of",
    "benchmark_figures",
    "calibration_curves",
    "error_boxes",
    "error_evolution",
    "map_view",
    "map_views",
    "moment_figure",
    "save",
    "step_bars",
]
