"""Cells and tables of the report."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

from dsom_jax.report import outward


def markdown(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A markdown table; the first column to the left, numbers to the right."""
    lines = [list(head), ["---", *["---:"] * (len(head) - 1)], *map(list, rows)]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def number(value: float | None, digits: int) -> str:
    """A number, or a dash where there is none."""
    return "-" if missing(value) else f"{value:.{digits}f}"


def percent(rate: float | None, digits: int = 1) -> str:
    """A rate in [0, 1] in per cent."""
    return "-" if missing(rate) else f"{100 * rate:.{digits}f}"  # type: ignore[operator]


def bounds(interval: Sequence[float | None], scale: float, digits: int) -> str:
    """`` [low-high]``, nothing where there is no interval."""
    if any(missing(bound) for bound in interval):
        return ""
    low, high = (
        outward(scale * bound, digits, towards)  # type: ignore[operator]
        for bound, towards in zip(interval, (math.floor, math.ceil), strict=True)
    )
    return f" [{low}-{high}]"


def missing(value: float | None) -> bool:
    """Whether a number of a results file does not exist."""
    return value is None or not math.isfinite(value)
