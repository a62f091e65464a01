"""Tables of runs as JSON and back."""

from __future__ import annotations

from typing import Any

import numpy as np
from lab import column

from dsom_jax.run_table import RunTable

COLUMNS = ("phase", "sequence", "part", "run", "steps", "e_pos_m", "e_theta_rad", "retention")


def rows(table: RunTable) -> dict[str, list[Any]]:
    """The columns of the runs of one method."""
    return {name: getattr(table, name).tolist() for name in COLUMNS}


def table(method: str, kept: dict[str, list[Any]]) -> RunTable:
    """What :func:`rows` kept."""
    columns: list[np.ndarray] = [np.array(kept["phase"]), *(np.array(kept[name], int) for name in COLUMNS[1:5])]
    # An infinite error is null in the file: the worst there is.
    errors = [np.where(np.isnan(e), np.inf, e) for e in (column(kept["e_pos_m"]), column(kept["e_theta_rad"]))]
    names = np.full(len(kept["phase"]), method)
    return RunTable(*[names, *columns, *errors, column(kept["retention"])])
