"""What every single run came to, so that methods can be compared run by run (:mod:`dsom_jax.judging.statistics`)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from dsom_jax.judging.metrics import Runs


class RunTable(NamedTuple):
    """One row for each method, phase, sequence and run, (n,) each.

    Attributes:
        method, phase: names, phase ``global`` or ``kidnap``.
        sequence, part, run: numbers from 0; ``part`` counts the kidnappings of a sequence.
        steps: updates before convergence, -1 never.
        e_pos_m, e_theta_rad: error at the last update, metres and radians.
        retention: share of the updates after convergence that stayed inside the threshold, NaN without any.
    """

    method: np.ndarray
    phase: np.ndarray
    sequence: np.ndarray
    part: np.ndarray
    run: np.ndarray
    steps: np.ndarray
    e_pos_m: np.ndarray
    e_theta_rad: np.ndarray
    retention: np.ndarray

    @property
    def converged(self) -> np.ndarray:
        """(n,) bool."""
        return self.steps >= 0

    @property
    def converging_steps(self) -> np.ndarray:
        """(n,) steps as numbers to compare, NaN where the run never converged."""
        return np.where(self.converged, self.steps, np.nan)

    def rows(self, keep: Any) -> RunTable:
        """The rows ``keep`` (mask or indices)."""
        return RunTable(*(column[keep] for column in self))


def run_rows(method: str, phase: str, sequence: int, part: int, runs: Runs) -> RunTable:
    """The runs of one method in one phase of one sequence."""
    count = len(runs.steps)
    # 0 / 0 is asked for: a run that never converged has kept nothing and lost nothing.
    with np.errstate(invalid="ignore"):
        retention = np.asarray(runs.stayed, float) / runs.after
    columns: list[np.ndarray] = [np.full(count, value) for value in (method, phase, sequence, part)]
    columns += [np.arange(count), np.asarray(runs.steps, int), np.asarray(runs.e_pos), np.asarray(runs.e_theta)]
    return RunTable(*[*columns, retention])


COLUMNS = RunTable._fields[1:]
"""What :func:`columns_of` keeps."""


def columns_of(table: RunTable) -> dict[str, list[Any]]:
    """The runs of one method as lists, without its name."""
    return {name: getattr(table, name).tolist() for name in COLUMNS}


def from_columns(method: str, kept: Mapping[str, Sequence[Any]]) -> RunTable:
    """What :func:`columns_of` kept, as JSON has it: null is an infinite error, or a retention of NaN."""
    missing = {"e_pos_m": np.inf, "e_theta_rad": np.inf, "retention": np.nan}
    numbers = [np.array([other if v is None else v for v in kept[name]], float) for name, other in missing.items()]
    integers = [np.array(kept[name], int) for name in ("sequence", "part", "run", "steps")]
    return RunTable(np.full(len(kept["phase"]), method), np.array(kept["phase"]), *integers, *numbers)


def join(tables: Sequence[RunTable]) -> RunTable:
    """The rows of several tables, of which there must be one."""
    return RunTable(*(np.concatenate(columns) for columns in zip(*tables, strict=True)))


def paired(table: RunTable, a: str, b: str, phase: str) -> tuple[RunTable, RunTable]:
    """The runs of methods ``a`` and ``b`` in ``phase``, row by row of the same sequence, part and run."""
    sides = []
    for method in (a, b):
        side = table.rows((table.method == method) & (table.phase == phase))
        if not len(side.run):
            known = ", ".join(sorted(set(table.method.tolist())))
            raise ValueError(f"no run of {method} in phase {phase}; the table has {known}")
        sides.append(side.rows(np.lexsort((side.run, side.part, side.sequence))))
    keys = [np.stack([side.sequence, side.part, side.run]) for side in sides]
    if keys[0].shape != keys[1].shape or (keys[0] != keys[1]).any():
        raise ValueError(f"{a} and {b} were not run on the same sequences and seeds; run them in one benchmark")
    return sides[0], sides[1]
