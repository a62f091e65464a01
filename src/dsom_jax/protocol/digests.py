"""Short hashes by which a repetition tells whether a kept result is still of the same map and logs."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from typing import Any

import numpy as np

from dsom_jax import checkpoint
from dsom_jax.data.suite import Suite
from dsom_jax.occupancy import OccupancyGrid

DECIMALS = 3
"""Of metres and radians: another machine may round the last bits in another way."""


def _digest(*parts: Any) -> str:
    """Twelve hexadecimal digits of arrays, in this order; floats are rounded to a millimetre and a milliradian."""
    found = hashlib.sha256()
    for part in map(np.asarray, parts):
        whole = part if part.dtype.kind in "biu" else np.round(part.astype(float), DECIMALS) + 0.0
        found.update(np.ascontiguousarray(whole).tobytes())
    return found.hexdigest()[:12]


def map_digest(grid: OccupancyGrid) -> str:
    """Of cells and frame: changes with the image or drawing and with every field that says how it is read."""
    return _digest(grid.occupied, grid.free, grid.origin, grid.resolution)


def clips_digest(suite: Suite) -> str:
    """Of all scans, poses and kidnappings: changes with the logs, their references and how clips are chosen."""
    return _digest(*(part for _, _, clip in suite.episodes for part in (clip.ranges, clip.poses, clip.kidnapped)))


def digests(suite: Suite, networks: Mapping[str, Any]) -> dict[str, Any]:
    """``digests`` of ``bench.json``: maps and drives of a suite, and the folders of the ``networks`` by kind."""
    maps = {where: map_digest(grid) for where, grid, _ in suite.episodes}
    used = {kind: checkpoint.digest(folder) for kind, folder in networks.items()}
    return {"maps": maps, "drives": clips_digest(suite), "networks": used}
