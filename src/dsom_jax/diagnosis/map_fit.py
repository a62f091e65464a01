"""Scans against the map: where pieces of the drive lie on it, and under which geometry of the scans they fit.

A piece of the drive, its scans put together by what the scans themselves say of the motion, is held against the map at
every place and heading by FFT, as it is and mirrored and scaled. Whether the best places are right is asked of the
scans that follow and took no part in the search. Then range scale and angle increment are refined with all poses.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from scipy import fft, ndimage

from dsom_jax.data import se2
from dsom_jax.diagnosis.matching import thinned, transform
from dsom_jax.occupancy import OccupancyGrid

_REACH = 15.0
"""Metres of each reading's beam that are looked at."""
NEAR = 0.3
"""A reading within so many metres of what the map predicts agrees; half a metre beyond, it goes through a wall."""
COARSE_CELLS, HEADINGS = 180, 72


class Piece(NamedTuple):
    """Consecutive scans of one block in the frame of its first sensor pose.

    Attributes:
        scans: (n,) indices into the log.
        poses: (n, 3) of the sensor.
        searched: the first so many scans are searched for, the others only asked.
    """

    scans: np.ndarray
    poses: np.ndarray
    searched: int


class MapFit(NamedTuple):
    """How scans at known poses agree with the map.

    Attributes:
        agree: (n,) share of each scan's readings within ``NEAR`` of what the map predicts.
        through: (n,) share of its beams that go through a wall of the map.
    """

    agree: np.ndarray
    through: np.ndarray


@dataclass(frozen=True)
class Geometry:
    """What is assumed of scans: mirrored or not, ranges times ``scale``, bearings about the middle times ``spread``."""

    mirrored: bool = False
    scale: float = 1.0
    spread: float = 1.0


class Place(NamedTuple):
    """Where a piece lies: poses (n, 3) of the sensor in the grid's frame, and how its scans agree there."""

    piece: Piece
    poses: np.ndarray
    fit: MapFit

    @property
    def score(self) -> float:
        """Agreement of the scans that took no part in the search, less the beams through walls."""
        rest = slice(min(self.piece.searched, len(self.poses) - 1), None)
        return float(np.mean(self.fit.agree[rest] - self.fit.through[rest]))


class MapField:
    """Distances to the walls of a map, fine and coarse. All positions are in the grid's own frame, metres."""

    def __init__(self, grid: OccupancyGrid) -> None:
        occupied, free = np.asarray(grid.occupied), np.asarray(grid.free)
        self.resolution, self.shape = grid.resolution, occupied.shape
        self.distance = cv2.distanceTransform((~occupied).astype(np.uint8), cv2.DIST_L2, 5) * grid.resolution
        self.occupied = occupied
        self.cell = max(0.2, grid.resolution, max(grid.size) / COARSE_CELLS)
        self.near = self._coarse(np.exp(-0.5 * (np.minimum(self.distance, 2) / (0.75 * self.cell)) ** 2))
        self.wall = self._coarse(np.exp(-0.5 * (np.minimum(self.distance, 1) / 0.1) ** 2))
        self.stand = ndimage.binary_dilation(self._coarse(free.astype(np.float32)) > 0.2)

    def _coarse(self, picture: np.ndarray) -> np.ndarray:
        size = [max(1, round(n * self.resolution / self.cell)) for n in self.shape]
        return cv2.resize(picture.astype(np.float32), size[::-1], interpolation=cv2.INTER_AREA)

    def at(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Distance (n,) to the nearest wall at points (n, 2), and its gradient (n, 2); far away off the map."""
        x, y = (points / self.resolution - 0.5).T
        inside = (x >= 0) & (y >= 0) & (x < self.shape[1] - 1) & (y < self.shape[0] - 1)
        j, i = (np.where(inside, np.floor(v), 0).astype(int) for v in (x, y))
        u, v = np.where(inside, x - j, 0), np.where(inside, y - i, 0)
        a, b, c, d = (self.distance[i + p, j + q] for p, q in ((0, 0), (0, 1), (1, 0), (1, 1)))
        value = (1 - v) * ((1 - u) * a + u * b) + v * ((1 - u) * c + u * d)
        slope = np.stack([(1 - v) * (b - a) + v * (d - c), (1 - u) * (c - a) + u * (d - b)], -1) / self.resolution
        return np.where(inside, value, 99.0), np.where(inside[:, None], slope, 0.0)

    def cast(self, origins: np.ndarray, headings: np.ndarray, reach: float) -> np.ndarray:
        """Ranges (n,) to the first wall from ``origins`` (n, 2) along ``headings`` (n,); inf beyond ``reach``."""
        along = np.column_stack([np.cos(headings), np.sin(headings)])
        travelled, hit = np.zeros(len(origins)), np.zeros(len(origins), bool)
        for _ in range(int(2 * reach / self.resolution)):
            going = np.flatnonzero(~hit & (travelled < reach))
            if not len(going):
                break
            cells = np.floor((origins[going] + travelled[going, None] * along[going]) / self.resolution).astype(int)
            outside = ((cells < 0) | (cells >= self.shape[::-1])).any(1)
            j, i = np.where(outside[:, None], 0, cells).T
            hit[going] = ~outside & self.occupied[i, j]
            # From anywhere in a cell the wall is at least its distance less one and a half cells away.
            free = np.maximum(self.distance[i, j] - 1.5 * self.resolution, 0.5 * self.resolution)
            travelled[going] += np.where(hit[going], 0, np.where(outside, 0.5 * self.resolution, free))
        return np.where(hit, travelled, np.inf)


class Thinned(NamedTuple):
    """Readings (n, b) and their bearings (b,) in the frame of the sensor, thinned to a number of beams."""

    ranges: np.ndarray
    angles: np.ndarray

    def under(self, geometry: Geometry) -> Thinned:
        """The same scans if the geometry is what was assumed wrongly."""
        middle = (self.angles[0] + self.angles[-1]) / 2
        angles = middle + geometry.spread * (self.angles - middle)
        return Thinned(self.ranges * np.float32(geometry.scale), -angles if geometry.mirrored else angles)

    def points(self, n: int, reach: float = _REACH) -> np.ndarray:
        """Returns (k, 2) of scan n in the frame of the sensor."""
        used = np.isfinite(self.ranges[n]) & (self.ranges[n] < reach)
        return self.ranges[n, used, None] * np.column_stack([np.cos(self.angles[used]), np.sin(self.angles[used])])


def under(piece: Piece, geometry: Geometry) -> Piece:
    """The piece as it is if the scans have another geometry: the motion was read off them."""
    signs = np.array([1, -1, -1]) if geometry.mirrored else np.ones(3)
    return piece._replace(poses=piece.poses * signs * [geometry.scale, geometry.scale, 1])


def submap(piece: Piece, scans: Thinned) -> tuple[np.ndarray, np.ndarray]:
    """Hits and swept free space of the searched part, each place once: (h, 2), (f, 2) in the frame of the piece."""
    hits, swept = [], []
    for n, pose in zip(piece.scans[: piece.searched], piece.poses, strict=False):
        points = scans.points(n)
        hits.append(transform(pose, points))
        length = np.hypot(*points.T)
        for depth in np.arange(0.5, _REACH, 0.5):
            beyond = length > depth + 0.4
            swept.append(transform(pose, points[beyond] * (depth / length[beyond])[:, None]))
    return thinned(np.concatenate(hits), 0.2), thinned(np.concatenate(swept), 0.4)


def search(field: MapField, hits: np.ndarray, swept: np.ndarray, count: int) -> list[np.ndarray]:
    """The ``count`` best poses (3,) of a submap's frame over the whole map and all headings, apart from each other."""
    cell = field.cell
    radius = int(np.ceil(max(np.abs(hits).max(), np.abs(swept).max(initial=0)) / cell)) + 1
    shape = [fft.next_fast_len(n + 2 * radius, real=True) for n in field.near.shape]
    near, wall = (fft.rfft2(picture, shape, workers=2) for picture in (field.near, field.wall))
    headings = np.arange(HEADINGS) * (2 * np.pi / HEADINGS) - np.pi
    rows, cols = field.near.shape
    scores = np.empty((HEADINGS, rows, cols), np.float32)
    for k, heading in enumerate(headings):
        total = near * np.conj(fft.rfft2(_picture(hits, heading, cell, shape), workers=2)) / len(hits)
        if len(swept):
            total -= 3 * wall * np.conj(fft.rfft2(_picture(swept, heading, cell, shape), workers=2)) / len(swept)
        score = fft.irfft2(total, shape, workers=2)[:rows, :cols]
        scores[k] = np.where(field.stand, score, -9)
    found = []
    for _ in range(count):
        k, i, j = (int(v) for v in np.unravel_index(int(scores.argmax()), scores.shape))
        found.append(np.array([(j + 0.5) * cell, (i + 0.5) * cell, headings[k]]))
        wide = int(np.ceil(1.0 / cell))
        scores[np.arange(k - 3, k + 4)[:, None, None] % HEADINGS, max(i - wide, 0) : i + wide + 1,
               max(j - wide, 0) : j + wide + 1] = -9  # fmt: skip
    return found


def _picture(points: np.ndarray, heading: float, cell: float, shape: list[int]) -> np.ndarray:
    """float32 ``shape`` counts of the turned points, the origin in cell (0, 0), negative cells wrapped round."""
    x, y = transform(np.array([0, 0, heading]), points).T / cell
    flat = np.floor(y + 0.5).astype(int) % shape[0] * shape[1] + np.floor(x + 0.5).astype(int) % shape[1]
    return np.bincount(flat, minlength=shape[0] * shape[1]).astype(np.float32).reshape(shape)


def settle(field: MapField, points: np.ndarray, pose: np.ndarray, gates: tuple[float, ...]) -> np.ndarray:
    """Gauss-Newton on the distances to walls of ``points`` (n, 2), from the pose (3,) of their frame."""
    for gate in gates:
        placed = transform(pose, points)
        distance, slope = field.at(placed)
        used = distance < gate
        if used.sum() < 10:
            return pose
        arm = placed[used] - pose[:2]
        rows = np.column_stack([slope[used], slope[used, 1] * arm[:, 0] - slope[used, 0] * arm[:, 1]])
        weight = 1 / np.maximum(distance[used] / 0.1, 1)
        normal = rows.T @ (weight[:, None] * rows) + np.diag([1.0, 1.0, 1.0])
        pose = pose - np.linalg.solve(normal, rows.T @ (weight * distance[used]))
    return np.array([pose[0], pose[1], se2.wrap(pose[2])])


def _follow(field: MapField, piece: Piece, scans: Thinned, start: np.ndarray) -> Place:
    """The piece from the pose ``start`` (3,) of its first scan: each scan settles on the map, the next one goes on."""
    poses = np.empty_like(piece.poses)
    for k in range(len(poses)):
        if k < piece.searched:
            guess = se2.compose(start, piece.poses[k])
        else:
            guess = se2.compose(poses[k - 1], se2.relative(piece.poses[k - 1], piece.poses[k]))
        poses[k] = settle(field, scans.points(piece.scans[k]), guess, (0.5, 0.5, 0.4, 0.3, 0.3))
    return Place(piece, poses, fit_of(field, scans, piece.scans, poses))


def fit_of(field: MapField, scans: Thinned, numbers: np.ndarray, poses: np.ndarray) -> MapFit:
    """Scans ``numbers`` (n,) at sensor poses (n, 3) against ranges cast in the map."""
    every = max(1, len(scans.angles) // 60)
    headings = poses[:, 2, None] + scans.angles[None, ::every]
    origins = np.repeat(poses[:, :2], headings.shape[1], axis=0)
    expected = field.cast(origins, headings.ravel(), _REACH).reshape(headings.shape)
    seen = scans.ranges[numbers][:, ::every]
    seen = np.where(seen > _REACH, np.inf, seen)
    returned, known = np.isfinite(seen), ~np.isnan(seen) & ~np.isneginf(seen)
    with np.errstate(invalid="ignore"):
        agree = returned & (np.abs(seen - expected) < NEAR)
        through = known & np.isfinite(expected) & (seen > expected + 0.5)
    return MapFit(agree.sum(1) / np.maximum(returned.sum(1), 1), through.sum(1) / np.maximum(known.sum(1), 1))


def place(field: MapField, piece: Piece, scans: Thinned, geometry: Geometry, count: int = 4) -> Place:
    """The best place of a piece under a geometry: the two of ``count`` on which its hits lie best are followed."""
    turned, seen = under(piece, geometry), scans.under(geometry)
    hits, swept = submap(turned, seen)
    gates = (1.0, 1.0, 0.8, 0.8, 0.5, 0.5, 0.5, 0.3, 0.3)
    starts = [settle(field, hits, start, gates) for start in search(field, hits, swept, count)]
    starts.sort(key=lambda start: float(np.minimum(field.at(transform(start, hits))[0], 0.5).mean()))
    return max((_follow(field, turned, seen, start) for start in starts[:2]), key=lambda p: p.score)


class Refined(NamedTuple):
    """Range scale and spread of the bearings that fit best, their standard errors, and the poses (n, 3) with them."""

    geometry: Geometry
    scale_sd: float
    spread_sd: float
    poses: np.ndarray


def refine(field: MapField, scans: Thinned, numbers: np.ndarray, poses: np.ndarray, geometry: Geometry) -> Refined:
    """Gauss-Newton over the poses of all scans and, common to them, range scale and spread (Schur complement)."""
    scale, spread, poses = geometry.scale, geometry.spread, poses.copy()
    covariance = np.eye(2)
    for gate in (0.6, 0.6, 0.5, 0.5, 0.4, 0.4, 0.3, 0.3, 0.3, 0.3, 0.3, 0.3):
        now = scans.under(Geometry(geometry.mirrored, scale, spread))
        common, right = np.diag([1e2, 1e2]), np.zeros(2)
        kept = []
        for n, pose in zip(numbers, poses, strict=True):
            hpp, hpg, hgg, bp, bg = _blocks(field, now, n, pose, gate, scale, spread)
            inverse = np.linalg.inv(hpp)
            common = common + hgg - hpg.T @ inverse @ hpg
            right += bg - hpg.T @ inverse @ bp
            kept.append((inverse, hpg, bp))
        covariance = np.linalg.inv(common)
        step = -covariance @ right
        poses = np.array([pose - inv @ (bp + hpg @ step) for pose, (inv, hpg, bp) in zip(poses, kept, strict=True)])
        scale, spread = scale + step[0], spread + step[1]
    # Neighbouring beams err alike: one in ten counts, each by a cell.
    sd = np.sqrt(np.diag(covariance) * 10) * max(field.resolution, 0.05)
    return Refined(Geometry(geometry.mirrored, float(scale), float(spread)), float(sd[0]), float(sd[1]), poses)


def _blocks(field: MapField, scans: Thinned, n: int, pose: np.ndarray, gate: float, scale: float, spread: float
             ) -> tuple[np.ndarray, ...]:  # fmt: skip
    """Normal equations of one scan: pose-pose, pose-common, common-common, and the two right-hand sides."""
    used = np.isfinite(scans.ranges[n]) & (scans.ranges[n] < _REACH)
    reach, angle = scans.ranges[n, used].astype(float), scans.angles[used] + pose[2]
    arm = reach[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    distance, slope = field.at(pose[:2] + arm)
    near = distance < gate
    turn = slope[:, 1] * arm[:, 0] - slope[:, 0] * arm[:, 1]
    bearing = scans.angles[used] - (scans.angles[0] + scans.angles[-1]) / 2
    rows = np.column_stack([slope, turn])[near]
    both = np.column_stack([(slope * arm).sum(1) / scale, turn * bearing / spread])[near]
    weight = 1 / np.maximum(distance[near] / 0.1, 1)
    off = weight * distance[near]
    return (
        rows.T @ (weight[:, None] * rows) + np.eye(3), rows.T @ (weight[:, None] * both),
        both.T @ (weight[:, None] * both), rows.T @ off, both.T @ off,
    )  # fmt: skip
