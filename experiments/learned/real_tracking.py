"""Do PF-Net and PFRNN track on real logs? ``python experiments/learned/real_tracking.py [--only intel] [--runs 30]``

Pieces of 60 updates of the logs of ``experiments/real/paper.yaml``, without kidnapping, each from a roughly known start
as in ``tracking.py``, with the networks that ``experiments/real/paper.py`` has trained on in each building (run it
first), and odometry alone. Writes ``results/real_tracking.json``.
"""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from tracking import HERE, dead_reckoning, errors, summary

from dsom_jax import checkpoint
from dsom_jax.data import load_map
from dsom_jax.data.cut import to_episode
from dsom_jax.errors import UserError, run_cli
from dsom_jax.filters.methods import LEARNED
from dsom_jax.protocol.clips import windows
from dsom_jax.protocol.plan import ProtocolPlan, map_file, read_logs, read_plan
from dsom_jax.run_folder import commit

ROOT = HERE.parents[1]
DATA = Path(os.environ.get("DSOM_DATA") or ROOT.parent / "shared" / "data")


def pieces(plan: ProtocolPlan, name: str, data: Path, work: Path, count: int) -> tuple[Any, Any, list[Any]]:
    """Map, lidar, and ``count`` pieces of its logs, evenly spread."""
    one, fields = plan.on(name)
    grid = load_map(map_file(name, fields, data, work))
    found = [(log, rows) for log in read_logs(one, data) for rows in windows(log, grid, one)]
    if len(found) < count:
        raise UserError(f"{name}: {len(found)} pieces of {one.updates} updates lie on this map, {count} are wanted")
    chosen = [found[n] for n in np.linspace(0, len(found) - 1, count).round().astype(int)]
    return grid, chosen[0][0].lidar, [to_episode(log, rows) for log, rows in chosen]


def main(
    only: tuple[str, ...] = (),
    drives: int = 12,
    runs: int = 30,
    particles: int = 500,
    data: Path = DATA,
    work: Path = ROOT / "runs" / "real",
    out: Path = HERE / "results" / "real_tracking.json",
) -> None:
    """Track each piece ``runs`` times with each filter, in each building (``only`` some: ``out`` has these alone)."""
    plan = read_plan(ROOT / "experiments" / "real" / "paper.yaml", {})
    if unknown := set(only) - set(plan.maps):
        raise UserError(f"--only {' '.join(unknown)}: the configuration has {', '.join(plan.maps)}")
    found: dict[str, Any] = {"commit": commit(), "updates": plan.updates, "particles": particles}
    for number, name in enumerate(plan.maps):
        if only and name not in only:
            continue
        grid, lidar, episodes = pieces(plan, name, data, work, drives)
        found[name] = {"odometry": dead_reckoning(episodes, number)}
        for kind in LEARNED:
            folder = work / "networks" / f"{name}-{kind}-{plan.learn_steps}-steps"
            if not folder.is_dir() or checkpoint.load_provenance(folder, kind)["steps"] != plan.learn_steps:
                raise UserError(f"{folder}: no network of this building; run experiments/real/paper.py first")
            model = checkpoint.load(folder, lidar, kind=kind)
            tracked = summary(*errors(LEARNED[kind](model, grid, lidar, particles), episodes, runs, number))
            found[name][kind] = {"network": checkpoint.digest(folder), **tracked}
            print(name, kind, json.dumps(found[name][kind]), file=sys.stderr)
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_text(json.dumps(found, indent=2) + "\n")


if __name__ == "__main__":
    run_cli(lambda: tyro.cli(main))
