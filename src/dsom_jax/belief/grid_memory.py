"""What the belief over the grid is told, remembers and tells others: see :mod:`dsom_jax.belief.grid_belief`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from dsom_jax import checks
from dsom_jax.belief.pool import Pool
from dsom_jax.types import Array


@dataclass(frozen=True)
class GridBeliefConfig:
    """How the belief moves and what it believes of a scan (static).

    Attributes:
        beams: beams that are judged, spread evenly over the scan.
        temper: factor on a scan's log-likelihood.
        kidnap: probability of being carried anywhere between two updates.
        slip: probability that the robot stood still, or drove back what the odometry reports as forth.
        leave: probability of leaving the map at an update.
        enter: probability of coming back to it.
        explained: off the map a scan is as likely as on it where the map explains this share of the beams; of cells
            and heading bins, so that even the right one explains half of a clean scan.
        fits: log-likelihood of a beam below which a focus is not trusted, and the whole grid judged.
        rows: number of cells that a focus holds.
        reach: cells around where the odometry takes the mass that the focus goes on to hold.
        pool: cells that are drawn to stand for the belief.
        samples: how many of them tell places apart.
    """

    beams: int = 60
    temper: float = 0.1
    kidnap: float = 1e-9
    slip: float = 0.1
    leave: float = 1e-4
    enter: float = 0.02
    explained: float = 0.2
    fits: float = -1.7
    rows: int = 256
    reach: int = 2
    pool: int = 2048
    samples: int = 512

    def __post_init__(self) -> None:
        checks.count(self, "beams rows pool samples")
        checks.count(self, "reach", 2)  # what moving spreads, and no more
        checks.positive(self, "temper")
        checks.share(self, "kidnap leave enter explained", excluding="()")
        checks.share(self, "slip", excluding=")")
        checks.finite(self, "fits")


class Memory(NamedTuple):
    """The belief after an update.

    Attributes:
        mass: (C, K) by free cell and heading; means nothing while ``held``.
        rows: (M,) cells of the focus, C where there are fewer.
        focus: (M, K) mass of these; all that there is on the map while ``held``.
        held: () bool, the focus holds the belief, not ``mass``.
        focused: () bool, it does, and the scan fits there.
        off: () mass off the map; all of it sums to one.
        pool: what was drawn of it.
        scan: (B,) the last one that counted, to tell what is new in the next.
        pending: (3,) motion since then, in the base frame of then.
    """

    mass: Array
    rows: Array
    focus: Array
    held: Array
    focused: Array
    off: Array
    pool: Pool
    scan: Array
    pending: Array


class Places(NamedTuple):
    """What an update makes of the belief, for particles and for the verdict.

    Attributes:
        pool: cells that stand for it.
        poses: (S, 3) base poses of some of them, each with 1 / S of the mass on the map.
        off: () mass off the map.
        novelty: () how much of the scan counted.
    """

    pool: Pool
    poses: Array
    off: Array
    novelty: Array
