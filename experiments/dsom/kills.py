"""Killed twenty times, training ends with the numbers of a run left alone: ``python experiments/dsom/kills.py``.

A tiny network on procedural buildings, saved every second step. Every start is killed with SIGKILL within ten seconds
of its first step; then losses and weights are compared bit for bit. Writes ``results/kills.json``.
"""

from __future__ import annotations

import json
import os
import random
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np
import tyro

from dsom_jax import checkpoint
from dsom_jax.run_folder import commit

HERE = Path(__file__).parent
CONFIG = """
model: {width: 2, headings: 4, channels: 2}
scan: {beams: 24, obstacles: [0, 4]}
early: {cells: 48, worlds: 1, scans: 2}
late: {cells: 64, worlds: 1, scans: 2}
warmup: 3
"""


def start(folder: Path, out: str, steps: int) -> subprocess.Popen[bytes]:
    """A run in ``folder / out``, resumed if there is one."""
    command = [sys.executable, "-m", "dsom_jax.train", "--config", "tiny.yaml", "--out", out, "--resume"]
    cache = {"JAX_COMPILATION_CACHE_DIR": str(folder / "cache"), "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"}
    return subprocess.Popen(
        [*command, "--steps", str(steps), "--save-steps", "2"],
        cwd=folder, env={**os.environ, **cache}, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip


def kill_soon(process: subprocess.Popen[bytes], log: Path, delay: float) -> bool:
    """SIGKILL ``delay`` seconds after its first step; whether it was still running then."""
    least = log.stat().st_size if log.exists() else 0
    while process.poll() is None and (not log.exists() or log.stat().st_size <= least):
        least = min(least, log.stat().st_size if log.exists() else 0)  # a resumed run first trims the log
        time.sleep(0.002)
    time.sleep(delay)
    running = process.poll() is None
    process.kill()
    process.wait()
    return running


def numbers(folder: Path) -> list[dict[str, Any]]:
    """Metrics of all steps but for the time."""
    lines = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    return [{k: v for k, v in line.items() if k != "seconds"} for line in lines]


def weights(folder: Path) -> bytes:
    """All weights of the checkpoint."""
    return b"".join(np.asarray(x).tobytes() for x in jax.tree.leaves(checkpoint.load(folder)))


def main(kills: int = 20, steps: int = 150, seed: int = 0) -> None:
    """Run, compare, save."""
    luck, done = random.Random(seed), 0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "tiny.yaml").write_text(CONFIG)
        if start(folder, "whole", steps).wait():
            raise SystemExit("the run that is left alone failed")
        while done < kills:
            done += kill_soon(
                start(folder, "killed", steps), folder / "killed" / "metrics.jsonl", luck.uniform(0, 10.0)
            )
            left = steps - len(numbers(folder / "killed"))
            print(f"killed {done} times, {left} steps left", flush=True)
            if left <= 2:
                raise SystemExit("the run ended before it was killed often enough; give more --steps")
        if start(folder, "killed", steps).wait():
            raise SystemExit("the last resumption failed")
        same = {
            "metrics": numbers(folder / "killed") == numbers(folder / "whole"),
            "weights": weights(folder / "killed") == weights(folder / "whole"),
        }
    print(same)
    (HERE / "results").mkdir(exist_ok=True)
    record = {"kills": done, "steps": steps, "seed": seed, "commit": commit(), "same": same}
    (HERE / "results" / "kills.json").write_text(json.dumps(record, indent=1) + "\n")


if __name__ == "__main__":
    tyro.cli(main)
