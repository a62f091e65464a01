"""One recorded or simulated drive."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp

from dsom_jax.types import Array, Inputs


class Episode(NamedTuple):
    """What the robot sensed, and where it truly was; T updates of B beams.

    Attributes:
        ranges: (T, B) metres, REP-117 (+inf no return, -inf too close, NaN invalid).
        odometry: (T, 3) motion from update t-1 to t in the base frame of t-1 (m, m, rad); row 0 is zero.
        poses: (T, 3) reference pose of the base in the map frame, NaN where unknown. Never shown to a filter.
        kidnapped: (T,) bool, true where the robot was carried away between t-1 and t.
        stamps: (T,) seconds since the start.
    """

    ranges: Array
    odometry: Array
    poses: Array
    kidnapped: Array
    stamps: Array

    @property
    def inputs(self) -> Inputs:
        """The part that a filter may see, stacked over time."""
        return Inputs(self.ranges, self.odometry, jnp.arange(self.ranges.shape[0]))
