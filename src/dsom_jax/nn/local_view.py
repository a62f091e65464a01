"""What lies around a particle: the map and the scan as two pictures in the robot's frame, on the same cells.

The map's picture is PF-Net's spatial transformer (Karkus et al. 2018, section 4): a bilinear crop of the occupancy map,
turned and shifted so that the particle is in the middle and looks along +x. It is differentiable in the pose.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
import numpy as np

from dsom_jax import checks
from dsom_jax.errors import UserError
from dsom_jax.geometry import rotate
from dsom_jax.lidar import LidarConfig, scan_points
from dsom_jax.nn.config import lacking
from dsom_jax.occupancy import OccupancyGrid, resample
from dsom_jax.types import Array

PATCH = 4
"""Cells along a side of a patch; pictures are kept as patches, in the order that the network joins them."""

SCAN_CHANNELS = 3
"""Hit, seen through, seen: the scan's picture."""


@dataclass(frozen=True)
class ViewConfig:
    """Size and scale of a local view.

    Attributes:
        cells: along a side of the square, a multiple of 8.
        resolution: metres per cell of the view.
        map_resolution: metres per cell of the maps that are cropped; finer ones are resampled to it.
        beams: of the scan that are used at most.
        fov_min: the narrowest scan it is trained for, radians.
        reach_min: the shortest maximal range it is trained for, metres.
    """

    cells: int = 16
    resolution: float = 0.5
    map_resolution: float = 1 / 3
    beams: int = 120
    fov_min: float = 2 * math.pi
    reach_min: float = 10.0

    def __post_init__(self) -> None:
        checks.count(self, "cells beams")
        if self.cells % (2 * PATCH):
            raise ValueError(checks.message(self, "cells", f"give a multiple of {2 * PATCH}"))
        checks.positive(self, "resolution map_resolution fov_min reach_min")

    @property
    def patches(self) -> int:
        """Number of patches of a view."""
        return (self.cells // PATCH) ** 2

    def beam_step(self, lidar: LidarConfig) -> int:
        """Every so many-th beam of ``lidar`` is used."""
        return -(-lidar.beams // self.beams)

    def misfit(self, lidar: LidarConfig) -> str | None:
        """Why scans of ``lidar`` are not what the network was trained for, or None."""
        if less := lacking(lidar, self.fov_min, self.reach_min):
            return less
        if lidar.beams < self.beams // 2:
            return f"{lidar.beams} beams, trained for {self.beams // 2} or more"
        return None


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class CornerMap:
    """A map ready for bilinear crops: four neighbouring cells packed into one byte, so that a sample is one look-up.

    Attributes:
        codes: (H + 3, W + 3) uint8; bits 0 to 3 of entry (i, j) are the cells (i-2, j-2), (i-2, j-1), (i-1, j-2) and
            (i-1, j-1) of the map, empty outside of it.
        origin: (3,) pose of the map's lower-left corner in the map frame.
        resolution: metres per cell (static).
    """

    codes: Array
    origin: Array
    resolution: float = field(metadata={"static": True})


def corner_map(grid: OccupancyGrid) -> CornerMap:
    """The map of ``grid`` for :func:`local_view`."""
    return CornerMap(pack_corners(grid.occupied), grid.origin, grid.resolution)


def map_for(grid: OccupancyGrid, config: ViewConfig) -> OccupancyGrid:
    """``grid`` at the scale that the network was trained at; UserError if it is coarser."""
    if grid.resolution > 1.2 * config.map_resolution:
        own, trained = f"{grid.resolution:.3g}", f"{config.map_resolution:.3g}"
        raise UserError(f"map: {own} m per cell, but the network works at {trained}; give a finer map")
    same = abs(grid.resolution - config.map_resolution) < 1e-3 * config.map_resolution
    return grid if same else resample(grid, config.map_resolution)


def pack_corners(occupied: Array) -> Array:
    """(H, W) bool -> (H + 3, W + 3) uint8 of :class:`CornerMap`."""
    cells = jnp.pad(occupied.astype(jnp.uint8), 2)
    low, high = cells[:-1], cells[1:]
    return low[:, :-1] | (low[:, 1:] << 1) | (high[:, :-1] << 2) | (high[:, 1:] << 3)


def cell_offsets(config: ViewConfig) -> np.ndarray:
    """(P, 16, 2) positions (x, y) of the view's cells in the robot's frame, metres.

    Patches come in groups of four that form a square, rows along y, columns along x.
    """
    index = patch_order(config)
    centres = (np.stack([index % config.cells, index // config.cells], -1) + 0.5 - config.cells / 2) * config.resolution
    return centres.astype(np.float32)


def patch_order(config: ViewConfig) -> np.ndarray:
    """(P, 16) flat index i * cells + j of each cell of a patch in the (cells, cells) picture; i along y, j along x."""
    side = config.cells // (2 * PATCH)
    index = np.arange(config.cells**2).reshape(side, 2, PATCH, side, 2, PATCH)
    return index.transpose(0, 3, 1, 4, 2, 5).reshape(-1, PATCH * PATCH)


def local_view(place: CornerMap, poses: Array, config: ViewConfig) -> Array:
    """Occupancy (..., P, 16) in [0, 1] around map-frame poses (..., 3), bilinear between the centres of map cells."""
    local = _to_grid(place.origin, poses) / jnp.asarray([place.resolution, place.resolution, 1.0])
    u, v = np.moveaxis(cell_offsets(config) / np.float32(place.resolution), -1, 0)
    dx, dy = rotate(local[..., 2, None, None], u, v)
    return bilinear(place.codes, local[..., 1, None, None] + dy, local[..., 0, None, None] + dx)


def _to_grid(origin: Array, poses: Array) -> Array:
    """Poses in the frame of ``origin``; unlike ``relative`` it leaves angles unwrapped, which costs a division."""
    x, y = rotate(-origin[2], poses[..., 0] - origin[0], poses[..., 1] - origin[1])
    return jnp.stack([x, y, poses[..., 2] - origin[2]], axis=-1)


def bilinear(codes: Array, y: Array, x: Array) -> Array:
    """Occupancy at positions in cells from the map's lower-left corner; cell (i, j) has its centre at + 0.5."""
    # Cell 0 has its centre at 0.5, and the packed map begins two cells earlier.
    y, x = y + 1.5, x + 1.5
    i, j = jnp.floor(y), jnp.floor(x)
    fy, fx = y - i, x - j
    i, j = (jnp.clip(v, 0, n - 1).astype(jnp.int32) for v, n in ((i, codes.shape[0]), (j, codes.shape[1])))
    code = codes.reshape(-1)[i * codes.shape[1] + j].astype(jnp.int32)
    a, b, c, d = (((code >> bit) & 1).astype(jnp.float32) for bit in range(4))
    low, high = a + fx * (b - a), c + fx * (d - c)
    return low + fy * (high - low)


def scan_view(ranges: Array, lidar: LidarConfig, config: ViewConfig) -> Array:
    """A scan (B,) of ``lidar`` as a picture (P, 16, 3) on the cells of the local view.

    Channels: share of a beam's end that falls into the cell (at most one), whether the beam towards the cell goes
    on behind it, whether there is a valid beam towards it.
    """
    beam, distance = towards_cells(lidar, config)
    reach = jnp.where(jnp.isposinf(ranges), lidar.range_max, ranges)
    valid = jnp.isfinite(reach)
    reach = jnp.where(valid, reach, 0.0)
    seen = valid[beam] & (distance < lidar.range_max) & (beam >= 0)
    through = jnp.clip((reach[beam] - distance) / config.resolution, 0.0, 1.0)
    hit = splat(*scan_points(ranges, lidar), config)[patch_order(config)]
    return jnp.stack([hit, jnp.where(seen, through, 0.0), seen.astype(jnp.float32)], axis=-1)


def towards_cells(lidar: LidarConfig, config: ViewConfig) -> tuple[np.ndarray, np.ndarray]:
    """Number of the beam nearest to each cell of the view, -1 if none points there, and metres from the sensor."""
    x, y = np.moveaxis(cell_offsets(config) - np.asarray(lidar.mount[:2], np.float32), -1, 0)
    gap = np.abs((np.arctan2(y, x)[..., None] - lidar.angles() + np.pi) % (2 * np.pi) - np.pi)
    beam, distance = gap.argmin(-1), np.hypot(x, y)
    # A cell is as wide as it is: near ones are met by beams that do not point at their centre.
    near = gap.min(-1) <= np.maximum(abs(lidar.angle_increment), 0.5 * config.resolution / np.maximum(distance, 1e-3))
    return np.where(near, beam, -1), distance


def splat(points: Array, valid: Array, config: ViewConfig) -> Array:
    """Points (B, 2) in the robot's frame shared out over their four nearest cells: (cells * cells,) in [0, 1]."""
    places = points / config.resolution + (config.cells / 2 - 0.5)
    corner = jnp.floor(places)
    share = places - corner
    total = jnp.zeros(config.cells * config.cells)
    for dj, di in ((0, 0), (1, 0), (0, 1), (1, 1)):
        j, i = corner[:, 0] + dj, corner[:, 1] + di
        weight = jnp.abs(1 - dj - share[:, 0]) * jnp.abs(1 - di - share[:, 1])
        inside = valid & (i >= 0) & (i < config.cells) & (j >= 0) & (j < config.cells)
        flat = jnp.where(inside, i * config.cells + j, config.cells**2).astype(jnp.int32)
        total = total.at[flat].add(weight, mode="drop")
    return jnp.minimum(total, 1.0)
