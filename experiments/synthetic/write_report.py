"""``experiments/REPORT.md`` and the figures, from the results."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import verdicts
from lab import Everything, Piece, Results, read, result_path
from tables import markdown, number

from dsom_jax import plotting
from dsom_jax.report import write_text

TITLES = {
    "multimodal": "Multimodality of PM (Fig 3)",
    "comparison": "Comparison and ablation (Fig 5, 6, 7)",
    "printed": "Weights as printed",
    "retention": "T_cut (Table I) and retention",
    "particles": "Number of particles (Table II)",
    "odometry": "Noise of the odometry",
    "one_scan": "One scan: what each proposal withstands",
    "cost": "Time and memory (Sec V-A)",
}
HEAD = """\
# Synthetic experiments

Written by `python experiments/synthetic/run.py` from the shipped checkpoints; do not edit. The paper is Chen et al.,
RA-L 2021; its numbers and where they stand are in [synthetic/paper.py](synthetic/paper.py). Real logs:
[real/REPORT.md](real/REPORT.md). The paper's own real data (UPO, Bicocca) are not here and were not run
([paper_data](paper_data/README.md))."""


def gather(pieces: Sequence[Piece], folder: Path) -> dict[str, dict[str, Any]]:
    """The results of all jobs that there are, in the order of the pieces and their jobs."""
    found: dict[str, dict[str, Any]] = {}
    for piece in pieces:
        paths = {job: result_path(folder, piece.name, job) for job in piece.jobs(piece.config)}
        jobs = {job: read(path) for job, path in paths.items() if path.exists()}
        if jobs:
            found[piece.name] = jobs
    return found


def write(pieces: Sequence[Piece], results: Path, figures: Path, page: Path) -> None:
    """Draw and write everything."""
    everything = gather(pieces, results)
    figures.mkdir(parents=True, exist_ok=True)
    done = [piece for piece in pieces if piece.name in everything]
    for piece in done:
        for name, figure in piece.figures(everything).items():
            plotting.save_figure(figure, figures / f"{name}.png")
    text = render(done, everything)
    write_text(page, text.replace("FIGURES/", f"{os.path.relpath(figures, page.parent)}/"))


def render(pieces: Sequence[Piece], everything: Everything) -> str:
    """The page."""
    blocks = [HEAD, "## Claims of the paper", verdicts.section(everything)]
    for piece in pieces:
        blocks += [f"## {TITLES[piece.name]}", made_with(everything[piece.name]), piece.section(everything)]
    blocks += ["## How it was made", provenance(everything)]
    return "\n\n".join(blocks) + "\n"


def made_with(jobs: Results) -> str:
    """The configuration of a piece, in one line; what differs between its jobs is given as all values."""
    configs = [entry["made"]["config"] for entry in jobs.values()]
    parts = []
    for key in configs[0]:
        values = list(dict.fromkeys(_short(config[key]) for config in configs))
        parts.append(f"{key} {' or '.join(values)}")
    return f"*{'; '.join(parts)}.*"


def _short(value: Any) -> str:
    return ", ".join(map(str, value)) if isinstance(value, list) else str(value)


def provenance(everything: Everything) -> str:
    """When, where and from what every piece was made."""
    lines = []
    for piece, jobs in everything.items():
        made = [entry["made"] for entry in jobs.values()]
        lines.append([piece, str(len(made)), number(sum(m["wall_s"] for m in made) / 60, 1),
                      number(sum(m["processor_s"] for m in made) / 60, 1),
                      number(max(m["machine"]["load"] for m in made), 1), _all(m["seed"] for m in made),
                      _all(m["commit"][:7] for m in made)])  # fmt: skip
    head = ("piece", "jobs", "min by the clock", "min of processor time", "load, at most", "seed", "commit")
    machines = {_machine(entry["made"]["machine"]) for jobs in everything.values() for entry in jobs.values()}
    return "\n\n".join([markdown(head, lines), OVERLAP, *sorted(machines)])


OVERLAP = """\
Jobs of comparison and cost run alone. Those of the other pieces share the machine with each other (`--workers`), so
that their minutes overlap."""


def _all(values: Any) -> str:
    return ", ".join(dict.fromkeys(map(str, values)))


def _machine(machine: dict[str, Any]) -> str:
    return (f"Machine: {machine['processor']}, {machine['cores']} cores, {machine['device']}, "
            f"JAX {machine['jax']}, Python {machine['python']}.")  # fmt: skip
