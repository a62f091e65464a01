"""The discretised pose space of a probability map PM, and drawing poses from it (section III of the paper)."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import NamedTuple

import jax
import jax.numpy as jnp

from dsom_jax.occupancy import OccupancyGrid
from dsom_jax.resampling import pick, pick_in_rows
from dsom_jax.types import Array, Key


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class PoseGrid:
    """Cells (i, j, k) of (x, y, theta); i along y, j along x, theta_k = -pi + k * 2 pi / K in the grid's frame.

    Attributes:
        origin: (3,) pose of the lower-left corner of the grid in the map frame.
        height, width, headings: H, W, K (static).
        resolution: metres per cell (static).
    """

    origin: Array
    height: int = field(metadata={"static": True})
    width: int = field(metadata={"static": True})
    headings: int = field(metadata={"static": True})
    resolution: float = field(metadata={"static": True})

    @property
    def shape(self) -> tuple[int, int, int]:
        """(H, W, K)."""
        return self.height, self.width, self.headings

    @property
    def turn(self) -> float:
        """Width of a heading bin, radians."""
        return 2 * math.pi / self.headings

    @property
    def log_cell_volume(self) -> float:
        """Logarithm of the volume of a cell in m^2 rad."""
        return math.log(self.resolution**2 * self.turn)

    def frame(self) -> OccupancyGrid:
        """An empty occupancy grid of the same extent, for its frame transforms."""
        empty = jnp.zeros((self.height, self.width), bool)
        return OccupancyGrid(empty, empty, self.origin, self.resolution)


def over(grid: OccupancyGrid, headings: int) -> PoseGrid:
    """The pose grid whose (x, y) cells are those of a map."""
    return PoseGrid(grid.origin, *grid.shape, headings, grid.resolution)


def heading(pose_grid: PoseGrid, k: Array) -> Array:
    """Centre of heading bin ``k`` in the grid's frame, radians."""
    return -jnp.pi + k * pose_grid.turn


def cell_pose(pose_grid: PoseGrid, i: Array, j: Array, k: Array) -> Array:
    """Map-frame pose (..., 3) at real-valued cell coordinates; integers are centres."""
    x, y = ((v + 0.5) * pose_grid.resolution for v in (j, i))
    return pose_grid.frame().from_grid(jnp.stack([x, y, heading(pose_grid, k)], axis=-1))


def pose_cell(pose_grid: PoseGrid, poses: Array) -> tuple[Array, Array, Array]:
    """Real-valued cell coordinates (i, j, k) of map-frame poses (..., 3), the inverse of :func:`cell_pose`."""
    local = pose_grid.frame().to_grid(poses)
    j, i = (local[..., axis] / pose_grid.resolution - 0.5 for axis in (0, 1))
    return i, j, ((local[..., 2] + jnp.pi) / pose_grid.turn) % pose_grid.headings


class ProbabilityMap(NamedTuple):
    """PM ready to be sampled.

    Attributes:
        mass: (H, W, K) non-negative, not necessarily normalised.
        cumulative: (H * W,) running sum of the mass of each (i, j).
        within: (H * W, K) running sum of the mass over the headings of one (i, j).
        pose_grid: where the cells are.
    """

    mass: Array
    cumulative: Array
    within: Array
    pose_grid: PoseGrid


def probability_map(pose_grid: PoseGrid, mass: Array) -> ProbabilityMap:
    """PM of masses (H, W, K)."""
    mass = mass.astype(jnp.float32)
    within = _running_sum(mass.reshape(-1, pose_grid.headings))
    return ProbabilityMap(mass, jnp.cumsum(within[:, -1]), within, pose_grid)


def _running_sum(rows: Array) -> Array:
    """Running sums along the rows (n, K): a product with a triangle, which is far faster here than ``cumsum``."""
    triangle = jnp.triu(jnp.ones((rows.shape[1], rows.shape[1]), rows.dtype))
    return jnp.matmul(rows, triangle, precision=jax.lax.Precision.HIGHEST)


def from_log(pose_grid: PoseGrid, log_mass: Array, free: Array) -> ProbabilityMap:
    """PM of unnormalised logarithms (H, W, K), zero where not ``free`` (H, W); uniform over free if nothing is left."""
    masked = jnp.where(free[..., None], log_mass, -jnp.inf)
    top = masked.max()
    mass = jnp.where(jnp.isfinite(top), exp_or_zero(masked - top), jnp.broadcast_to(free[..., None], masked.shape))
    return probability_map(pose_grid, mass.astype(jnp.float32))


def exp_or_zero(x: Array) -> Array:
    """exp(x), zero below e-80: numbers that are nearly too small for float32 make processors crawl."""
    return jnp.where(x > -80.0, jnp.exp(jnp.maximum(x, -80.0)), 0.0)


def sample(key: Key, pm: ProbabilityMap, n: int) -> tuple[Array, Array]:
    """``n`` poses (n, 3) drawn from PM, uniform within cell and bin, and their log densities in 1 / (m^2 rad)."""
    u = jax.random.uniform(key, (5, n))
    cell, k = pick_cells(pm, u[:2])
    jitter = u[2:] - 0.5
    i, j = jnp.divmod(cell, pm.pose_grid.width)
    poses = cell_pose(pm.pose_grid, i + jitter[0], j + jitter[1], k + jitter[2])
    return poses, log_share(pm, cell, k) - pm.pose_grid.log_cell_volume


def pick_cells(pm: ProbabilityMap, positions: Array) -> tuple[Array, Array]:
    """Cells (flat (i, j), k) (n,) drawn from PM by ``positions`` (2, n) in [0, 1)."""
    cell = pick(pm.cumulative, positions[0])
    return cell, pick_in_rows(pm.within, cell, positions[1])


def log_share(pm: ProbabilityMap, cell: Array, k: Array) -> Array:
    """Log of the normalised mass (...) of cells (flat (i, j), k)."""
    return jnp.log(pm.mass.reshape(-1)[cell * pm.pose_grid.headings + k]) - jnp.log(pm.cumulative[-1])


def log_density(pm: ProbabilityMap, poses: Array) -> Array:
    """Log density (...) of PM at map-frame poses (..., 3) in 1 / (m^2 rad); -inf off the grid and for NaN."""
    i, j, k, on_grid = nearest_cell(pm.pose_grid, poses)
    share = log_share(pm, jnp.where(on_grid, i * pm.pose_grid.width + j, 0), k)
    return jnp.where(on_grid, share - pm.pose_grid.log_cell_volume, -jnp.inf)


def nearest_cell(pose_grid: PoseGrid, poses: Array) -> tuple[Array, Array, Array, Array]:
    """Cells (i, j, k) (...) that map-frame poses (..., 3) lie in, and whether they lie on the grid at all."""
    known = jnp.isfinite(poses).all(-1)
    cells = pose_cell(pose_grid, poses)
    i, j, k = (jnp.round(jnp.where(known, v, -1)).astype(jnp.int32) for v in cells)
    on_grid = (i >= 0) & (i < pose_grid.height) & (j >= 0) & (j < pose_grid.width)
    return i, j, k % pose_grid.headings, on_grid


def mass_near(pm: ProbabilityMap, pose: Array, radius: float, angle: float) -> Array:
    """Probability within ``radius`` metres and ``angle`` radians of a pose (3,)."""
    return jnp.where(near(pm.pose_grid, pose, radius, angle), pm.mass, 0.0).sum() / pm.cumulative[-1]


def near(grid: PoseGrid, pose: Array, radius: float, angle: float) -> Array:
    """Which cells (H, W, K) have their centre within ``radius`` metres and ``angle`` radians of a pose (3,)."""
    i, j, k = pose_cell(grid, pose)
    rows, cols = jnp.arange(grid.height)[:, None], jnp.arange(grid.width)
    close = jnp.hypot(rows - i, cols - j) * grid.resolution <= radius
    gap = (jnp.arange(grid.headings) - k + grid.headings / 2) % grid.headings - grid.headings / 2
    return close[..., None] & (jnp.abs(gap) * grid.turn <= angle)
