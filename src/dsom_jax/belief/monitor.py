"""What speaks for and against an answer: the scan against the map at the answer, the drive against the odometry, the
belief's share of the place. Features of :mod:`dsom_jax.belief.verdict`, computed for any filter.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import NamedTuple

import jax
import jax.numpy as jnp

from dsom_jax.geometry import relative, wrap_angle
from dsom_jax.lidar import LidarConfig
from dsom_jax.raycast import MapTables, RaycastConfig, cast_rays, leaps
from dsom_jax.types import Array

_UNTRIED = 0.45
"""Metres that leave a third of the doubt of the start: what a lidar sees at a stand does not show how it is mounted."""
_SPUN = 0.06
"""Metres that a radian counts for: a robot may have to be sure before it drives, so one turn on the spot will do."""
_MINUTES = 0.97
"""Share of the past that an update keeps of the way driven backwards."""
_TOLERANCE = 0.3
"""Metres within which a return is where the map has a wall."""


class Fit(NamedTuple):
    """How a scan fits the map at a pose, as shares.

    Attributes:
        hit, short, long: of the beams whose way lies in known space: those that end where the map has a wall, before
            it, and behind it. They sum to one; without any such beam they are 0.
        unknown: of the valid beams, those whose way leads through unknown space.
        known: of all beams, those that count for ``hit``, ``short`` and ``long``.
    """

    hit: Array
    short: Array
    long: Array
    unknown: Array
    known: Array


def fit(ranges: Array, expected: Array, seen: Array, range_max: float) -> Fit:
    """Fit of a scan (..., B) to the expected ranges and to the ranges at which known space ends (..., B).

    Neighbouring beams lend their expected ranges: at an edge either wall will do; the first and the last beam have one
    neighbour each. A beam without return where no wall is expected says nothing.
    """
    z, wall, edge = (jnp.minimum(r, range_max) for r in (ranges, expected, seen))
    before = jnp.concatenate([wall[..., :1], wall[..., :-1]], -1)
    after = jnp.concatenate([wall[..., 1:], wall[..., -1:]], -1)
    around = jnp.stack([before, wall, after])
    nearest, farthest = around.min(0), around.max(0)
    valid = ranges > -jnp.inf
    unknown = valid & (edge < jnp.minimum(z, nearest) - _TOLERANCE)
    empty = jnp.isposinf(ranges) & (wall >= range_max)
    judged = valid & ~unknown & ~empty
    short, long = judged & (z < nearest - _TOLERANCE), judged & (z > farthest + _TOLERANCE)
    count = judged.sum(-1)
    hit = judged & ~short & ~long
    hits, shorts, longs = (what.sum(-1) / jnp.maximum(count, 1) for what in (hit, short, long))
    unseen = unknown.sum(-1) / jnp.maximum(valid.sum(-1), 1)
    return Fit(hits, shorts, longs, unseen, count / ranges.shape[-1])


class Track(NamedTuple):
    """What a monitor remembers of one run; sums fade, so that each stands for about the last ten updates.

    Attributes:
        pose: (3,) the last answer.
        fit: (5,) faded sums of what :class:`Fit` holds, by known beams, and ``weight`` () of all of it.
        cross, along, squared: () faded sums of reported x answered steps: crosswise, along, and of the reported ones;
            a step that was answered backwards counts as one forth, as some encoders do not tell the two apart.
        back, path: () metres answered backwards, and all, in the last minutes.
        driven: () metres since the start that were both reported and answered, and a little for what was turned;
            metres answered where nothing was reported, as by an odometry that is not connected.
        slide, turn: () faded sums of squared gaps between reported and answered steps (m^2) and turns (rad^2).
        steps: () faded number of steps.
        jump: () faded number of steps that no odometry explains.
    """

    pose: Array
    fit: Array
    weight: Array
    cross: Array
    along: Array
    squared: Array
    back: Array
    path: Array
    driven: Array
    slide: Array
    turn: Array
    steps: Array
    jump: Array


class Signs(NamedTuple):
    """What speaks against an answer; each is 0 where all is well and grows with doubt, () each.

    Attributes:
        elsewhere: share of the belief that is not at the answer's place.
        scattered: share of the particles' weight that is not there.
        miss, long: share of the beams that do not end at a mapped wall, and that went through one; faded.
        miss_now, long_now: the same, of this scan alone.
        unknown: share of the beams that look into unknown space; faded.
        blind: share of the beams that say nothing, faded.
        crab: angle between the reported steps and the answered ones, radians.
        backward: share of the way that was answered backwards.
        stretch: by what share answered steps are longer or shorter than reported ones.
        slide: reported and answered steps differ by this share of a step.
        turn: root mean square of the gap between reported and answered turns, radians.
        jump: recent steps that no odometry explains.
        fresh: 1 at the start, fading with the way driven.
    """

    elsewhere: Array
    scattered: Array
    miss: Array
    long: Array
    miss_now: Array
    long_now: Array
    unknown: Array
    blind: Array
    crab: Array
    backward: Array
    stretch: Array
    slide: Array
    turn: Array
    jump: Array
    fresh: Array


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Monitor:
    """Watches the answers of a filter.

    Attributes:
        tables: the map.
        seen: the map whose unknown cells stop rays, too.
        lidar: beams that are looked at (static); every ``beam_step``-th of the scan (static).
        fade, slow: share of the past that an update keeps, of fits and of steps (static).
    """

    tables: MapTables
    seen: MapTables
    lidar: LidarConfig = field(metadata={"static": True})
    beam_step: int = field(metadata={"static": True})
    fade: float = field(default=0.7, metadata={"static": True})
    slow: float = field(default=0.9, metadata={"static": True})

    def start(self, pose: Array) -> Track:
        """Nothing seen; ``pose`` (3,) is where the odometry of the next update begins, if it is not the first.

        Whoever told the pose need not wait until the robot has driven.
        """
        zero = jnp.float32(0.0)
        return Track(pose, jnp.zeros(5), *[zero] * 11)._replace(driven=jnp.float32(jnp.inf))

    def watch(
        self,
        track: Track,
        answer: Array,
        ranges: Array,
        odometry: Array,
        first: Array,
        elsewhere: Array,
        scattered: Array,
    ) -> tuple[Track, Signs]:
        """One update of one run: ``answer`` (3,), ``ranges`` (B,) of the whole scan, ``odometry`` (3,)."""
        now = fit(
            ranges[:: self.beam_step],
            cast_rays(self.tables, answer, self.lidar),
            cast_rays(self.seen, answer, self.lidar),
            self.lidar.range_max,
        )
        track = self._stepped(track, answer, odometry, first)
        keep = jnp.where(first, 0.0, self.fade)
        counts = jnp.stack([now.hit * now.known, now.short * now.known, now.long * now.known, now.unknown, now.known])
        track = track._replace(pose=answer, fit=keep * track.fit + counts, weight=keep * track.weight + 1)
        return track, self._signs(track, now, elsewhere, scattered)

    def _stepped(self, track: Track, answer: Array, odometry: Array, first: Array) -> Track:
        """Reported against answered step; both along the mean heading, so that a wrong turn is not a wrong way.

        ``odometry`` is finite, as :func:`dsom_jax.montecarlo.update` gives it.
        """
        step = relative(track.pose, answer)
        gap = wrap_angle(step[2] - odometry[2])
        c, s = jnp.cos(gap / 2), jnp.sin(gap / 2)
        x, y = c * step[0] + s * step[1], c * step[1] - s * step[0]
        travel = jnp.hypot(odometry[0], odometry[1])
        backward = odometry[0] * x + odometry[1] * y < -0.5 * travel**2
        told = jnp.where(backward, -1.0, 1.0) * odometry
        off = jnp.hypot(x - told[0], y - told[1])
        jumped = (off > jnp.maximum(1.0, 1.5 * travel)) | (jnp.abs(gap) > 0.7)
        keep = jnp.where(first, 0.0, self.slow)
        use = jnp.where(first | jumped, 0.0, 1.0)
        way = jnp.hypot(x, y)
        shown = jnp.where((odometry == 0).all(), way, jnp.minimum(travel, way) + _SPUN * jnp.abs(odometry[2]))
        long = jnp.where(first, 0.0, _MINUTES)
        return track._replace(
            cross=keep * track.cross + use * (told[0] * y - told[1] * x),
            along=keep * track.along + use * (told[0] * x + told[1] * y),
            squared=keep * track.squared + use * travel**2,
            back=long * track.back + use * travel * backward,
            path=long * track.path + use * travel,
            driven=jnp.where(first, 0.0, track.driven + use * shown),
            slide=keep * track.slide + use * jnp.where(use > 0, off, 0.0) ** 2,
            turn=keep * track.turn + use * gap**2,
            steps=keep * track.steps + use,
            jump=jnp.where(first, 0.0, 0.8 * track.jump) + jnp.where(first, 0.0, jumped),
        )

    def _signs(self, track: Track, now: Fit, elsewhere: Array, scattered: Array) -> Signs:
        hit, short, long, unknown, known = track.fit / track.weight
        total = jnp.maximum(hit + short + long, 1e-6)
        length = track.squared / jnp.maximum(track.steps, 1e-6)
        sure = track.squared / (track.squared + 0.1)
        crab = jnp.arctan2(jnp.abs(track.cross), track.along)
        ratio = track.along / jnp.maximum(track.squared, 1e-6)
        return Signs(
            elsewhere=elsewhere,
            scattered=scattered,
            miss=(short + long) / total,
            long=long / total,
            miss_now=now.short + now.long,
            long_now=now.long,
            unknown=unknown,
            blind=1 - known,
            crab=sure * crab,
            backward=track.path / (track.path + 0.3) * track.back / jnp.maximum(track.path, 1e-6),
            stretch=sure * jnp.abs(ratio - 1),
            slide=sure * jnp.sqrt(track.slide / jnp.maximum(track.steps, 1e-6) / (length + 0.01)),
            turn=jnp.sqrt(track.turn / jnp.maximum(track.steps, 1.0)),
            jump=track.jump,
            fresh=jnp.exp(-track.driven / _UNTRIED),
        )


def monitor(tables: MapTables, lidar: LidarConfig, beams: int = 120) -> Monitor:
    """Monitor on a map, looking at about ``beams`` beams of a scan."""
    step = max(1, lidar.beams // beams)
    grid = replace(tables.grid, occupied=~tables.grid.free)
    seen = replace(tables, grid=grid, empty=leaps(grid.occupied, RaycastConfig()), walls=None)
    return Monitor(tables, seen, lidar.every(step), step)
