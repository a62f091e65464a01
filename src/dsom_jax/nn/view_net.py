"""Compares the local view of a map with a scan: the observation network of PF-Net and of PFRNN.

Everything is a product of matrices on patches. Both pictures lie in the robot's frame, so that nothing is gained by
sharing weights between overlapping windows, and matrix products keep their speed inside of scans over time.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from flax import nnx

from dsom_jax.lidar import LidarConfig
from dsom_jax.nn.layers import Dense, normal
from dsom_jax.nn.local_view import PATCH, SCAN_CHANNELS, ViewConfig, scan_view
from dsom_jax.types import Array

_PIXELS = PATCH * PATCH


class ScanCode(NamedTuple):
    """What one scan says about each patch of the view, for all particles.

    Attributes:
        gate: (P, C) factors of the map's features.
        shift: (P, C) added to them.
    """

    gate: Array
    shift: Array


def leaky(x: Array) -> Array:
    """Leaky rectifier: no transcendental function, of which there would be millions."""
    return jnp.maximum(x, 0.1 * x)


class ViewNet(nnx.Module):
    """Scan and local map to features of how they agree."""

    def __init__(self, view: ViewConfig, width: int, features: int, rng: np.random.Generator) -> None:
        self.view = view
        self.scan_hidden = Dense(SCAN_CHANNELS * _PIXELS, 2 * width, rng)
        self.scan_gate = Dense(2 * width, width, rng)
        self.scan_shift = Dense(2 * width, width, rng)
        # The same disagreement means something else near the robot than far away.
        self.place = nnx.Param(normal(rng, (view.patches, width), 0.01 * view.patches))
        self.map_patch = nnx.Param(normal(rng, (_PIXELS, width), 2.0))
        self.compare = Dense(width, width, rng)
        self.join = Dense(4 * width, width, rng)
        self.whole = Dense(view.patches // 4 * width, features, rng)

    def scan_code(self, ranges: Array, lidar: LidarConfig) -> ScanCode:
        """Reading of one scan (B,) of ``lidar``; once for all particles."""
        picture = scan_view(ranges, lidar, self.view)
        hidden = leaky(self.scan_hidden(picture.reshape(self.view.patches, -1)))
        return ScanCode(1.0 + self.scan_gate(hidden), self.scan_shift(hidden) + self.place[...])

    def __call__(self, views: Array, code: ScanCode) -> Array:
        """Local views (N, P, 16) and a scan -> features (N, F)."""
        x = leaky((views @ self.map_patch[...]) * code.gate + code.shift)
        x = leaky(self.compare(x))
        x = leaky(self.join(x.reshape(*x.shape[:-2], x.shape[-2] // 4, -1)))
        return leaky(self.whole(x.reshape(*x.shape[:-2], -1)))
