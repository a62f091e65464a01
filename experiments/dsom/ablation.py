"""What each idea is worth at equal training time: ``python experiments/dsom/ablation.py``.

Every row of ``ablation.yaml`` is trained anew for the same number of minutes and judged on the same 96 scans in
full-size buildings that training does not see. Rows of ``results/ablation.json`` that were made so are kept.
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
from dsom_jax.data.documents import read_yaml
from dsom_jax.errors import UserError, run_cli

HERE = Path(__file__).resolve().parent
SHOWN = ("steps", "samples", "seconds", "mass_median", "mass_gt_1pct", "top1")


@dataclass(frozen=True)
class Args:
    """Train and judge every row."""

    config: Path = HERE / "ablation.yaml"
    """Rows, and minutes of training of each."""
    out: Path = HERE / "results" / "ablation.json"
    """Results."""


def main() -> None:
    """Rows one after another, each printed as it comes."""
    args = parse(Args, "python experiments/dsom/ablation.py")
    given = read_yaml(args.config, "ablation")
    if missing := [name for name in ("base", "minutes", "rows") if name not in given]:
        raise UserError(f"{args.config}: field {missing[0]} is missing; give base, minutes and rows")
    report.output_folder(args.out.parent)
    rows = json.loads(args.out.read_text()) if args.out.exists() else {}
    for name, changes in given["rows"].items():
        asked = {"changes": given["base"] | changes, "minutes": given["minutes"]}
        if {key: rows.get(name, {}).get(key) for key in asked} != asked:
            rows[name] = asked | train(**asked)
            report.write_json(args.out, rows)
        print(f"{name}: " + ", ".join(f"{key} {rows[name][key]}" for key in SHOWN), flush=True)


def train(changes: dict[str, Any], minutes: float) -> dict[str, Any]:
    """How a network trained with ``changes`` to the defaults does."""
    with tempfile.TemporaryDirectory() as folder:
        config, net = Path(folder) / "config.yaml", Path(folder) / "net"
        config.write_text(yaml.safe_dump(changes))
        words = ["--config", config, "--minutes", minutes, "--out", net, "--save-minutes", 60]
        if subprocess.run([sys.executable, "-m", "dsom_jax.train", *map(str, words)]).returncode:
            raise UserError("training failed, see above")
        made = checkpoint.load_provenance(net)
    return {name: made[name] for name in ("commit", "steps", "samples", "seconds")} | made["metrics"]


if __name__ == "__main__":
    run_cli(main)
