"""What the speed experiments share: medians of several calls, the machine they ran on, and where results go.

On a machine that others use too, wall clock says little; processor time shared out over the cores is then the better
guess at what an idle machine would take, as far as the work is spread over them. Both are reported.
"""

from __future__ import annotations

import json
import os
import platform
import statistics
import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax

RESULTS = Path(__file__).parent / "results"


def measure(call: Callable[[], Any], repeats: int = 9) -> dict[str, float]:
    """Milliseconds of one ``call`` after a first one that compiles.

    ``wall_ms`` and ``wall_min_ms`` are median and minimum of the wall clock; ``cpu_ms`` is the median processor time
    of all threads, divided by the number of cores.
    """
    jax.block_until_ready(call())
    wall, cpu = [], []
    for _ in range(repeats):
        wall_start, cpu_start = time.perf_counter(), time.process_time()
        jax.block_until_ready(call())
        wall.append(1e3 * (time.perf_counter() - wall_start))
        cpu.append(1e3 * (time.process_time() - cpu_start) / cores())
    return {"wall_ms": statistics.median(wall), "wall_min_ms": min(wall), "cpu_ms": statistics.median(cpu)}


def cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def machine() -> dict[str, Any]:
    """Where, when busy with how much else, and with which code the numbers were taken."""
    return {
        "processor": _processor(),
        "cores": cores(),
        "load_average": [round(v, 2) for v in os.getloadavg()],
        "python": platform.python_version(),
        "jax": jax.__version__,
        "device": f"{jax.device_count()} x {jax.devices()[0].device_kind}",
        "commit": commit(),
    }


def commit() -> str:
    """Commit of the working tree, marked where the package differs from it."""
    git = ["git", "-C", str(Path(__file__).parents[2])]
    try:
        head = subprocess.run([*git, "rev-parse", "HEAD"], capture_output=True, text=True, check=True).stdout.strip()
        changed = subprocess.run([*git, "status", "--porcelain", "--", "src"], capture_output=True, text=True).stdout
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return head + ("+" if changed.strip() else "")


def save(name: str, data: dict[str, Any]) -> None:
    """Write ``results/NAME.json``."""
    RESULTS.mkdir(exist_ok=True)
    path = RESULTS / f"{name}.json"
    path.write_text(json.dumps(data, indent=2) + "\n")
    print(
        f"written to {path.relative_to(Path(__file__).parents[2])}; load average {data['machine']['load_average'][0]}"
    )


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    return next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), platform.machine())
