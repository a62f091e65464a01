"""What the command lines share: their arguments, and errors in them, as one line."""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, redirect_stderr
from typing import TypeVar

import tyro
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    SpinnerColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)  # fmt: skip

from dsom_jax import report
from dsom_jax.cache import keep_compiled
from dsom_jax.errors import UserError

_T = TypeVar("_T")
Advance = Callable[[str, int], None]
"""Called with a method and the number of a sequence before each drive."""
_FRAME = re.compile(r"\x1b\[[0-9;]*m|[│╭╮╰╯]|^\s*[|+]|[|+]\s*$")
"""Frames of boxes; terminals that know ASCII only get them from | + and -."""


def parse(arguments: type[_T], prog: str, words: Sequence[str] | None = None) -> _T:
    """The dataclass ``arguments`` from ``words``, those of the command line; UserError for words that do not fit it.

    ``prog`` is what the user typed before them, such as ``python -m dsom_jax.bench``. What is compiled from here on is
    kept for the next time.
    """
    keep_compiled()
    box = io.StringIO()
    try:
        with redirect_stderr(box):
            return tyro.cli(arguments, args=words, prog=prog, description=arguments.__doc__)
    except SystemExit as stop:
        if stop.code != 2:
            raise
    raise UserError(f"{_one_line(box.getvalue())}; see {prog} --help")


def _one_line(box: str) -> str:
    """The message in the box that tyro draws: its first section, and the second if that offers a correction."""
    rows = [_FRAME.sub("", row).strip() for row in box.splitlines()[1:]]
    sections = [part for part in re.split(r"[─-]{3,}", " ".join(row for row in rows if row)) if part.strip()] or [""]
    told = [sections[0], *(part for part in sections[1:2] if part.lstrip().startswith("Perhaps"))]
    return "; ".join(part.strip().rstrip(".:") for part in told)


@contextmanager
def stage(says: str) -> Iterator[None]:
    """A line on stderr with the seconds that something without a known length takes; gone when it is done."""
    columns = (SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn())
    with Progress(*columns, console=report.terminal(stderr=True), transient=True) as bar:
        bar.add_task(says, total=None)
        yield


def each(items: Sequence[_T], says: str) -> Iterable[_T]:
    """``items`` one after another, with a bar on stderr; the first includes the compilation, and is not reckoned with
    in the time that is left."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(),
               TextColumn("left"), TimeRemainingColumn())  # fmt: skip
    with Progress(*columns, console=report.terminal(stderr=True), transient=True) as bar:
        task = bar.add_task(f"{says}: the first one, with compiling, once", total=len(items))
        for number, item in enumerate(items, 1):
            yield item
            if number == 1:
                bar.reset(task, total=len(items), completed=1, description=says)
            else:
                bar.update(task, completed=number)


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
