"""The page of ``bench``: the methods side by side, every drive, and the worst run of each method on each drive."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from dsom_jax import report
from dsom_jax.atomic import write_atomic
from dsom_jax.data.suite import Suite
from dsom_jax.judging.by_drive import Worst
from dsom_jax.view import sketch
from dsom_jax.view.localized import plan_of
from dsom_jax.view.page import document, numbers, readable

_COLUMNS = (
    ("found", "converged", "percent"),
    ("updates until then", "steps_median", "count"),
    ("right later", "retention", "percent"),
    ("within 0.5 m at the end", "strict_success", "percent"),
    ("error at the end", "e_pos_m", "metres"),
)
"""Of the methods: head, key of ``bench.json``, kind of number."""
INTERVALS = {"e_pos_m": "e_pos_ci95"}
"""Keys of intervals that are not that of the number and ``_ci95``."""
_LEGEND = """Found: 5 updates in a row within 2 m and 10°. Updates until then: median of the runs that found. Right
later: share of the updates after that still within 2 m and 10°. Within 0.5 m at the end: and 5°. Error at the end: mean
of the runs that found. In brackets: 95 % interval, by drive."""
HOW = "Runs are numbered from 0. The worst was least often within 2 m and 10°, or of several ends farthest off."
POINTS = 40_000
"""Points of all paths together, at about ten bytes each; pages of more are thinned."""


def write_benchmark(path: Path, suite: Suite, data: Mapping[str, Any], worst: Mapping[str, Sequence[Worst]]) -> None:
    """``report.html``, of what ``bench.json`` holds and the ``worst`` run of each method on each drive."""
    write_atomic(path, render_benchmark(suite, data, worst).encode())


def render_benchmark(suite: Suite, data: Mapping[str, Any], worst: Mapping[str, Sequence[Worst]]) -> str:
    """HTML of a benchmark."""
    data = report.plain(data)
    main = (
        _drawn_once(suite, _most(suite, worst)),
        f'<div id="methods" tabindex="-1">{"".join(_methods(data, phase) for phase in report.phases_of(data))}'
        f'<p class="caption below">{_LEGEND}</p></div>',
        f'{_rows(data)}<p class="caption below">{HOW}</p>',
        *(_drive(suite, data, worst, number) for number in range(len(suite.episodes))),
        numbers("What ran", {name: value for name, value in data.items() if name != "methods"}),
    )
    kicker = f"{data['sequences']} drives · {data['runs']} runs of each · {data['particles']} particles"
    return document(f"Methods on {suite.name}", kicker, _headline(data), main, ("methods", "Skip to the methods"))


def _headline(data: Mapping[str, Any]) -> str:
    """Which method found the robot most often, and which least, in words."""
    starts = {"global": "Started anywhere", "kidnap": "Carried away unnoticed"}
    return " ".join(f"{starts[phase]}, {_extremes(data, phase)}." for phase in report.phases_of(data))


def _extremes(data: Mapping[str, Any], phase: str) -> str:
    def goodness(entry: dict[str, Any]) -> tuple[float, float]:
        error = entry[phase]["e_pos_m"]
        return entry[phase]["converged"] or 0.0, -1e9 if error is None else -error

    ranked = sorted(data["methods"], key=lambda name: goodness(data["methods"][name]), reverse=True)
    share = [readable(data["methods"][name][phase]["converged"], "percent") for name in ranked]
    last = f", {ranked[-1]} in {share[-1]}" if len(ranked) > 1 else ""
    return f"{ranked[0]} found the robot in {share[0]} of its runs{last}"


def _number(data: Any, keys: Sequence[Any], kind: str, tag: str = "b") -> str:
    """A number of ``bench.json``, with where it stands there and itself beside what is shown of it."""
    for key in keys:
        data = data[key]
    if data is None:
        return "–"
    where = escape(".".join(map(str, keys)))
    return f'<{tag} data-key="{where}" data-value="{data!r}">{readable(data, kind)}</{tag}>'


def _cell(data: Any, keys: Sequence[Any], kind: str) -> str:
    """A number and its interval, if it has one."""
    interval = [*keys[:-1], INTERVALS.get(keys[-1], f"{keys[-1]}_ci95")]
    entry = data["methods"][keys[1]][keys[2]]
    bounds = entry.get(interval[-1]) or [None]
    if entry[keys[-1]] is None or None in bounds:
        return f"<td>{_number(data, keys, kind)}</td>"
    low, high = (_number(data, [*interval, n], kind, "span") for n in (0, 1))
    return f"<td>{_number(data, keys, kind)}<small>[{low} to {high}]</small></td>"


def _table(caption: str, heads: Sequence[str], body: str) -> str:
    head = "".join(f'<th scope="col">{escape(h)}</th>' for h in heads)
    return (f'<section class="scroll" tabindex="0" role="region" aria-label="{escape(caption)}"><table>'
            f"<caption>{escape(caption)}</caption><thead><tr>{head}</tr></thead>{body}</table></section>")  # fmt: skip


def _methods(data: Mapping[str, Any], phase: str) -> str:
    """The methods in one phase, a row each, with a link to the worst of their runs."""
    rows = []
    for name, entry in data["methods"].items():
        cells = "".join(_cell(data, ("methods", name, phase, key), kind) for _, key, kind in _COLUMNS)
        link = _link(data, name, worst_drive(entry["by_drive"]))
        rows.append(f'<tr><th scope="row">{escape(name)}</th>{cells}<td>{link}</td></tr>')
    count = max(entry[phase]["experiments"] for entry in data["methods"].values())
    heads = ("method", *(head for head, _, _ in _COLUMNS), "worst run")
    return _table(f"{report.PHASES[phase]}: {count} experiments", heads, f"<tbody>{''.join(rows)}</tbody>")


def worst_drive(parts: Sequence[Mapping[str, Any]]) -> int:
    """Number of the drive with the worst of all runs of a method; ``parts`` as in ``by_drive`` of ``bench.json``."""

    def badness(number: int) -> tuple[float, float]:
        worst = parts[number]["worst"]
        right, off = worst["right"], worst["e_pos_m"]
        return 2.0 if right is None else right, -np.inf if off is None else -off

    return min(range(len(parts)), key=badness)


def _place(data: Mapping[str, Any], name: str, drive: int) -> str:
    """The id of a picture; names of methods may hold anything."""
    return f"worst-{drive + 1}-{list(data['methods']).index(name) + 1}"


def _link(data: Mapping[str, Any], name: str, drive: int) -> str:
    run = data["methods"][name]["by_drive"][drive]["worst"]["run"]
    label = f"{name}: drive {drive + 1}, run {run}"
    return f'<a href="#{_place(data, name, drive)}" aria-label="{escape(label)}">drive {drive + 1}, run {run}</a>'


def _rows(data: Mapping[str, Any]) -> str:
    """A row for each method and drive."""
    phases = report.phases_of(data)
    words = {"global": ("found at the start", "error"), "kidnap": ("found again", "error after that")}
    heads = (
        "method",
        "drive",
        *(head for phase in phases for head in words[phase]),
        "right in its worst run",
        "worst run",
    )
    bodies = []
    for name, entry in data["methods"].items():
        count = len(entry["by_drive"])
        rows = ["".join(f"<td>{cell}</td>" for cell in _drive_cells(data, name, n, phases)) for n in range(count)]
        group = f'<th scope="rowgroup" rowspan="{count}">{escape(name)}</th>'
        bodies.append(f"<tbody><tr>{group}{'</tr><tr>'.join(rows)}</tr></tbody>")
    return _table("Drive by drive", heads, "".join(bodies))


def _drive_cells(data: Mapping[str, Any], name: str, number: int, phases: Sequence[str]) -> Iterator[str]:
    """The cells of a method and a drive."""
    keys = ("methods", name, "by_drive", number)
    yield f'<a href="#drive-{number + 1}">{number + 1}</a>'
    for phase in phases:
        yield _number(data, (*keys, phase, "converged"), "percent", "span")
        yield _number(data, (*keys, phase, "e_pos_m"), "metres", "span")
    yield _number(data, (*keys, "worst", "right"), "percent", "span")
    yield _link(data, name, number)


def _most(suite: Suite, worst: Mapping[str, Sequence[Worst]]) -> int:
    """Points of each path."""
    return max(20, POINTS // max(1, len(suite.episodes) * (2 * len(worst) + 1)))


def _drawn_once(suite: Suite, most: int) -> str:
    """Maps and true paths, which all pictures of a drive share."""
    parts, names = [], [where for where, _, _ in suite.episodes]
    for number, (where, grid, episode) in enumerate(suite.episodes):
        plan = plan_of(grid, suite.lidar, where)
        sheet, first = sketch.sheet_of(plan), names.index(where)
        if first == number:
            parts.append(f'<g id="map-{number}">{sketch.map_drawing(plan, sheet)}</g>')
        truth, moved = np.asarray(episode.poses, float), np.asarray(episode.kidnapped)
        drawing = sketch.truth_drawing(truth, moved, sheet, most)
        parts.append(f'<g id="scene-{number}"><use href="#map-{first}"/>{drawing}</g>')
    return f'<svg class="once" width="0" height="0" aria-hidden="true"><defs>{"".join(parts)}</defs></svg>'


def _drive(suite: Suite, data: Mapping[str, Any], worst: Mapping[str, Sequence[Worst]], number: int) -> str:
    """The pictures of one drive."""
    where, grid, episode = suite.episodes[number]
    sheet, moved = sketch.sheet_of(plan_of(grid, suite.lidar, where)), np.asarray(episode.kidnapped)
    times = [str(int(t) + 1) for t in np.flatnonzero(moved) if t]
    carried = f", carried away before update {' and '.join(times)}" if times else ""
    items = []
    for name in data["methods"]:
        run = worst[name][number]
        words = f"Drive {number + 1}: the true path, and run {run.run} of {name}"
        drawing = sketch.run_drawing(run, moved, sheet, _most(suite, worst))
        items.append(
            f'<li id="{_place(data, name, number)}"><figure><svg viewBox="0 0 {sheet.width} {sheet.height}" role="img"'
            f' aria-label="{escape(words)}"><use href="#scene-{number}"/>{drawing}</svg>'
            f"<figcaption>{_caption(data, name, number)}</figcaption></figure></li>"
        )
    return (f'<section id="drive-{number + 1}"><h2>Drive {number + 1}: the worst run of each method</h2>'
            f'<p class="caption">Map {escape(where)}, {len(moved)} updates{carried}.</p>{KEYS}'
            f'<ul class="worst">{"".join(items)}</ul></section>')  # fmt: skip


KEYS = """<p class="keys"><span><i class="line true"></i>true path</span><span><i class="line"></i>answers</span>
<span><i class="dot"></i>wrong answer</span><span><b>×</b> taken away</span><span><b>○</b> put down</span></p>"""


def _caption(data: Mapping[str, Any], name: str, number: int) -> str:
    keys = ("methods", name, "by_drive", number, "worst")
    run, right = _number(data, (*keys, "run"), "count", "span"), _number(data, (*keys, "right"), "percent", "span")
    off = _number(data, (*keys, "e_pos_m"), "metres", "span")
    return f"<b>{escape(name)}</b>, run {run}: right at {right} of the updates, {off} off at the end"
