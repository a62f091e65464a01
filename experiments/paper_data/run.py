"""The paper's own real data: ``python experiments/paper_data/run.py --config upo.yaml --data DIR``.

The same command as ``experiments/real/paper.py``: the network is adapted to each map, clips are chosen and joined as
kidnappings, all methods run on them. See README.md beside this file: the data are not here.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import tyro

from dsom_jax.errors import run_cli
from dsom_jax.protocol import command

HERE = Path(__file__).parent
HERE_RESULTS, RUNS = HERE / "results", HERE.parents[1] / "runs"


@dataclass(frozen=True)
class Args(command.ProtocolArgs):
    """Run one configuration."""

    out: Path = HERE_RESULTS
    """Folder for results, tables and figures; a folder named as the configuration is made in it."""
    work: Path = RUNS
    """Folder for adapted networks and pictures of runs, likewise."""


def main(args: Args) -> None:
    """One configuration in folders of its name."""
    name = args.config.stem
    command.main(replace(args, out=args.out / name, work=args.work / name))


if __name__ == "__main__":
    run_cli(lambda: main(tyro.cli(Args, description=__doc__)))
