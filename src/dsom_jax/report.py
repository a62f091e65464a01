"""Results as files and tables: ``bench.json``, terminal tables of 100 columns, markdown for pages.

``bench.json`` holds, beside what was asked for, ``methods``: NAME -> {"global": M, "kidnap": M, "ms_per_step",
"compilations", "estimate", "estimates"}. M is :func:`.judging.metrics.summarize`; ``ms_per_step`` is the time of one
update of all runs together; ``compilations`` counts the shapes of map and episode that were compiled; ``estimate`` says
whether M judges the weighted ``mean`` or the heaviest ``cluster``, and ``estimates`` has M for both. ``by_drive``
(:func:`.judging.by_drive.by_drive`) lists the drives, each with its worst run; ``digests`` tells maps, drives and
networks from others of the same name.
Values that do not exist (a mean over no runs) are null. ``runs.npz`` (``--per-run``) holds the columns of
:class:`dsom_jax.judging.run_table.RunTable`, one row for every run.
"""

from __future__ import annotations

import atexit
import json
import math
import tempfile
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table

from dsom_jax.atomic import write_atomic
from dsom_jax.errors import UserError

PHASES = {"global": "Global localization", "kidnap": "Kidnapping"}


def output_folder(path: str | Path, option: str = "--out") -> Path:
    """``path`` as a folder that exists and takes files; UserError otherwise, in terms of the ``option`` that names it.

    Call it before any work is done.
    """
    folder = Path(path)
    try:
        new = not folder.exists()
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        fix = "name a folder that can be written"
        raise UserError(f"{option} {folder}: cannot write there ({reason}): {fix}") from None
    if new:
        atexit.register(_remove_empty, folder)
    return folder


def _remove_empty(folder: Path) -> None:
    """A command that was interrupted leaves no empty folder behind."""
    with suppress(OSError):
        folder.rmdir()


def write_text(path: Path, text: str) -> None:
    """Write ``path`` whole or not at all."""
    write_atomic(path, text.encode())


def write_json(path: Path, data: Any) -> None:
    """Write ``data`` to ``path`` atomically as strict JSON: NaN and infinities become null."""
    write_text(path, json.dumps(plain(data), indent=2, allow_nan=False) + "\n")


def write_rows(path: Path, data: dict[str, Any]) -> None:
    """As :func:`write_json`, one line for each entry of ``data``: for long lists."""
    rows = [f" {json.dumps(str(key))}: {json.dumps(plain(data[key]), allow_nan=False)}" for key in data]
    write_text(path, "{\n" + ",\n".join(rows) + "\n}\n")


def rounded(data: Any, digits: int = 6) -> Any:
    """:func:`plain` data with so many significant digits."""
    if isinstance(data, dict):
        return {key: rounded(value, digits) for key, value in data.items()}
    if isinstance(data, list):
        return [rounded(value, digits) for value in data]
    return float(f"{data:.{digits}g}") if isinstance(data, float) else data


def plain(data: Any) -> Any:
    """``data`` with NumPy scalars and arrays as numbers and lists, and what is not finite as None."""
    if isinstance(data, dict):
        return {str(key): plain(value) for key, value in data.items()}
    if isinstance(data, (list, tuple)):
        return [plain(value) for value in data]
    if hasattr(data, "tolist"):
        return plain(data.tolist())
    if isinstance(data, Path):
        return str(data)
    return None if isinstance(data, float) and not math.isfinite(data) else data


Cell = Callable[[dict[str, Any], float], str]
"""The text of a cell, from M and the milliseconds of a step."""
_COLUMNS: dict[str, Cell] = {
    "converged %": lambda m, _: _percent(m["converged"]) + _interval(m["converged_ci95"], 100),
    "0-20 %": lambda m, _: _percent(m["within_20"]),
    "steps": lambda m, _: _number(m["steps_median"], 0),
    "E_pos m": lambda m, _: _number(m["e_pos_m"], 3),
    "E_th rad": lambda m, _: _number(m["e_theta_rad"], 3),
    "kept %": lambda m, _: _percent(m["retention"]),
    "strict %": lambda m, _: _percent(m["strict_success"]),
    "ms/step": lambda _, ms: _number(ms, 1),
}
_LEGEND = """\
converged: 5 updates in a row within 2 m and 10 deg [95 % interval, by drive]; 0-20: within 20 updates;
steps: updates before converging, median; E: mean final error of the converged runs;
kept: share of the later updates still within; strict: last estimate within 0.5 m and 5 deg;
ms/step: one update of all runs together."""


def _table(report: dict[str, Any], phase: str) -> Table:
    """The results of one phase, one row per method."""
    title = _title(report, phase)
    result = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), show_edge=False)
    result.add_column("method", no_wrap=True)
    for head in _COLUMNS:
        result.add_column(head, justify="right", no_wrap=True)
    for name, entry in report["methods"].items():
        result.add_row(name, *_cells(entry, phase))
    return result


def print_tables(report: dict[str, Any], console: Console | None = None) -> None:
    """Print one table per phase that was run; 100 columns where the output is no terminal."""
    console = console or terminal()
    for phase in phases_of(report):
        console.print(_table(report, phase), "")
    console.print(_LEGEND, style="dim", highlight=False)


def terminal(stderr: bool = False) -> Console:
    """A console as wide as the terminal, or 100 columns when written to a file or a pipe."""
    console = Console(stderr=stderr)
    return console if console.is_terminal else Console(stderr=stderr, width=100)


def markdown(report: dict[str, Any]) -> str:
    """The same tables for a README."""
    blocks = []
    for phase in phases_of(report):
        head = ["method", *_COLUMNS]
        rule = ["---", *["---:"] * len(_COLUMNS)]
        rows = [[f"`{name}`", *_cells(entry, phase, intervals=True)] for name, entry in report["methods"].items()]
        lines = ["| " + " | ".join(row) + " |" for row in (head, rule, *rows)]
        blocks.append(f"**{_title(report, phase)}**\n\n" + "\n".join(lines))
    return "\n\n".join(blocks) + "\n"


def phases_of(report: Mapping[str, Any]) -> list[str]:
    """The phases in which at least one experiment was made."""
    entries = report["methods"].values()
    return [phase for phase in PHASES if any(entry[phase]["experiments"] for entry in entries)]


def _title(report: dict[str, Any], phase: str) -> str:
    experiments = max(entry[phase]["experiments"] for entry in report["methods"].values())
    return f"{PHASES[phase]} · {report['suite']} · {experiments} experiments · {report['particles']} particles"


def _cells(entry: dict[str, Any], phase: str, intervals: bool = False) -> list[str]:
    """The row of a method; ``intervals`` of the errors only where there is room for them."""
    cells = {head: cell(entry[phase], entry["ms_per_step"]) for head, cell in _COLUMNS.items()}
    if intervals:
        cells["E_pos m"] += _interval(entry[phase]["e_pos_ci95"], 1, 3)
        cells["E_th rad"] += _interval(entry[phase]["e_theta_ci95"], 1, 3)
    return list(cells.values())


def _missing(value: float | None) -> bool:
    return value is None or not math.isfinite(value)


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None or not math.isfinite(value) else f"{value:.{digits}f}"


def _percent(rate: float | None) -> str:
    return "-" if rate is None else _number(100 * rate, 1)


def _interval(bounds: list[float], scale: float, digits: int = 0) -> str:
    if any(_missing(bound) for bound in bounds):
        return ""
    return f" [{outward(scale * bounds[0], digits, math.floor)}-{outward(scale * bounds[1], digits, math.ceil)}]"


def outward(value: float, digits: int, towards: Callable[[float], int]) -> str:
    """A bound of an interval so that rounding does not narrow it; ``towards`` is floor or ceil."""
    # Numbers that are decimals but for their last bit stay what they are.
    return f"{towards(round(value * 10**digits, 6)) / 10**digits:.{digits}f}"
