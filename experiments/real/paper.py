"""The paper's protocol on real logs: ``python experiments/real/paper.py [--runs 5] [--only intel]``.

For each map of ``paper.yaml``: the networks are trained on in the building, three clips of the log are chosen and
joined as kidnappings, and every method is run on them. ``paper/MAP/METHOD.json`` are the results; ``paper/REPORT.md``
and the figures come from them. Networks and pictures of runs lie in ``--work``. What exists is kept, so an interrupted
series continues where it was; ``--adapt-minutes 0 --learn-steps 0`` takes the networks as they are.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import tyro

from dsom_jax.errors import run_cli
from dsom_jax.protocol import command

HERE = Path(__file__).parent
ROOT = HERE.parents[1]


@dataclass(frozen=True)
class Args(command.ProtocolArgs):
    """Run the series and write the report."""

    config: Path = HERE / "paper.yaml"
    """Configuration file."""
    data: Path = Path(os.environ.get("DSOM_DATA") or ROOT.parent / "shared" / "data")
    """Folder that holds a folder for each log."""
    out: Path = HERE / "paper"
    """Folder for results, tables and figures."""
    work: Path = ROOT / "runs" / "real"
    """Folder for adapted networks, which a repetition takes up again, and pictures of runs."""


if __name__ == "__main__":
    run_cli(lambda: command.main(tyro.cli(Args, description=__doc__)))
