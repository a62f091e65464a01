"""The number of particles (Table II), AdaM + DSOM."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import comparison
import paper
from lab import POWERS, Everything, Lab, Piece
from tables import bounds, markdown, number, percent

from dsom_jax import bench

NAME = "particles"
METHOD = "adam_dsom"


@dataclass(frozen=True)
class Config:
    """Attributes: numbers of particles beside 200, the comparison's; runs of each on each sequence; T_cut; powers."""

    particles: tuple[int, ...] = (500, 1000)
    runs: int = 50
    t_cut: float = 0.6
    powers: tuple[float, float] | None = POWERS


def jobs(config: Config) -> dict[str, Any]:
    """One for each number."""
    return {str(count): partial(vary, count, config) for count in config.particles}


def vary(count: int, config: Config, lab: Lab) -> dict[str, Any]:
    """AdaM + DSOM with ``count`` particles on all sequences."""
    entry, record = lab.compare(METHOD, bench.BenchSettings(config.runs, count, config.t_cut, lab.seed))
    return {"summary": entry, "runs": record.table}


def by_count(everything: Everything) -> dict[int, dict[str, Any]]:
    """All numbers of particles that were run; 200 stands in the comparison."""
    first = everything.get(comparison.NAME, {}).get(METHOD)
    found = {200: first} if first else {}
    return found | {int(count): entry for count, entry in sorted(everything[NAME].items(), key=lambda i: int(i[0]))}


def section(everything: Everything) -> str:
    """Table II with the paper's numbers."""
    head = ["particles", "runs"]
    for phase in ("global", "kidnapping"):
        head += [f"E_pos m, {phase}", "paper", f"E_theta rad, {phase}", "paper", "converged %", "kept %"]
    lines = []
    for count, entry in by_count(everything).items():
        line, theirs = [str(count), str(entry["summary"]["global"]["experiments"])], paper.PARTICLES.get(count)
        for phase in comparison.PHASES:
            m = entry["summary"][phase]
            for key, which in (("e_pos_m", "e_pos"), ("e_theta_rad", "e_theta")):
                line.append(number(m[key], 3) + bounds(m[f"{which}_ci95"], 1, 3))
                line.append(number(theirs.of(phase, which) if theirs else None, 3))
            line += [percent(m["converged"]), percent(m["retention"])]
        lines.append(line)
    return f"{TABLE_2}\n\n{markdown(head, lines)}"


TABLE_2 = """\
Table II: AdaM + DSOM, T_cut 0.6. The final error of a run that is at that moment away from the truth enters its mean
like any other, so that a few departures outweigh many particles; see retention."""

PIECE = Piece(NAME, Config(), jobs, lambda _: {}, section)
