"""Tables, paired differences and figures from the stored results of all maps."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from dsom_jax import plotting, report
from dsom_jax.filters import methods
from dsom_jax.judging.run_table import RunTable, join, paired
from dsom_jax.judging.statistics import Evidence, paired_evidence
from dsom_jax.protocol.plan import ProtocolPlan, Variant, variants
from dsom_jax.protocol.running import read_entry, read_evolution, read_table

_COLUMNS = (
    "method",
    "network",
    "T_cut",
    "runs",
    "converged %",
    "steps",
    "E_pos m",
    "kept %",
    "strict %",
    "sure and wrong %",
)
CLIP_PHASES = {"global": "Global localization", "kidnap": "Spliced kidnapping"}
_LEGEND = """\
Every clip starts without any prior on the pose; at its end the robot is carried to the start of the next one unnoticed.

- converged: 5 updates in a row within 2 m and 10 deg; steps: updates before, median
- E_pos: mean final error of the converged runs; kept: share of the later updates still within; strict: last estimate
  within 0.5 m and 5 deg
- in brackets: 95 % intervals that draw clips with all their runs; where all runs of each clip agree, Wilson's with
  clips as trials. Few clips decide little
- sure and wrong: updates at which the filter claims to know (lost < 5 %) and is not within 2 m and 10 deg
- the paper's filters are judged by the weighted mean of the particles, robust ones by the heaviest cluster
- network: as shipped, or trained on in this map for so long
- `*_markov_grid` and `robust_likelihood_grid` draw from what all scans so far say by their likelihood, as `localize`
  does, `*_markov_dsom` from what the network says of all of them, `*_markov_hybrid` from both; the other `adam_*`,
  `robust_*` and `mixture_*` from what the last one says
"""


def write_report(plan: ProtocolPlan, out: Path) -> None:
    """``out``/REPORT.md with everything that is there, and the figures of each map."""
    parts = [f"# {plan.name}\n\nWritten by the experiment's command from its results; do not edit.\n\n{_LEGEND}"]
    for name in plan.maps:
        entries = load_entries(plan, out / name)
        if not entries:
            continue
        parts.append(f"\n## {name}\n\n{made_with(entries)}\n")
        parts += [_table(entries, phase) for phase in CLIP_PHASES]
        parts.append(differences(plan, entries, out / name))
        figures(plan, out / name, entries)
    report.write_text(out / "REPORT.md", "\n".join(parts))


def load_entries(plan: ProtocolPlan, folder: Path) -> dict[Variant, dict[str, Any]]:
    """The results of one map that exist, in the order of the plan."""
    found = {variant: read_entry(folder, variant) for variant in variants(plan)}
    return {variant: entry for variant, entry in found.items() if entry is not None}


def made_with(entries: dict[Variant, dict[str, Any]]) -> str:
    """One line for each configuration among the results."""
    keys = ("commit", "particles", "clips", "runs", "updates", "seed", "map_kind")
    made = dict.fromkeys(tuple(entry[key] for key in keys) for entry in entries.values())
    return "\n".join(
        f"Commit {c}: {p} particles, {n} clips x {r} runs, {t} updates in each phase, seed {s}, map {k}."
        for c, p, n, r, t, s, k in made
    )


def _table(entries: dict[Variant, dict[str, Any]], phase: str) -> str:
    """Markdown table of one phase."""
    rows = [_COLUMNS, ("---", "---", *["---:"] * (len(_COLUMNS) - 2))]
    rows += [row(variant, _network_of(entry), entry[phase]) for variant, entry in entries.items()]
    lines = ["| " + " | ".join(cells) + " |" for cells in rows]
    return f"**{CLIP_PHASES[phase]}**\n\n" + "\n".join(lines) + "\n"


def row(variant: Variant, origin: str, m: dict[str, Any]) -> tuple[str, ...]:
    """Cells of one variant, ``origin`` that of its network."""
    return (
        f"`{variant.method}`", origin, "" if variant.t_cut is None else f"{variant.t_cut:g}",
        f"{m['experiments']}", rate(m, "converged"), number(m["steps_median"], "{:g}"),
        number(m["e_pos_m"], "{:.3f}") + _interval(m["e_pos_ci95"], "{:.3f}", 1),
        rate(m, "retention"), number(m["strict_success"], "{:.1f}", 100), number(m["false_confident"], "{:.1f}", 100),
    )  # fmt: skip


def _network_of(entry: dict[str, Any]) -> str:
    """Where the network of a result comes from, for a cell."""
    facts = entry.get("network")
    if not facts:
        return ""
    return "shipped" if facts["shipped"] else f"{facts['seconds'] / 60:.0f} min, {facts['samples']} scans"


def rate(m: dict[str, Any], name: str) -> str:
    """A share in percent with its interval."""
    if m[name] is None:
        return "-"
    return number(m[name], "{:.1f}", 100) + _interval(m[f"{name}_ci95"], "{:.1f}", 100)


def number(value: float | None, form: str, scale: float = 1) -> str:
    """A number, or a dash where there is none."""
    return "-" if value is None else form.format(scale * value)


def _interval(bounds: list[float | None], form: str, scale: float) -> str:
    """Bounds in brackets, nothing where there are none."""
    low, high = bounds
    return "" if low is None or high is None else f" [{form.format(scale * low)}-{form.format(scale * high)}]"


def pairs(entries: dict[Variant, dict[str, Any]]) -> Iterator[tuple[Variant, Variant]]:
    """What is compared: networks, values of T_cut, every method with the paper's, proposals, filters."""
    there = list(entries)
    first = next((v.t_cut for v in there if v.t_cut is not None), None)

    def find(method: str, shipped: bool = False, t_cut: float | None = first) -> Variant | None:
        cut = t_cut if method.startswith("adam_") else None
        return next((v for v in there if v == Variant(method, shipped, cut)), None)

    others = [v.t_cut for v in there if v.method == "adam_dsom" and v.t_cut != first and not v.shipped]
    chosen = [(find("adam_dsom"), find("adam_dsom", shipped=True)), (find("robust_dsom"), find("adam_dsom"))]
    chosen += [(find("adam_dsom"), find("adam_dsom", t_cut=cut)) for cut in others]
    chosen += [
        (find("adam_dsom"), find(name)) for name in ("mcl", "mixture_mcl", "mixture_mcl_star", "pf_net", "pfrnn")
    ]
    chosen += [(find(name), find("adam_dsom")) for name in ("adam_likelihood_grid", "adam_hybrid")]
    chosen += [(find("adam_markov_grid"), find("adam_likelihood_grid"))]
    chosen += [(find("adam_markov_dsom"), find(name)) for name in ("adam_dsom", "adam_markov_grid")]
    chosen += [(find("robust_markov_hybrid"), find("robust_likelihood_grid"))]
    chosen += [(find("robust_likelihood_grid"), find(name)) for name in ("adam_likelihood_grid", "robust_dsom")]
    yield from ((a, b) for a, b in chosen if a and b)


def comparable(entries: dict[Variant, dict[str, Any]], variant: Variant, other: Variant) -> bool:
    """Whether both are of the same map, clips, seed, runs and particles, and of one network of each kind."""
    sides = [entries[variant], entries[other]]
    same = ("map_digest", "clips_digest", "seed", "runs", "particles", "clips", "updates")
    trained = {
        (methods.network_of(v.method), entries[v]["network"].get("digest"))
        for v in (variant, other)
        if entries[v]["network"] and not entries[v]["network"]["shipped"]
    }
    one_each = len(trained) == len({kind for kind, _ in trained})
    return one_each and all(sides[0][key] == sides[1][key] for key in same)


def differences(plan: ProtocolPlan, entries: dict[Variant, dict[str, Any]], folder: Path) -> str:
    """Paired comparisons in both phases: differences with intervals, and what they decide."""
    asked = list(pairs(entries))
    found = [(a, b) for a, b in asked if comparable(entries, a, b)]
    if not found:
        return ""
    lines = ["| a against b | phase | what | a - b [95 % interval] | decided |", "| --- | --- | --- | ---: | --- |"]
    for a, b in found:
        both = join([read_table(folder, v) for v in (a, b)])
        for phase in CLIP_PHASES:
            lines += [line(a, b, phase, piece) for piece in compare(both, a, b, phase, plan.seed)]
    note = (
        f"Paired: same clips, same seeds. Intervals draw clips, of which {plan.clips} are few; a difference counts as "
        f"decided if an exact sign-flip test over clips agrees, which with {plan.clips} of them cannot give less than "
        f"p = {2 ** (1 - plan.clips):.2g}."
    )
    if len(found) < len(asked):
        note += f" Pairs that were not made alike are left out: {len(asked) - len(found)}."
    return "\n".join([note, "", *lines]) + "\n"


def compare(both: RunTable, a: Variant, b: Variant, phase: str, seed: int) -> list[Evidence]:
    """Convergence and final error of two variants, run by run."""
    one, other = paired(both, a.stem, b.stem, phase)
    drives = one.sequence
    return [
        paired_evidence("converged, share of runs", one.converged, other.converged, drives, "greater", seed=seed),
        paired_evidence("final error of all runs, m", one.e_pos_m, other.e_pos_m, drives, seed=seed),
    ]


def line(a: Variant, b: Variant, phase: str, piece: Evidence) -> str:
    """A row of the table of differences."""
    decided = {"supports": "a better", "contradicts": "b better", "undecided": "undecided"}[piece.status()]
    bounds = "" if math.isnan(piece.low) else f" [{piece.low:.3f}, {piece.high:.3f}]"
    names = f"`{a.stem}`, `{b.stem}`"
    return f"| {names} | {CLIP_PHASES[phase]} | {piece.what} | {piece.estimate:.3f}{bounds} | {decided} |"


def figures(plan: ProtocolPlan, out: Path, entries: dict[Variant, dict[str, Any]]) -> None:
    """Error over the updates with its 95 % band, as in the paper's figures of real data; boxes of final errors."""
    shown = [v for v in entries if v.name in (plan.shown or plan.methods) and v.t_cut in (None, plan.t_cuts[0])]
    shown = [v for v in shown if comparable(entries, shown[0], v)]
    if not shown:
        return
    tables, curves = {v.name: read_table(out, v) for v in shown}, {v.name: read_evolution(out, v) for v in shown}
    clips = range(len(curves[shown[0].name]))
    bands = [{name: curve[clip] for name, curve in curves.items()} for clip in clips]
    moved = [[entries[shown[0]]["updates"]]] * len(bands)
    plotting.save_figure(plotting.band_evolution(bands, moved), out / "error_evolution.png")
    errors = {phase: {name: t.e_pos_m[t.phase == phase] for name, t in tables.items()} for phase in CLIP_PHASES}
    plotting.save_figure(plotting.error_boxes(errors), out / "position_error.png")
