"""``report.html``: one file with everything in it, for a browser, a printer and a screen reader."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from html import escape
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Any

from dsom_jax.atomic import write_atomic
from dsom_jax.view.pack import pack
from dsom_jax.view.story import Story

FINDINGS = {"error": "Error", "warning": "Warning", "note": "Note"}


def write_page(path: Path, story: Story) -> None:
    """Write the page, whole or not at all."""
    write_atomic(path, render(story).encode())


def render(story: Story) -> str:
    """HTML of a story."""
    # What ends a script element must not stand in it.
    data = json.dumps(pack(story), separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
    main = (_player(story), _lookalikes(story), _tables(story), _findings(story),
            numbers("Every number", story.summary), numbers("Settings", story.settings))  # fmt: skip
    scripts = f'<script type="application/json" id="story">{data}</script>\n<script>{_part("page.js")}</script>'
    skip = ("player", "Skip to the drive")
    return document(story.title, story.plan.name, story.headline, main, skip, _tiles(story), scripts)


def document(
    title: str,
    kicker: str,
    headline: str,
    main: Sequence[str],
    skip: tuple[str, str],
    tiles: str = "",
    scripts: str = "",
) -> str:
    """HTML of any page; ``main`` are its parts, ``skip`` the part to skip to and the words of that link."""
    return Template(_part("page.html")).substitute(
        css=_part("page.css"), title=escape(title), kicker=escape(kicker),
        headline=escape(headline).replace(" %", "\u00a0%"), tiles=tiles, main="\n".join(main),
        target=skip[0], skip=escape(skip[1]), scripts=scripts,
    )  # fmt: skip


def _part(name: str) -> str:
    return files("dsom_jax.view").joinpath(name).read_text(encoding="utf-8")


def _tiles(story: Story) -> str:
    """The numbers to see first, each with its key in ``summary`` and the number itself beside what is shown of it."""
    rows = []
    for key, label, kind in story.tiles:
        value = story.summary.get(key)
        if value is None:
            continue
        bounds = story.summary.get(f"{key}_ci95")
        note = label + (f" [{' to '.join(readable(b, kind) for b in bounds)}]" if bounds else "")
        rows.append(f'<li><b data-key="{escape(key)}" data-value="{value!r}">{readable(value, kind)}</b>'
                    f"<span>{escape(note)}</span></li>")  # fmt: skip
    return f'<ul class="tiles">{"".join(rows)}</ul>' if rows else ""


def readable(value: float | None, kind: str) -> str:
    """A number as people read it; ``kind`` is percent, metres, count or number."""
    if value is None or not math.isfinite(value):
        return "–"
    if kind == "percent":
        return f"{100 * value:.4g}\u00a0%" if value < 1e-3 and value else f"{100 * value:.1f}\u00a0%"
    if kind == "metres":
        return f"{value:.3f}\u00a0m" if value < 1 else f"{value:.1f}\u00a0m"
    return f"{value:g}" if kind == "count" else f"{value:.3g}"


def _player(story: Story) -> str:
    if not (story.drives or story.overlay):
        return ""
    html = Template(_part("player.html")).substitute(
        label="The drive" if story.drives else "The map", caption=escape(story.caption)
    )
    if story.overlay is None:
        return html
    layer, key = story.overlay, "<p class='overlay-key'><span>{low}</span><i></i><span>{high}</span><b>{label}</b></p>"
    known = layer.values[layer.values == layer.values]
    low, high = (f"{v:.3g} {layer.unit}" for v in ((known.min(), known.max()) if known.size else (0.0, 1.0)))
    return html.replace("<!--overlay-->", key.format(low=escape(low), high=escape(high), label=escape(layer.label)))


def _lookalikes(story: Story) -> str:
    """Poses that one scan cannot tell apart."""
    if not story.lookalikes:
        return ""
    rows = tuple(
        (str(n), _pose(pair.a), _pose(pair.b), f"{pair.log_odds:.2f}") for n, pair in enumerate(story.lookalikes, 1)
    )
    return _table(("Places that look alike", ("pair", "here", "looks like", "log odds"), rows))


def _pose(pose: Any) -> str:
    x, y, theta = (float(v) for v in pose)
    return f"{x:.1f} m, {y:.1f} m, {math.degrees(theta):.0f}°"


def _tables(story: Story) -> str:
    return "".join(map(_table, story.tables))


def _table(parts: tuple[str, tuple[str, ...], tuple[tuple[str, ...], ...]]) -> str:
    caption, heads, rows = parts
    head = "".join(f'<th scope="col">{escape(h)}</th>' for h in heads)
    body = "".join(
        f'<tr><th scope="row">{escape(row[0])}</th>{"".join(f"<td>{escape(cell)}</td>" for cell in row[1:])}</tr>'
        for row in rows
    )
    name = escape(caption)
    return (f'<section class="scroll" tabindex="0" role="region" aria-label="{name}"><table><caption>{name}</caption>'
            f"<thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></section>")  # fmt: skip


def _findings(story: Story) -> str:
    items = "".join(
        f'<li class="{finding.severity}"><b>{FINDINGS[finding.severity]}</b>{escape(finding.says)}'
        + (f" <em>{escape(finding.fix)}</em>" if finding.fix else "")
        + "</li>"
        for finding in story.findings
    )
    none = "<p>Map and log gave no cause for remarks.</p>"
    return f"<section><h2>Findings</h2>{f'<ul class=findings>{items}</ul>' if items else none}</section>"


def numbers(title: str, values: dict[str, Any]) -> str:
    """All scalars of a dictionary, folded away; nested ones with a dot."""
    rows = "".join(
        f'<tr><th scope="row">{escape(key)}</th><td data-number="{escape(key)}">{escape(str(value))}</td></tr>'
        for key, value in _flat(values)
    )
    table = f'<table class="plain"><tbody>{rows}</tbody></table>'
    return f"<section><details><summary>{title}</summary>{table}</details></section>" if rows else ""


def _flat(numbers: dict[str, Any], before: str = "") -> list[tuple[str, Any]]:
    rows: list[tuple[str, Any]] = []
    for key, value in numbers.items():
        if isinstance(value, dict):
            rows += _flat(value, f"{before}{key}.")
        elif not (isinstance(value, list) and any(isinstance(v, dict) for v in value)):
            rows.append((before + str(key), json.dumps(value) if isinstance(value, list) else value))
    return rows
