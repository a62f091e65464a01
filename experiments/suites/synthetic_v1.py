"""Generates the frozen suite synthetic-v1: ``python experiments/suites/synthetic_v1.py [FILE.npz]``.

Twenty buildings of 43 m x 43 m, 18 to train on and 2 that no training may see; 6 drives through the 2, each of 70
updates, a kidnapping, and 70 more, with 20 unknown obstacles and 4 pieces of structure removed along the path.
The seeds were chosen by looking at the maps, so that all kinds of buildings occur, before any method had run on them.
"""

from __future__ import annotations

import sys
from pathlib import Path

import jax

from dsom_jax.data.suite import Suite, save_suite
from dsom_jax.occupancy import OccupancyGrid
from dsom_jax.simulate.drive import DriveConfig, make_synthetic
from dsom_jax.simulate.worlds import WorldConfig, make_world

WORLD = WorldConfig(cells=128)
DRIVE = DriveConfig()
TRAIN_SEEDS = (1, 3, 4, 6, 7, 8, 11, 14, 16, 18, 19, 21, 23, 25, 36, 37, 38, 43)
TEST_SEEDS = (9, 31)
DRIVE_SEEDS = (1, 2, 3)
FROZEN = Path(__file__).parents[2] / "src" / "dsom_jax" / "suites" / "synthetic-v1.npz"


def building(seed: int) -> OccupancyGrid:
    """The map of a seed."""
    return jax.jit(make_world, static_argnums=1)(jax.random.key(seed), WORLD)


def build() -> Suite:
    """The whole suite."""
    train = tuple(building(seed) for seed in TRAIN_SEEDS)
    tests = {f"test-{n}": (seed, building(seed)) for n, seed in enumerate(TEST_SEEDS)}
    episodes = tuple(
        (name, grid, make_synthetic(100 * seed + drive, grid, DRIVE)[1])
        for name, (seed, grid) in tests.items()
        for drive in DRIVE_SEEDS
    )
    return Suite("synthetic-v1", DRIVE.lidar, train, episodes)


if __name__ == "__main__":
    target = Path(sys.argv[1]) if len(sys.argv) > 1 else FROZEN
    save_suite(target, build())
    print(f"{target}: {target.stat().st_size / 1e6:.2f} MB")
