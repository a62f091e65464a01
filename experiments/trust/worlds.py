"""Simulated drives in which something is wrong, to learn from: what a monitor sees, and whether the answer was right.

Every drive is one building, one robot and one fault; nothing here has seen a real log.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np

from dsom_jax.episode import Episode
from dsom_jax.lidar import LidarConfig, LidarNoise
from dsom_jax.occupancy import OccupancyGrid, from_cells
from dsom_jax.simulate.drive import DriveConfig, make_synthetic
from dsom_jax.simulate.worlds import WorldConfig, make_world

LIDARS = (
    LidarConfig(beams=180, angle_min=-np.pi / 2, angle_increment=np.pi / 180, range_max=25.0),
    LidarConfig(beams=360, angle_min=-np.pi, angle_increment=np.pi / 180, range_max=12.0),
)
FAULTS = (
    *["clean"] * 5, *["half"] * 4, *["changed"] * 3, *["symmetric"] * 3, *["wrong map"] * 3, *["yaw"] * 4,
    *["mirrored"] * 2, *["scaled"] * 2, *["increment"] * 2, *["odometry sign"] * 2, *["crowd"] * 4, *["glass"] * 2,
    "reset", "slip",
)  # fmt: skip
_YAWS = (10, 12, 15, 20, 45, 90, 135, 180)


@dataclass(frozen=True)
class Case:
    """One drive: the map and lidar that the filter believes in, and what was sensed."""

    fault: str
    grid: OccupancyGrid
    lidar: LidarConfig
    episode: Episode


def cases(seed: int, count: int) -> Iterator[Case]:
    """``count`` drives, faults and lidars in turn."""
    order = np.random.default_rng(seed).permutation(len(FAULTS))
    for n in range(count):
        yield case(1000 * seed + n, FAULTS[order[n % len(FAULTS)]], LIDARS[(n + n // len(FAULTS)) % 2])


def building(seed: int) -> OccupancyGrid:
    """A building of 25.6 m with cells of 0.1 m."""
    config = WorldConfig(cells=256, resolution=0.1, door_width=(0.9, 1.5))
    return jax.jit(make_world, static_argnums=1)(jax.random.key(seed), config)


def case(seed: int, fault: str, lidar: LidarConfig) -> Case:
    """The drive ``seed`` with a ``fault``."""
    rng = np.random.default_rng(seed)
    true = building(seed)
    if fault == "symmetric":
        true = twofold(true)
    sensed = lidar
    if fault == "yaw":
        yaw = np.radians(rng.choice(_YAWS) * rng.choice((-1, 1)))
        sensed = replace(lidar, mount=(0.0, 0.0, float(yaw)))
    if fault == "increment":
        increment = lidar.angle_increment * float(rng.choice((0.97, 1.03)))
        beams = min(lidar.beams, int(2 * np.pi / increment))
        sensed = replace(lidar, beams=beams, angle_increment=increment)
    many = fault == "changed"
    step = float(rng.choice((0.25, 0.4, 0.6)))
    drive = DriveConfig(
        updates=(35, 25), update_min_d=step, update_min_a=0.25, kidnap_distance=5.0, obstacles=25 if many else 4,
        removed=15 if many else 2, lidar=sensed, lidar_noise=LidarNoise(sigma=0.02),
    )  # fmt: skip
    _, episode = make_synthetic(seed, true, drive)
    grid = true
    if fault == "half":
        grid = half(rng, true)
    if fault == "wrong map":
        grid = building(seed + 500_000)
    ranges, odometry = spoil(rng, fault, np.asarray(episode.ranges), np.asarray(episode.odometry), lidar)
    return Case(fault, grid, lidar, episode._replace(ranges=jnp.asarray(ranges), odometry=jnp.asarray(odometry)))


def twofold(grid: OccupancyGrid) -> OccupancyGrid:
    """The lower half of a map and its half turn."""
    occupied, free = (np.array(cells) for cells in (grid.occupied, grid.free))
    rows = len(occupied) // 2
    for cells in (occupied, free):
        cells[rows:] = cells[:rows][::-1, ::-1]
    return from_cells(jnp.asarray(occupied), jnp.asarray(free), resolution=grid.resolution)


def fourfold(grid: OccupancyGrid) -> OccupancyGrid:
    """One quarter of a square map and its quarter turns."""
    occupied, free = (np.array(cells) for cells in (grid.occupied, grid.free))
    side = len(occupied) // 2
    for cells in (occupied, free):
        for turns in (1, 2, 3):
            corner = np.zeros_like(cells)
            corner[:side, :side] = cells[:side, :side]
            where = np.zeros_like(cells)
            where[:side, :side] = True
            cells[np.rot90(where, turns)] = np.rot90(corner, turns)[np.rot90(where, turns)]
    return from_cells(jnp.asarray(occupied), jnp.asarray(free), resolution=grid.resolution)


def half(rng: np.random.Generator, grid: OccupancyGrid) -> OccupancyGrid:
    """A map of which 30 to 60 % beyond a straight line is unknown."""
    free = np.asarray(grid.free)
    i, j = np.indices(free.shape)
    turn = rng.uniform(0, 2 * np.pi)
    along = np.cos(turn) * j + np.sin(turn) * i
    keep = along < np.quantile(along[free], rng.uniform(0.4, 0.7))
    return from_cells(np.asarray(grid.occupied) & keep, free & keep, resolution=grid.resolution)


def spoil(
    rng: np.random.Generator, fault: str, ranges: np.ndarray, odometry: np.ndarray, lidar: LidarConfig
) -> tuple[np.ndarray, np.ndarray]:
    """Scans (T, B) and odometry (T, 3) as a faulty robot would report them."""
    ranges, odometry = ranges.copy(), wheels(rng, odometry)
    if ranges.shape[1] < lidar.beams:  # a turn in fewer beams than the driver says
        missing = np.full((len(ranges), lidar.beams - ranges.shape[1]), np.nan, ranges.dtype)
        ranges = np.concatenate([ranges, missing], 1)
    if fault == "mirrored":
        ranges = ranges[:, ::-1]
    if fault == "scaled":
        ranges = ranges * np.float32(rng.choice((0.8, 0.9, 1.1, 1.2)))
    if fault == "odometry sign":
        odometry[:, 2] *= -1
    if fault == "crowd":
        hidden = sectors(rng, ranges.shape, np.radians(15), lidar, rng.choice((0.2, 0.4, 0.6)))
        before = np.where(hidden > 0, 0.5 + 2.5 * hidden, np.inf) + rng.normal(0, 0.05, ranges.shape)
        ranges = np.minimum(ranges, before).astype(np.float32)
    if fault == "glass":
        hidden = sectors(rng, ranges.shape, np.radians(5), lidar, rng.choice((0.3, 0.5)))
        deeper = rng.random(ranges.shape) < 0.5
        ranges = np.where(hidden > 0, np.where(deeper, np.inf, ranges + 3 * hidden), ranges).astype(np.float32)
    if fault == "reset":
        for t in range(15, len(odometry), 20):
            odometry[t] = rng.normal(0, (5.0, 5.0, 1.5))
    if fault == "slip":
        for t in range(10, len(odometry), 20):
            odometry[t : t + 6, :2] *= rng.uniform(0.2, 1.8)
    return ranges, odometry


def wheels(rng: np.random.Generator, odometry: np.ndarray) -> np.ndarray:
    """Increments (T, 3) of wheels that are not as large as their driver thinks, nor equally large, on a rough floor."""
    odometry = odometry.copy()
    travel = np.hypot(*odometry[:, :2].T)
    odometry[:, :2] *= 1 + rng.normal(0, 0.03)
    odometry[:, 2] = odometry[:, 2] * (1 + rng.normal(0, 0.05)) + rng.normal(0, np.radians(4)) * travel
    rough = rng.choice((0.0, 0.03, 0.06))
    odometry[1:, :2] += rng.normal(0, rough, (len(odometry) - 1, 2)) * np.sqrt(travel[1:, None])
    odometry[1:, 2] += rng.normal(0, np.radians(60 * rough), len(odometry) - 1) * np.sqrt(travel[1:])
    return odometry


def sectors(
    rng: np.random.Generator, shape: tuple[int, int], width: float, lidar: LidarConfig, share: float
) -> np.ndarray:
    """(T, B) 0 for most beams, a number in (0, 1] that a whole sector shares for ``share`` of them."""
    beams = max(1, round(width / abs(lidar.angle_increment)))
    count = -(-shape[1] // beams) + 1
    drawn = np.where(rng.random((shape[0], count)) < share, rng.uniform(0.01, 1, (shape[0], count)), 0.0)
    return np.repeat(drawn, beams, axis=1)[:, : shape[1]]
