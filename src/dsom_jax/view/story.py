"""What a page tells, as plain NumPy: it knows no filter, no reader and no file."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple

import numpy as np

from dsom_jax.belief.verdict import Verdict
from dsom_jax.judging.metrics import ANGLE, POSITION

VERDICTS = tuple(verdict.name.lower() for verdict in Verdict)
"""By number, from the best to the worst; a page has a colour for each."""


@dataclass(frozen=True)
class Plan:
    """The map, and the lidar in it.

    Attributes:
        occupied, free: (H, W) bool, row 0 at the bottom; what is neither is unknown.
        origin: (3,) pose of the lower-left corner in the map frame (m, m, rad).
        resolution: metres per cell.
        bearings: (B,) of the beams in the base frame, radians.
        mount: (x, y) of the lidar in the base frame, metres.
        name: what a reader knows the map by.
    """

    occupied: np.ndarray
    free: np.ndarray
    origin: np.ndarray
    resolution: float
    bearings: np.ndarray
    mount: tuple[float, float] = (0.0, 0.0)
    name: str = "map"

    def corners(self) -> np.ndarray:
        """(4, 2) corners, in the map frame, of the part that is known."""
        known = np.argwhere(self.occupied | self.free)
        low, high = (known.min(0), known.max(0) + 1) if len(known) else ((0, 0), self.occupied.shape)
        (i0, j0), (i1, j1) = low, high
        local = np.array([(j0, i0), (j1, i0), (j1, i1), (j0, i1)], float) * self.resolution
        c, s = math.cos(self.origin[2]), math.sin(self.origin[2])
        return local @ np.array([[c, s], [-s, c]]) + np.asarray(self.origin)[:2]


class DriveHypotheses(NamedTuple):
    """Places that may be the right one: at most H for each of T updates, filled up with weights of zero.

    Attributes:
        weights: (T, H) probabilities.
        means: (T, H, 3) poses in the map frame.
        covariances: (T, H, 3, 3) of (x, y, theta), m^2, m rad, rad^2.
    """

    weights: np.ndarray
    means: np.ndarray
    covariances: np.ndarray


@dataclass(frozen=True)
class DriveStory:
    """One drive as one run saw it; T updates, B beams, P particles.

    Attributes:
        name: what the drive is called in the selector.
        stamps: (T,) seconds.
        estimates: (T, 3) answers in the map frame.
        p_lost: (T,) probability that the answer is wrong.
        verdicts: T names out of :data:`VERDICTS`.
        truth: (T, 3) reference, NaN where unknown.
        kidnapped: (T,) bool, carried away between t-1 and t.
        ranges: (T, B) metres, REP-117.
        particles: (T, P, 3), P may be 0; particle_weights: (T, P).
        hypotheses: the places that hold the mass.
    """

    name: str
    stamps: np.ndarray
    estimates: np.ndarray
    p_lost: np.ndarray
    verdicts: tuple[str, ...]
    truth: np.ndarray
    kidnapped: np.ndarray
    ranges: np.ndarray
    particles: np.ndarray
    particle_weights: np.ndarray
    hypotheses: DriveHypotheses

    def __post_init__(self) -> None:
        count = len(self.stamps)
        for name in ("estimates", "p_lost", "verdicts", "truth", "kidnapped", "ranges", "particles"):
            if len(getattr(self, name)) != count:
                raise ValueError(f"DriveStory.{name}: {len(getattr(self, name))} updates, stamps have {count}")
        unknown = sorted(set(self.verdicts) - set(VERDICTS))
        if unknown:
            raise ValueError(f"DriveStory.verdicts: {unknown[0]!r} is none of {', '.join(VERDICTS)}")

    def errors(self) -> tuple[np.ndarray, np.ndarray]:
        """E_pos (T,) metres and E_theta (T,) radians, NaN without reference."""
        gap = np.asarray(self.estimates, float) - np.asarray(self.truth, float)
        return np.hypot(gap[:, 0], gap[:, 1]), np.abs((gap[:, 2] + np.pi) % (2 * np.pi) - np.pi)


class Remark(NamedTuple):
    """Something that a reader of map or log, or the run itself, has to say."""

    says: str
    severity: Literal["error", "warning", "note"] = "note"
    fix: str = ""


class Field(NamedTuple):
    """Numbers over the map: values (H, W), NaN for none, on cells of ``resolution`` metres at ``origin``."""

    label: str
    unit: str
    values: np.ndarray
    origin: np.ndarray
    resolution: float


class Lookalike(NamedTuple):
    """Two poses (3,) that a scan cannot tell apart, and how much better the first explains it (natural logarithm)."""

    a: np.ndarray
    b: np.ndarray
    log_odds: float


@dataclass(frozen=True)
class Story:
    """Everything on a page.

    Attributes:
        title: one line; headline: what came out, in one or two sentences.
        plan: the map.
        drives: none, one or several.
        summary: the numbers as written beside the page.
        tiles: keys of ``summary`` worth a large figure: (key, label, kind), see :mod:`dsom_jax.view.page`.
        tables: (caption, column heads, rows of text).
        findings, settings: what to know, and what was set.
        overlay, lookalikes: for pages about a map.
        caption: what exactly is shown of the drives.
    """

    title: str
    headline: str
    plan: Plan
    drives: tuple[DriveStory, ...] = ()
    summary: dict[str, Any] = field(default_factory=dict)
    tiles: tuple[tuple[str, str, str], ...] = ()
    tables: tuple[tuple[str, tuple[str, ...], tuple[tuple[str, ...], ...]], ...] = ()
    findings: tuple[Remark, ...] = ()
    settings: dict[str, Any] = field(default_factory=dict)
    overlay: Field | None = None
    lookalikes: tuple[Lookalike, ...] = ()
    caption: str = ""


class Moment(NamedTuple):
    """An update worth a look."""

    update: int
    kind: Literal["kidnapping", "sure and wrong", "worst"]
    says: str


def moments(drive: DriveStory, worst: int = 3) -> list[Moment]:
    """Kidnappings, the first update of each stretch that is sure and wrong, the ``worst`` greatest errors; in order.

    Of errors that leave the answer in the right place the greatest alone is told.

    Without a reference the worst are those at which the filter itself is least sure.
    """
    found = [Moment(int(t), "kidnapping", "carried away") for t in np.flatnonzero(drive.kidnapped) if t > 0]
    e_pos, e_theta = drive.errors()
    wrong = (e_pos > POSITION) | (e_theta > ANGLE)
    sure = np.array([verdict == "localized" for verdict in drive.verdicts])
    fooled = np.asarray(wrong & sure)
    starts = np.flatnonzero(fooled & ~np.r_[False, fooled[:-1]])
    found += [Moment(int(t), "sure and wrong", f"{e_pos[t]:.1f} m off") for t in starts]
    judged = bool(np.isfinite(e_pos).any())
    badness = np.where(np.isfinite(e_pos), e_pos, -1.0) if judged else np.asarray(drive.p_lost, float)
    bad = POSITION if judged else 0.5
    for rank, t in enumerate(_peaks(badness, worst)):
        if rank and badness[t] < bad:  # the greatest of small errors is worth a look, the second is not
            break
        says = f"{e_pos[t]:.1f} m off" if judged else f"{drive.p_lost[t]:.0%} lost"
        found.append(Moment(t, "worst", says))
    return sorted(found)


def _peaks(badness: np.ndarray, count: int) -> list[int]:
    """At most ``count`` updates of greatest ``badness`` (T,), none within a twelfth of the drive of a greater one."""
    apart, left = max(3, len(badness) // 12), badness.astype(float).copy()
    chosen: list[int] = []
    while len(chosen) < count and np.isfinite(left).any() and left.max() > 0:
        t = int(np.argmax(left))
        chosen.append(t)
        left[max(0, t - apart) : t + apart + 1] = -np.inf
    return chosen


def fewer_particles(drive: DriveStory, count: int) -> tuple[np.ndarray, np.ndarray]:
    """(T, P', 3) particles and weights (T, P'), P' at most ``count``: drawn evenly by weight where there are more.

    Drawn ones weigh the same; one that weighs much is then there several times.
    """
    poses, weights = np.asarray(drive.particles, float), np.asarray(drive.particle_weights, float)
    if poses.shape[1] <= count:
        return poses, weights
    total = np.cumsum(weights, axis=1)
    places = (np.arange(count) + 0.5) / count * total[:, -1:]
    rows = np.stack([np.searchsorted(row, place) for row, place in zip(total, places, strict=True)])
    rows = np.minimum(rows, poses.shape[1] - 1)
    return np.take_along_axis(poses, rows[..., None], 1), np.full(rows.shape, 1.0 / count)
