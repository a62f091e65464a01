"""Weights exactly as Eq 15 gives them, beside the power of them that the comparison uses (``weight_power``)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

import comparison
from lab import Everything, Lab, Piece
from tables import bounds, markdown, number, percent

from dsom_jax import bench

NAME = "printed"


@dataclass(frozen=True)
class Config:
    """Attributes: methods whose weights are Eq 15's; its power; runs of each on each sequence; particles; T_cut."""

    methods: tuple[str, ...] = ("mcl", "mixture_mcl", "mixture_mcl_star", "mixture_mcl_dsom", "adam_dsom")
    weight_power: float = 1.0
    runs: int = 100
    particles: int = 200
    t_cut: float = 0.6


def jobs(config: Config) -> dict[str, Any]:
    """One for each method."""
    return {name: partial(run, name, config) for name in config.methods}


def run(name: str, config: Config, lab: Lab) -> dict[str, Any]:
    """One method on all sequences."""
    settings = bench.BenchSettings(config.runs, config.particles, config.t_cut, lab.seed, config.weight_power)
    entry, record = lab.compare(name, settings)
    return {"summary": entry, "runs": record.table}


def section(everything: Everything) -> str:
    """Both, method by method."""
    head = ("method, phase", "power", "converged %", "0-20 %", "E_pos m", "kept %", "strict %")
    return f"{INTRODUCTION}\n\n{markdown(head, lines(everything))}"


def lines(everything: Everything) -> Iterator[list[str]]:
    """Rows of the table."""
    others = everything.get(comparison.NAME, {})
    for name, entry in everything[NAME].items():
        sides = {number(entry["made"]["config"]["weight_power"], 0): entry}
        if name in others:
            sides[number(others[name]["made"]["config"]["weight_power"], 0)] = others[name]
        for phase in comparison.PHASES:
            yield from (row(f"`{name}`, {phase}", power, side["summary"][phase]) for power, side in sides.items())


def row(what: str, power: str, m: dict[str, Any]) -> list[str]:
    """One method in one phase with one power."""
    soon = percent(m["within_20"])
    error = number(m["e_pos_m"], 3) + bounds(m["e_pos_ci95"], 1, 3)
    return [what, power, percent(m["converged"]), soon, error, percent(m["retention"]), percent(m["strict_success"])]


INTRODUCTION = """\
Eq 15 is a sum over beams, so that a particle far from the truth weighs half as much as one at it, and the particles
neither gather at the truth nor does their mean lie there. The comparison above draws by w to the power of 8 and
averages by w to that of 16, as if so many such scans had been seen, in all filters that weigh by Eq 15, the baselines
included; only Alg 1 with likelihood_grid, hybrid or markov_grid draws as printed and averages by w to the power of 8.
Trust is w / w* as printed. Here the same filters, maps, scans and keys with power 1 throughout, which is the paper to
the letter."""

PIECE = Piece(NAME, Config(), jobs, lambda _: {}, section)
