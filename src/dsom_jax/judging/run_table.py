"""What every single run came to, so that methods can be compared run by run (:mod:`.judging.statistics`)."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from dsom_jax.atomic import write_atomic
from dsom_jax.data.files import read_arrays
from dsom_jax.errors import UserError
from dsom_jax.judging.metrics import Runs, ratio


class RunTable(NamedTuple):
    """One row for each method, phase, sequence and run, (n,) each; what follows ``run`` is as in :class:`Runs`.

    Attributes:
        method, phase: names, phase ``global`` or ``kidnap``.
        sequence, part, run: numbers from 0; ``part`` counts the kidnappings of a sequence.
        steps: updates before convergence, -1 never.
        after, stayed: updates after convergence, and those of them inside the threshold; ``relost``: did not last.
        e_pos_m, e_theta_rad: error at the last update, metres and radians.
        known, confident, fooled: updates with a reference, those with a claim, and with a wrong one.
        metres: driven until convergence.
    """

    method: np.ndarray
    phase: np.ndarray
    sequence: np.ndarray
    part: np.ndarray
    run: np.ndarray
    steps: np.ndarray
    after: np.ndarray
    stayed: np.ndarray
    relost: np.ndarray
    e_pos_m: np.ndarray
    e_theta_rad: np.ndarray
    known: np.ndarray
    confident: np.ndarray
    fooled: np.ndarray
    metres: np.ndarray

    @property
    def runs(self) -> Runs:
        """All rows as one set of experiments; sequences are the drives."""
        return Runs(*self[5:], self.sequence)

    @property
    def converged(self) -> np.ndarray:
        """(n,) bool."""
        return self.steps >= 0

    @property
    def retention(self) -> np.ndarray:
        """(n,) share of the updates after convergence that stayed inside the threshold, NaN without any."""
        return np.array([ratio(stayed, after) for stayed, after in zip(self.stayed, self.after, strict=True)])

    def rows(self, keep: Any) -> RunTable:
        """The rows ``keep`` (mask or indices)."""
        return RunTable(*(column[keep] for column in self))


def run_rows(method: str, phase: str, sequence: int, part: int, runs: Runs) -> RunTable:
    """The runs of one method in one phase of one sequence."""
    count = len(runs.steps)
    labels = [np.full(count, value) for value in (method, phase, sequence, part)]
    return RunTable(*[*labels, np.arange(count), *map(np.asarray, runs[:-1])])


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


SMALL = {"sequence": np.int32, "part": np.int16, "run": np.int32, "steps": np.int32, "after": np.int32,
         "stayed": np.int32, "known": np.int32, "e_pos_m": np.float32, "e_theta_rad": np.float32,
         "confident": np.float32, "fooled": np.float32, "metres": np.float32}  # fmt: skip
"""How columns lie in files."""


def stored(table: RunTable) -> dict[str, np.ndarray]:
    """The columns as they lie in files."""
    return {name: column.astype(SMALL.get(name, column.dtype)) for name, column in table._asdict().items()}


def write_runs(path: Path, table: RunTable, **more: np.ndarray) -> None:
    """Write the columns of ``table``, and ``more`` arrays beside them, to ``path`` (npz), atomically."""
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **stored(table), **more)  # type: ignore[arg-type]  # allow_pickle is not among them
    write_atomic(path, buffer.getvalue())


def read_runs(path: str | Path) -> RunTable:
    """The table that :func:`write_runs` wrote."""
    columns = read_arrays(path, "table of runs of bench --per-run")
    table = RunTable(*(columns.get(name, np.zeros((0, 0))) for name in RunTable._fields))
    kinds = {column.dtype.kind for column in table[2:]} | {table.method.dtype.kind + table.phase.dtype.kind}
    if not kinds <= set("iufb") | {"UU"} or len({column.shape for column in table}) > 1 or table.run.ndim != 1:
        raise UserError(f"{path}: not a table of runs (other columns); make it again with bench --per-run")
    return table
