"""One robot, live: ``python experiments/perf/live.py sizes [--metres 33 75]``, or ``... soak [--updates 100000]``.

Each size has processes of its own: the first finds an empty cache (cold), the second what the first compiled (warm),
and measures. Buildings are made, of blocks of at most 75 m that all differ, 0.2 m per cell; the lidar has 360 beams
and 25 m and sits 0.2 m in front of the axle, the filter is that of ``dsom_jax.REAL``. Processor time
counts all threads; on a machine that is used by others, too, it says more than the wall clock.
Goals: 33 m: median <= 10 ms and p99 <= 40 ms of processor time while localized, <= 120 ms while not, first answer
<= 20 s cold and <= 4 s warm, <= 400 MB; 150 m: <= 20 ms and <= 500 ms, <= 400 MB; 300 m: <= 1.5 GB.

``soak`` drives one log to and fro without end, and looks for memory that grows, latencies that drift, and numbers that
are not finite.
"""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from timing import machine, save

import dsom_jax as dj
from dsom_jax.data import se2
from dsom_jax.occupancy import OccupancyGrid

BLOCK, RESOLUTION = 75.0, 0.2
LIDAR = dj.LidarConfig(beams=360, range_max=25.0, mount=(0.2, 0.0, 0.0))
"""In front of the axle, as on most robots: every turn moves it."""
MEGABYTE = 1024.0
"""Kilobytes, in which Linux counts."""


def building(metres: float) -> OccupancyGrid:
    """Blocks side by side, all different; the robot's is the one at the origin."""
    side = max(1, round(metres / BLOCK))
    config = dj.simulate.WorldConfig(cells=round(metres / side / RESOLUTION), resolution=RESOLUTION)
    make = jax.jit(dj.simulate.make_world, static_argnums=1)
    rows = [[make(jax.random.key(side * i + j), config) for j in range(side)] for i in range(side)]
    occupied, free = (np.block([[np.asarray(getattr(g, part)) for g in row] for row in rows])
                      for part in ("occupied", "free"))  # fmt: skip
    return dj.from_cells(jnp.asarray(occupied), jnp.asarray(free), resolution=RESOLUTION)


def drive(metres: float, updates: int) -> dj.Episode:
    """A drive through the block at the origin; the rest of the building does not matter to it."""
    config = dj.DriveConfig(updates=(updates,), obstacles=10, removed=0, lidar=LIDAR)
    return dj.make_synthetic(0, building(min(metres, BLOCK)), config)[1]


def odometry_of(episode: dj.Episode) -> np.ndarray:
    """(T, 3) poses in an odometry frame that begins at zero."""
    poses = [np.zeros(3)]
    for motion in np.asarray(episode.odometry, np.float64)[1:]:
        poses.append(se2.compose(poses[-1], motion))
    return np.stack(poses)


def peak() -> float:
    """Greatest memory of this process so far, MB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / MEGABYTE


def one(metres: float, updates: int) -> None:
    """Print as JSON what one process took from the map to the first answer, and then for the drive."""
    saved = np.load(recording(metres))
    occupied, free, ranges, odometry, truth = (saved[n] for n in ("occupied", "free", "ranges", "odometry", "truth"))
    grid = dj.from_cells(jnp.asarray(occupied), jnp.asarray(free), resolution=RESOLUTION)
    before, begun, spent = peak(), time.perf_counter(), time.process_time()
    robot = dj.Localizer(grid, LIDAR)
    answers, wall, cpu = [], [], []
    for t in range(updates):
        wall_start, cpu_start = time.perf_counter(), time.process_time()
        robot.force()
        answers.append(robot.update(ranges[t], odometry[t], float(t)))
        wall.append(1e3 * (time.perf_counter() - wall_start))
        cpu.append(1e3 * (time.process_time() - cpu_start))
        if t == 0:
            first = {"first_s": time.perf_counter() - begun, "first_cpu_s": time.process_time() - spent}
    sure = np.array([a.localized for a in answers])
    off = np.hypot(*(np.array([a.pose for a in answers]) - truth[: len(answers)])[:, :2].T)
    result: dict[str, Any] = {**first, "before_mb": before, "peak_mb": peak(), "free_cells": int(free.sum())}
    result |= {"localized": float(sure.mean()), "error_m_median": float(np.median(off))}
    # The first update still warms up caches of the processor and of the allocator.
    later = np.arange(len(answers)) > 0
    for name, rows in (("localized", later & sure), ("not_localized", later & ~sure)):
        if rows.any():
            result[f"while_{name}"] = spread(np.array(wall)[rows], np.array(cpu)[rows])
    print(json.dumps(result))


def spread(wall: np.ndarray, cpu: np.ndarray) -> dict[str, float]:
    """Median and p99 of wall clock and processor time, ms."""
    return {
        f"{kind}_{name}_ms": float(np.percentile(values, share))
        for kind, values in (("wall", wall), ("cpu", cpu))
        for name, share in (("median", 50), ("p99", 99))
    }


FOLDER = Path(tempfile.gettempdir()) / "dsom-live-perf"


def recording(metres: float) -> Path:
    """File with a building and a drive through it: made by another process, so that its memory does not count."""
    return FOLDER / f"{metres:g}.npz"


def record(metres: float, updates: int) -> None:
    """Make the file."""
    FOLDER.mkdir(exist_ok=True)
    grid, episode = building(metres), drive(metres, updates)
    np.savez(recording(metres), occupied=grid.occupied, free=grid.free, ranges=episode.ranges,
             odometry=odometry_of(episode), truth=episode.poses)  # fmt: skip


def started(metres: float, updates: int, cache: str) -> dict[str, Any]:
    """What a process of its own measured."""
    command = [sys.executable, __file__, "one", "--metres", str(metres), "--updates", str(updates)]
    settings = {"DIR": cache, "MIN_COMPILE_TIME_SECS": "0", "MIN_ENTRY_SIZE_BYTES": "-1"}
    names = {"DIR": "JAX_COMPILATION_CACHE_DIR"}
    environment = os.environ | {names.get(k, f"JAX_PERSISTENT_CACHE_{k}"): v for k, v in settings.items()}
    done = subprocess.run(command, capture_output=True, text=True, env=environment)
    if done.returncode:
        return {"failed": done.stderr.strip().splitlines()[-1][:300]}
    return json.loads(done.stdout.splitlines()[-1])


def sizes(metres: tuple[float, ...] = (33.0, 75.0, 150.0, 300.0), updates: int = 60) -> None:
    """Measure buildings of these sides, print and save."""
    measured: dict[str, Any] = {}
    for side in metres:
        record(side, updates)
        with tempfile.TemporaryDirectory() as cache:
            cold, warm = started(side, 1, cache), started(side, updates, cache)
        measured[f"{side:g}"] = {"cold": cold, "warm": warm}
        print(line(side, cold, warm), flush=True)
    base = measured[f"{metres[0]:g}"]["warm"].get("while_localized", {}).get("cpu_median_ms")
    for result in measured.values():
        own = result["warm"].get("while_localized", {}).get("cpu_median_ms")
        result["cpu_median_ratio"] = own / base if own and base else None
    save("live", {"machine": machine(), "updates": updates, "sizes": measured})


def line(metres: float, cold: dict[str, Any], warm: dict[str, Any]) -> str:
    """One line of a report."""
    if "failed" in cold or "failed" in warm:
        return f"{metres:g} m: {cold.get('failed') or warm.get('failed')}"
    told = [f"first answer {cold['first_s']:.1f} s cold ({cold['first_cpu_s']:.1f} s of processor time), "
            f"{warm['first_s']:.1f} s warm ({warm['first_cpu_s']:.1f} s)"]  # fmt: skip
    for name in ("localized", "not_localized"):
        if part := warm.get(f"while_{name}"):
            told.append(f"while {name.replace('_', ' ')}: median {part['wall_median_ms']:.1f} ms, p99 "
                        f"{part['wall_p99_ms']:.1f} ms (processor {part['cpu_median_ms']:.1f}, "
                        f"{part['cpu_p99_ms']:.1f})")  # fmt: skip
    told.append(f"memory {warm['peak_mb']:.0f} MB, {warm['before_mb']:.0f} before")
    told.append(f"error {warm['error_m_median']:.2f} m, localized {warm['localized']:.0%}")
    return f"{metres:g} m, {warm['free_cells']} free cells: " + "; ".join(told)


def soak(updates: int = 100_000, metres: float = 33.0, block: int = 1000) -> None:
    """Drive one log to and fro, print one line for each block of updates, and save what grew."""
    record(metres, 60)
    saved = np.load(recording(metres))
    ranges, odometry = saved["ranges"], saved["odometry"]
    grid = dj.from_cells(jnp.asarray(saved["occupied"]), jnp.asarray(saved["free"]), resolution=RESOLUTION)
    robot = dj.Localizer(grid, LIDAR)
    there = np.arange(len(ranges))
    order = np.concatenate([there, there[-2:0:-1]])
    begun, bad, blocks = time.perf_counter(), 0, []
    ms: list[float] = []
    for n in range(updates):
        t = order[n % len(order)]
        robot.force()
        answer = robot.update(ranges[t], odometry[t], 0.1 * (n + 1))
        bad += not (np.isfinite(answer.pose).all() and np.isfinite(answer.covariance).all())
        ms.append(1e3 * answer.seconds)
        if len(ms) == block or n + 1 == updates:
            blocks.append({"updates": n + 1, "memory_mb": memory(), "median_ms": float(np.median(ms)),
                           "p99_ms": float(np.percentile(ms, 99)), "localized": answer.localized})  # fmt: skip
            print(blocks[-1], flush=True)
            ms = []
    first, last = blocks[min(1, len(blocks) - 1)], blocks[-1]
    result = {
        "updates": updates, "seconds": time.perf_counter() - begun, "not_finite": bad,
        "growth_mb": last["memory_mb"] - first["memory_mb"], "drift": last["median_ms"] / first["median_ms"],
    }  # fmt: skip
    print(result)
    save("live_soak", {"machine": machine(), **result, "blocks": blocks})


def memory() -> float:
    """Memory of this process now, MB."""
    fields = Path("/proc/self/status").read_text().split()
    return float(fields[fields.index("VmRSS:") + 1]) / MEGABYTE


if __name__ == "__main__":
    tyro.extras.subcommand_cli_from_dict({"sizes": sizes, "soak": soak, "one": one})
