"""What the command lines share: their arguments, and errors in them, as one line."""

from __future__ import annotations

import io
import re
from collections.abc import Callable
from contextlib import redirect_stderr
from typing import TypeVar

import tyro
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from dsom_jax import report
from dsom_jax.errors import UserError

T = TypeVar("T")
Advance = Callable[[str, int], None]
"""Called with a method and the number of a sequence before each drive."""
_FRAME = re.compile(r"\x1b\[[0-9;]*m|[│╭╮╰╯]|^\s*[|+]|[|+]\s*$")
"""Frames of boxes; terminals that know ASCII only get them from | + and -."""


def parse(arguments: type[T], prog: str) -> T:
    """The dataclass ``arguments`` from the words of the command line; UserError for words that do not fit it.

    ``prog`` is what the user typed before them, such as ``python -m dsom_jax.bench``.
    """
    box = io.StringIO()
    try:
        with redirect_stderr(box):
            return tyro.cli(arguments, prog=prog, description=arguments.__doc__)
    except SystemExit as stop:
        if stop.code != 2:
            raise
    raise UserError(f"{one_line(box.getvalue())}; see {prog} --help")


def one_line(box: str) -> str:
    """The message in the box that tyro draws: its first section, and the second if that offers a correction."""
    rows = [_FRAME.sub("", row).strip() for row in box.splitlines()[1:]]
    sections = [part for part in re.split(r"[─-]{3,}", " ".join(row for row in rows if row)) if part.strip()] or [""]
    told = [sections[0], *(part for part in sections[1:2] if part.lstrip().startswith("Perhaps"))]
    return "; ".join(part.strip().rstrip(".:") for part in told)


def progress_bar(total: int) -> tuple[Progress, Advance]:
    """A bar on stderr over (method, sequence) pairs, and the function that moves it."""
    bar = Progress(TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn(),
                   console=report.terminal(stderr=True), transient=True)  # fmt: skip
    task = bar.add_task("starting", total=total)
    started: list[str] = []

    def advance(method: str, sequence: int) -> None:
        bar.update(task, description=f"{method}, sequence {sequence + 1}", completed=len(started))
        started.append(method)

    return bar, advance
