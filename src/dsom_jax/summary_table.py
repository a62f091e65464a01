"""``summary.json`` of ``localize`` for a person at a terminal: a table, what to look at, what to know."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
from rich import box
from rich.table import Table

from dsom_jax import report

_COLUMNS = (
    ("runs", "experiments", "{:d}"), ("found", "converged", "{:.1%}"), ("updates", "steps_median", "{:g}"),
    ("metres", "metres_median", "{:.1f}"), ("right later", "retention", "{:.1%}"),
    ("error", "e_pos_m_median", "{:.3f} m"), ("sure and wrong", "false_confident", "{:.2%}"),
)  # fmt: skip
"""Of the table for a person: head, key of ``summary.json``, format. Medians are those of the runs that found."""


def print_summary(summary: dict[str, Any], folder: Path) -> None:
    """One table for a person, and what to look at."""
    console = report.terminal()
    if "converged" in summary:
        console.print(_table(summary))
    else:
        sure = f"{summary['updates']} updates, sure of the answer in {summary['certain']:.1%} of them"
        console.print(f"{sure}; no reference to judge by")
    for line in times(summary):
        console.print(line, style="dim")
    console.print(f"look at {folder / 'report.html'}{worst(summary)}", soft_wrap=True, highlight=False)


def _table(summary: dict[str, Any]) -> Table:
    """A row for the start and one for the kidnappings, on either reference, ours and those of others."""
    found = Table(box=box.SIMPLE_HEAD, show_edge=False, padding=(0, 2, 0, 0))
    found.add_column("")
    for head, _, _ in _COLUMNS:
        found.add_column(head, justify="right")
    parts = [("start anywhere", summary), ("carried away", summary.get("kidnap"))]
    parts += [("on the plan", summary.get("on_plan"))]
    for name, theirs in summary.get("external", {}).items():
        parts += [(name, theirs), (f"{name}, carried away", theirs.get("kidnap"))]
    for name, part in parts:
        if part and "converged" in part:
            found.add_row(name, *(_cell(part[key], text) for _, key, text in _COLUMNS))
    return found


def times(summary: dict[str, Any]) -> list[str]:
    """How long an update takes, as far as it was measured."""
    lines = []
    if (ms := summary["ms_per_update"]) is not None:
        lines.append(f"{ms:.1f} ms per update of all {summary['runs']} runs")
    if latency := summary.get("latency_ms"):
        lines.append("latency " + ", ".join(f"{name} {value:.1f} ms" for name, value in latency.items()))
    return lines


def worst(summary: dict[str, Any]) -> str:
    """Which segment to look at first, if any failed."""
    parts = [part.get("converged") for part in summary.get("by_segment", [])]
    rates = [1.0 if rate is None or rate != rate else rate for rate in parts]
    if not rates or min(rates) == 1:
        return ""
    number = int(np.argmin(rates)) + 1
    return f"#d={number} (segment {number}: found in {min(rates):.0%} of the runs)"


def reference_notes(summary: dict[str, Any], shift: dict[str, float] | None) -> list[str]:
    """What is to be said about the frame of the reference; ``shift`` carries it onto the answers, if one does."""
    on_map = [part["on_map"] for part in summary.get("by_segment", ()) if part["on_map"] is not None]
    notes = []
    if on_map and np.mean(on_map) < 0.5:
        notes.append(f"reference: lies on free cells of the map at {np.mean(on_map):.0%} of its poses only")
    if shift is not None:
        moved = f"({shift['x']:.2f}, {shift['y']:.2f}) m, {math.degrees(shift['theta']):.1f} deg"
        notes.append(
            f"reference: is in another frame: moved by {moved} it agrees with {shift['share']:.0%} of the sure answers "
            "(or the map looks the same there); move it, or correct the origin of the map"
        )
    elif notes:
        notes.append("reference: no shift makes it agree with the answers; check that it is of this map and this drive")
    return notes


def _cell(value: Any, text: str) -> str:
    return "-" if value is None or value != value else text.format(value)
