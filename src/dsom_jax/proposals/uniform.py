"""No knowledge: uniform over free space."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp

from dsom_jax.occupancy import OccupancyGrid
from dsom_jax.resampling import pick
from dsom_jax.types import Array, Inputs, Key


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class FreeSpace:
    """Uniform distribution over the free cells of a map and all headings.

    Attributes:
        origin: (3,) pose of the grid in the map frame.
        cumulative: (H * W,) number of free cells up to each.
        width: cells per row (static).
        resolution: metres per cell (static).
    """

    origin: Array
    cumulative: Array
    width: int = field(metadata={"static": True})
    resolution: float = field(metadata={"static": True})

    @property
    def log_density_value(self) -> Array:
        """() log of 1 / (free area * 2 pi), in 1 / (m^2 rad)."""
        return -jnp.log(self.cumulative[-1] * self.resolution**2 * 2 * jnp.pi)

    def begin(self) -> tuple[()]:
        """No memory: each scan is taken on its own."""
        return ()

    def prepare(self, memory: tuple[()], inputs: Inputs) -> tuple[None, tuple[()]]:
        """Nothing: the scan is not looked at."""
        return None, memory

    def sample(self, key: Key, prepared: Any, n: int) -> tuple[Array, Array]:
        """``n`` poses (n, 3) in the map frame and their log densities (n,)."""
        k_cell, k_pose = jax.random.split(key)
        cell = pick(self.cumulative, jax.random.uniform(k_cell, (n,)))
        u = jax.random.uniform(k_pose, (3, n))
        x, y = ((index + v) * self.resolution for index, v in ((cell % self.width, u[0]), (cell // self.width, u[1])))
        local = jnp.stack([x, y, (2 * u[2] - 1) * jnp.pi], axis=-1)
        frame = OccupancyGrid(self.cumulative, self.cumulative, self.origin, self.resolution)
        return frame.from_grid(local), jnp.full((n,), self.log_density_value)


@jax.jit
def free_space(grid: OccupancyGrid) -> FreeSpace:
    """Uniform proposal over the free cells of ``grid``."""
    counts = jnp.cumsum(grid.free.reshape(-1).astype(jnp.float32))
    return FreeSpace(grid.origin, counts, grid.shape[1], grid.resolution)
