"""Speed and accuracy of ray casting: ``python experiments/perf/raycast.py [--repeats 15]``.

Reference load: 100 runs x 200 poses x 72 beams on a 128 x 128 map of synthetic-v1 (1/3 m per cell, 10 m range), poses
uniform over free space. The table is held against exact rays from the same poses; a ray that returns in one of the two
only counts as returning from the end of the range in the other. Goals: table >= 200, exact >= 20 million rays/s.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from timing import machine, measure, save

from dsom_jax.compiling import run_options
from dsom_jax.data.suite import load_suite
from dsom_jax.filters.settings import Settings, table_for
from dsom_jax.lidar import LidarConfig
from dsom_jax.occupancy import OccupancyGrid
from dsom_jax.proposals.uniform import free_space
from dsom_jax.raycast import RaycastConfig, cast_rays, make_tables

RUNS, POSES, BEAMS = 100, 200, 72
CONFIGS = {
    "exact": RaycastConfig("exact"),
    "table": RaycastConfig("table"),
    "table_as_used": table_for(1 / 3, Settings().raycast),
}
"""The last one is that of the benchmark's filters."""


def main(repeats: int = 15) -> None:
    """Measure, print and save."""
    suite = load_suite("synthetic-v1")
    _, grid, _ = suite.episodes[0]
    lidar = suite.lidar.every(suite.lidar.beams // BEAMS)
    poses = free_space(grid).sample(jax.random.key(0), None, RUNS * POSES)[0].reshape(RUNS, POSES, 3)
    speeds, ranges = {}, {}
    for method, config in CONFIGS.items():
        speeds[method], ranges[method] = cast(grid, lidar, poses, config, repeats)
        rate = f"{speeds[method]['rays_per_s_wall'] / 1e6:7.1f} M rays/s by wall clock (median)"
        guess = f"{speeds[method]['rays_per_s_cpu'] / 1e6:7.1f} by processor time"
        print(f"{method:13}  {speeds[method]['wall_ms']:7.2f} ms  {rate}  {guess}")
    tables = [method for method in CONFIGS if method != "exact"]
    errors = {
        f"{method}_against_exact": accuracy(ranges[method], ranges["exact"], lidar.range_max) for method in tables
    }
    for what, error in errors.items():
        print(f"{what}: " + ", ".join(f"{name} {value:.4g}" for name, value in error.items()))
    load = {"rays": poses[..., 0].size * lidar.beams, "map": list(grid.shape), "resolution": grid.resolution}
    load |= {"range_max": lidar.range_max, "repeats": repeats}
    save("raycast", {"machine": machine(), "load": load, "methods": speeds, **errors})


def cast(
    grid: OccupancyGrid, lidar: LidarConfig, poses: jax.Array, config: RaycastConfig, repeats: int
) -> tuple[dict[str, float], np.ndarray]:
    """Times of one method, and its ranges (R, N, B)."""
    build = partial(make_tables, grid, config, lidar.range_max)
    tables = build()
    call = jax.jit(cast_rays, static_argnums=2, compiler_options=run_options())
    times = measure(lambda: call(tables, poses, lidar), repeats)
    rays = poses[..., 0].size * lidar.beams
    rates = {f"rays_per_s_{kind}": 1e3 * rays / times[f"{kind}_ms"] for kind in ("wall", "cpu")}
    tables_ms = measure(build, 3)["wall_ms"]
    return times | rates | {"make_tables_ms": tables_ms}, np.asarray(call(tables, poses, lidar))


def accuracy(table: np.ndarray, exact: np.ndarray, range_max: float) -> dict[str, Any]:
    """Distribution of the absolute differences, metres."""
    off = np.abs(np.minimum(table, range_max) - np.minimum(exact, range_max))
    return {
        "median_m": float(np.median(off)),
        "mean_m": float(off.mean()),
        "p95_m": float(np.quantile(off, 0.95)),
        "share_off_0.5_m": float((off > 0.5).mean()),
        "share_return_differs": float((np.isinf(table) != np.isinf(exact)).mean()),
        "signed_mean_m": float(jnp.mean(jnp.minimum(table, range_max) - jnp.minimum(exact, range_max))),
    }


if __name__ == "__main__":
    tyro.cli(main)
