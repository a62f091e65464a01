"""Single scans in buildings that differ from their map in one way or another. All numbers of a change are traced."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.ndimage import map_coordinates
from symmetric import off_middle, symmetric

from dsom_jax.evaluate import narrowed
from dsom_jax.lidar import LidarConfig, LidarNoise, apply_limits, observe
from dsom_jax.occupancy import OccupancyGrid
from dsom_jax.raycast import RaycastConfig, cast_rays, make_tables
from dsom_jax.simulate.morphology import clear_of, components, grow
from dsom_jax.simulate.obstacles import add_obstacles, remove_structure
from dsom_jax.simulate.worlds import WorldConfig, make_world
from dsom_jax.training.batches import PLAIN
from dsom_jax.training.buildings import random_poses
from dsom_jax.types import Array, Key

WORLD = WorldConfig()
BARE = replace(WORLD, furniture=0.0, pillars=0.0, shelves=0.0)
MOST = {"obstacles": 320, "gone": 160, "landmarks": 16}
"""Largest numbers of what is put in or taken out."""
WAVE = 15.0
"""Metres over which walls that stand elsewhere are pushed one way and back again."""
SIGMA = 0.02
"""Noise of the ranges, metres."""
GAP = 2
"""Passages of up to twice as many cells count as doors: 1.3 m."""
CONTRADICTS = 0.3
"""A beam contradicts the map if it ends this far from where the map says, metres."""


class Change(NamedTuple):
    """How the building and the scan differ from the map and the lidar; one number each, traced while scans are taken.

    Attributes:
        obstacles: unknown boxes and discs of 0.3 to 1 m.
        gone: pieces of mapped structure, 0.7 to 2.5 m, that are not there.
        moved: metres (r.m.s.) that walls stand elsewhere than mapped.
        closed: share of the doors (gaps of up to 1.3 m) that are shut.
        scale: factor on the ranges.
        deep: metres that beams end behind the mapped face of walls.
        short: share of the beams that something returns early.
    """

    obstacles: Any = 20
    gone: Any = 0
    moved: Any = 0.0
    closed: Any = 0.0
    scale: Any = 1.0
    deep: Any = 0.0
    short: Any = 0.0


@dataclass(frozen=True)
class Condition:
    """One point of a curve.

    Attributes:
        change: of building and scan.
        fov: degrees; range_max: metres: of the lidar, which every proposal knows.
        bare: the map shows walls only.
        drawn: the likelihood grid is told that the map is a floor plan.
        landmarks: None, or the number of mapped things that break the symmetry of a building that looks the same from
            two poses.
    """

    change: Change = Change()
    fov: float = 360.0
    range_max: float = 10.0
    bare: bool = False
    drawn: bool = False
    landmarks: int | None = None

    @property
    def lidar(self) -> LidarConfig:
        """Beams of one degree."""
        return replace(narrowed(PLAIN.lidar, self.fov), range_max=self.range_max)

    @property
    def shown(self) -> tuple[bool, int | None]:
        """What the map depends on."""
        return self.bare, self.landmarks


class Scans(NamedTuple):
    """Scans (S, B) in one building, their poses (S, 3) on the map, and the share of beams that contradict the map."""

    ranges: Array
    poses: Array
    contradicting: Array


@partial(jax.jit, static_argnames="config")
def building(key: Key, config: WorldConfig) -> OccupancyGrid:
    """A procedural building that no training draws."""
    return make_world(key, config)


def map_and_building(key: Key, condition: Condition) -> tuple[OccupancyGrid, OccupancyGrid]:
    """What the map shows, and what there is before anything is changed; by ``condition.shown`` alone."""
    k_world, k_landmarks = jax.random.split(key)
    world = building(k_world, WORLD)
    if condition.landmarks is None:
        return (building(k_world, BARE) if condition.bare else world), world
    world = marked(k_landmarks, symmetric(world, 2), condition.landmarks)
    return world, world


@jax.jit
def marked(key: Key, grid: OccupancyGrid, count: Array) -> OccupancyGrid:
    """The building with ``count`` things put in one half of it; more things keep the fewer ones where they are."""
    half = grid.free & (jnp.arange(grid.shape[0]) < grid.shape[0] // 2)[:, None]
    return add_obstacles(key, grid, count, max_count=MOST["landmarks"], sizes=(0.7, 2.0), where=half)


def take(key: Key, shown: OccupancyGrid, world: OccupancyGrid, condition: Condition, count: int) -> Scans:
    """``count`` scans of the building changed."""
    apart = 2.5 if condition.landmarks is not None else 0.0
    change = Change(*map(jnp.float32, condition.change))
    scans = _take(key, shown, world, change, jnp.float32(apart), count)
    lidar = condition.lidar
    first = (PLAIN.beams - lidar.beams + 1) // 2
    ranges = apply_limits(scans.ranges[:, first : first + lidar.beams], lidar)
    return scans._replace(ranges=ranges)


@partial(jax.jit, static_argnames="count")
def _take(key: Key, shown: OccupancyGrid, world: OccupancyGrid, change: Change, apart: Array, count: int) -> Scans:
    keys = jax.random.split(key, 6)
    shift = displacement(keys[0], change.moved)
    seen = pushed(world, shift)
    seen = remove_structure(keys[1], seen, change.gone, max_count=MOST["gone"])
    seen = shut(keys[2], seen, change.closed)
    seen = add_obstacles(keys[3], seen, change.obstacles, max_count=MOST["obstacles"])
    stand = seen.free & shown.free & off_middle(seen, apart)
    here = random_poses(keys[4], stand, seen.resolution, count)
    # Where on the map the robot is: what stands around it is mapped there.
    x, y = shift(here[:, 0], here[:, 1])
    there = here.at[:, 0].add(x).at[:, 1].add(y)
    clean, promised = (_cast(grid, poses) for grid, poses in ((seen, here), (shown, there)))
    noise = LidarNoise(SIGMA, short=change.short)
    ranges = observe(keys[5], (clean + change.deep) * change.scale, PLAIN.lidar, noise)
    wrong = jnp.abs(jnp.minimum(clean, PLAIN.range_max) - jnp.minimum(promised, PLAIN.range_max)) > CONTRADICTS
    return Scans(ranges, shown.from_grid(there), wrong.mean(-1))


def _cast(grid: OccupancyGrid, local: Array) -> Array:
    """Ranges (S, B) of the full lidar at poses (S, 3) of the grid's own frame."""
    return cast_rays(make_tables(grid, RaycastConfig("exact"), PLAIN.range_max), grid.from_grid(local), PLAIN.lidar)


def displacement(key: Key, metres: Array) -> jax.tree_util.Partial:
    """(x, y) in metres -> displacement in x and in y: a wave each, in a random direction, ``metres`` r.m.s. in all."""
    angles, phases = 2 * math.pi * jax.random.uniform(key, (2, 2))

    def shift(x: Array, y: Array) -> tuple[Array, Array]:
        wave = [metres * jnp.sin(2 * math.pi / WAVE * (jnp.cos(a) * x + jnp.sin(a) * y) + p)
                for a, p in zip(angles, phases, strict=True)]  # fmt: skip
        return wave[0], wave[1]

    return jax.tree_util.Partial(shift)


def pushed(grid: OccupancyGrid, shift: jax.tree_util.Partial) -> OccupancyGrid:
    """The building whose place p holds what the map has at p + shift(p)."""
    i, j = jnp.indices(grid.shape).astype(jnp.float32)
    x, y = shift((j + 0.5) * grid.resolution, (i + 0.5) * grid.resolution)
    source = jnp.stack([i + y / grid.resolution, j + x / grid.resolution])

    def sampled(cells: Array) -> Array:
        return map_coordinates(cells.astype(jnp.float32), list(source), order=1, cval=0.0)

    # Low enough that walls of one cell have no holes where the building is pressed together.
    occupied = sampled(grid.occupied) > 0.3
    return replace(grid, occupied=occupied, free=(sampled(grid.free) > 0.7) & clear_of(occupied))


def shut(key: Key, grid: OccupancyGrid, share: Array) -> OccupancyGrid:
    """The building with ``share`` of its narrow passages walled up."""
    closed = ~grow(~grow(grid.occupied, GAP), GAP) & ~grid.occupied
    labels = components(closed)
    chosen = closed & (jax.random.uniform(key, (closed.size + 1,))[labels] < share)
    occupied = grid.occupied | chosen
    return replace(grid, occupied=occupied, free=grid.free & clear_of(occupied))


def beams_of(scans: list[Scans]) -> float:
    """Mean share of beams that contradict the map."""
    return float(np.mean([np.asarray(s.contradicting) for s in scans]))
