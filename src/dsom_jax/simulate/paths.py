"""Paths that a robot could drive, planned on the host: random goals, shortest paths with clearance, smoothed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

from dsom_jax.errors import UserError
from dsom_jax.occupancy import OccupancyGrid, from_cells, resample

PLANNING_RESOLUTION = 0.15
"""Finer maps are planned on at this many metres per cell."""

ROBOT_RADIUS = 0.3
"""Least distance from the robot to the centre of an occupied cell, metres."""


@dataclass(frozen=True)
class Roads:
    """Where a robot may drive; positions are metres in the grid's own frame.

    Attributes:
        free: (H, W) bool, the largest 4-connected part of the free cells.
        cells: (N, 2) the free cells (i, j).
        graph: (N, N) sparse cost of the moves between neighbouring cells; near walls they cost more.
        resolution: metres per cell.
    """

    free: np.ndarray
    cells: np.ndarray
    graph: coo_array
    resolution: float

    def centres(self) -> np.ndarray:
        """(N, 2) positions (x, y) of the cells."""
        return (self.cells[:, ::-1] + 0.5) * self.resolution

    def is_free(self, points: np.ndarray) -> np.ndarray:
        """(n,) bool, whether the robot may stand at points (n, 2)."""
        j, i = np.floor(points / self.resolution).astype(int).T
        height, width = self.free.shape
        on_map = (i >= 0) & (i < height) & (j >= 0) & (j < width)
        return on_map & self.free[np.clip(i, 0, height - 1), np.clip(j, 0, width - 1)]


def roads(grid: OccupancyGrid) -> Roads:
    """Roads of a map."""
    occupied, free, resolution = _planning_cells(grid)
    clearance = ndimage.distance_transform_edt(~occupied) * resolution
    labels, count = ndimage.label(free & (clearance >= ROBOT_RADIUS))
    if not count:
        raise UserError(f"the map has no free cell {ROBOT_RADIUS} m from a wall to drive on; check its thresholds")
    free = labels == 1 + np.argmax(np.bincount(labels.ravel())[1:])
    return Roads(free, np.argwhere(free), _graph(free, clearance, resolution), resolution)


def _planning_cells(grid: OccupancyGrid) -> tuple[np.ndarray, np.ndarray, float]:
    """Occupied and free cells (H, W) to plan on, and metres per cell; a coarse cell is free if all of it is."""
    if grid.resolution >= PLANNING_RESOLUTION:
        return np.asarray(grid.occupied), np.asarray(grid.free), grid.resolution
    coarse = resample(grid, PLANNING_RESOLUTION)
    barred = resample(from_cells(~grid.free, resolution=grid.resolution), PLANNING_RESOLUTION).occupied
    return np.asarray(coarse.occupied), ~np.asarray(barred), PLANNING_RESOLUTION


def _graph(free: np.ndarray, clearance: np.ndarray, resolution: float) -> coo_array:
    """Costs between 8-neighbours; diagonal moves only where both cells beside them are free."""
    number = np.full(free.shape, -1)
    number[free] = np.arange(free.sum())
    # Half a metre from a wall costs about twice as much as the middle of a hall.
    dear = 1 + 3 * np.exp(-clearance / 0.5)
    padded, costs = np.pad(number, 1, constant_values=-1), []
    i, j = np.nonzero(free)
    for di, dj in ((0, 1), (1, 0), (1, 1), (1, -1)):
        there = padded[i + 1 + di, j + 1 + dj]
        allowed = (there >= 0) & (padded[i + 1 + di, j + 1] >= 0) & (padded[i + 1, j + 1 + dj] >= 0)
        a, b = number[i, j][allowed], there[allowed]
        costs.append((a, b, np.hypot(di, dj) * resolution * (dear[free][a] + dear[free][b]) / 2))
    rows, columns, values = (np.concatenate(part) for part in zip(*costs, strict=True))
    n = int(free.sum())
    return coo_array((np.r_[values, values], (np.r_[rows, columns], np.r_[columns, rows])), shape=(n, n)).tocsr()


def shortest_path(roads: Roads, start: int, goal: int) -> np.ndarray:
    """(n, 2) positions of the cells of the cheapest path from cell ``start`` to cell ``goal``."""
    _, before = dijkstra(roads.graph, indices=start, return_predecessors=True)
    path = [goal]
    while path[-1] != start:
        path.append(int(before[path[-1]]))
    return roads.centres()[path[::-1]]


def smooth(roads: Roads, path: np.ndarray, step: float = 0.05) -> np.ndarray:
    """The path (n, 2) every ``step`` metres, rounded as far as it stays on free cells; its ends stay."""
    lengths = np.r_[0, np.cumsum(np.hypot(*np.diff(path, axis=0).T))]
    ticks = np.linspace(0, lengths[-1], max(2, int(np.ceil(lengths[-1] / step)) + 1))
    dense = np.stack([np.interp(ticks, lengths, axis) for axis in path.T], axis=1)
    for sigma in (0.8, 0.4, 0.2, 0.1):
        rounded = _average(dense, sigma / step)
        if roads.is_free(rounded).all():
            return rounded
    return dense


def _average(points: np.ndarray, sigma: float) -> np.ndarray:
    """Gaussian average along the path; mirrored at its ends so that they stay."""
    reach = int(4 * sigma)
    before, after = 2 * points[0] - points[1 : reach + 1][::-1], 2 * points[-1] - points[-reach - 1 : -1][::-1]
    whole = ndimage.gaussian_filter1d(np.concatenate([before, points, after]), sigma, axis=0, mode="nearest")
    return whole[len(before) : len(before) + len(points)]


def drive(roads: Roads, rng: np.random.Generator, start: int, updates: int, step: tuple[float, float]) -> np.ndarray:
    """(updates, 3) poses of a drive from cell ``start`` through random goals, an update each ``step`` (m, rad).

    Headings follow the path; at each goal the robot turns in place towards the next one, at times once around.
    """
    poses = np.array([[*roads.centres()[start], rng.uniform(-np.pi, np.pi)]])
    kept = poses
    here = start
    while len(kept) < updates:
        goal = _next_goal(roads, rng, here)
        poses = np.concatenate([poses, _leg(smooth(roads, shortest_path(roads, here, goal)), poses[-1, 2], rng)])
        here, kept = goal, poses[_thin(poses, step)]
    kept = kept[:updates].copy()
    kept[:, 2] = (kept[:, 2] + np.pi) % (2 * np.pi) - np.pi
    return kept


def _next_goal(roads: Roads, rng: np.random.Generator, here: int) -> int:
    """A random cell at least 6 m away, or among the farthest tenth where the map is smaller."""
    away = np.hypot(*(roads.centres() - roads.centres()[here]).T)
    if away.max() == 0:
        raise UserError("the map has a single free cell: there is nowhere to drive to; check its free space")
    return int(rng.choice(np.flatnonzero(away >= min(6.0, np.quantile(away, 0.9)))))


def _leg(points: np.ndarray, heading: float, rng: np.random.Generator) -> np.ndarray:
    """(n, 3) dense poses: a turn in place from ``heading`` into the path (m, 2), then along it; angles unwrapped."""
    directions = np.unwrap(np.arctan2(*np.diff(points, axis=0).T[::-1]))
    first = heading + (directions[0] - heading + np.pi) % (2 * np.pi) - np.pi
    if rng.uniform() < 0.15:
        first += rng.choice([-1, 1]) * 2 * np.pi
    turning = np.linspace(heading, first, max(2, int(abs(first - heading) / 0.05)))
    turn = np.column_stack([np.tile(points[0], (len(turning), 1)), turning])
    return np.concatenate([turn, np.column_stack([points[1:], directions + first - directions[0]])])


def _thin(poses: np.ndarray, step: tuple[float, float]) -> list[int]:
    """Indices of the updates: the first pose, then each that is ``step`` metres or radians of travel further."""
    used, travel, turned = [0], 0.0, 0.0
    moves = np.hypot(*np.diff(poses[:, :2], axis=0).T)
    for n, (moved, turn) in enumerate(zip(moves, np.diff(poses[:, 2]), strict=True), start=1):
        travel, turned = travel + moved, turned + turn
        if travel >= step[0] or abs(turned) >= step[1]:
            used.append(n)
            travel, turned = 0.0, 0.0
    return used
