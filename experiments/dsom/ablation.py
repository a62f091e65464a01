"""What each idea is worth at equal training time: ``python experiments/dsom/ablation.py``.

Every row of ``ablation.yaml`` is trained anew for the same number of minutes and judged on the same 96 scans in
full-size buildings that training does not see. Rows that are in ``results/ablation.json`` are kept.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from dsom_jax import checkpoint, report
from dsom_jax.cli import parse
from dsom_jax.data.files import read_yaml
from dsom_jax.errors import UserError, run_cli
from dsom_jax.run_folder import commit

HERE = Path(__file__).resolve().parent
SHOWN = ("mass_median", "mass_gt_1pct", "top1")


@dataclass(frozen=True)
class Args:
    """Train and judge every row."""

    config: Path = HERE / "ablation.yaml"
    """Rows, and minutes of training of each."""
    out: Path = HERE / "results" / "ablation.json"
    """Results."""


def main() -> None:
    """Rows one after another; a table at the end."""
    args = parse(Args, "python experiments/dsom/ablation.py")
    given = read_yaml(args.config, "ablation")
    rows = json.loads(args.out.read_text()) if args.out.exists() else {}
    for name, changes in given["rows"].items():
        if name not in rows:
            rows[name] = row(changes, given["minutes"])
            report.write_json(args.out, rows)
    for name, found in rows.items():
        numbers = " / ".join(f"{100 * found[key]:.1f}" for key in SHOWN)
        print(f"{name}: {found['samples']} scans in {found['seconds'] / 60:.1f} min, {numbers} %")


def row(changes: dict[str, Any], minutes: float) -> dict[str, Any]:
    """A network trained with ``changes`` to the defaults, judged."""
    with tempfile.TemporaryDirectory() as folder:
        config, net = Path(folder) / "config.yaml", Path(folder) / "net"
        config.write_text(yaml.safe_dump(changes))
        words = ["--config", config, "--minutes", minutes, "--out", net, "--save-minutes", 60]
        if subprocess.run([sys.executable, "-m", "dsom_jax.train", *map(str, words)]).returncode:
            raise UserError("training failed, see above")
        made = checkpoint.load_provenance(net)
    kept = {name: made[name] for name in ("steps", "samples", "seconds")}
    return {"changes": changes, "minutes": minutes, "commit": commit(), **kept, **made["metrics"]}


if __name__ == "__main__":
    run_cli(main)
