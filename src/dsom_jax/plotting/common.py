"""What all figures share: panels, a legend, and writing to a file."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter

from dsom_jax.atomic import write_atomic


def save_figure(figure: Figure, path: Path) -> None:
    """Write a PNG at 110 dpi, whole or not at all."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110)
    write_atomic(path, buffer.getvalue())


def panels(count: int, width: float, height: float, sharey: bool = False) -> tuple[Figure, list[Axes]]:
    figure = Figure(figsize=(width * count, height), layout="constrained")
    return figure, list(figure.subplots(1, count, squeeze=False, sharey=sharey)[0])


def log_ticks(axis: Axis) -> None:
    """Ticks at 1, 2 and 5 of every decade as plain numbers, for logarithmic axes that span few decades."""
    axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axis.set_major_formatter(lambda value, _: f"{value:g}")
    axis.set_minor_formatter(NullFormatter())


def legend(figure: Figure, handles: Any, labels: Any, columns: int, title: str | None = None) -> None:
    figure.legend(handles, labels, loc="outside lower center", ncols=columns, title=title, frameon=False, fontsize=8)
