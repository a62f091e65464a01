"""Scans as a driver's messages give them, each with angles of its own, brought onto the beams of one lidar.

A beam of the result is the nearest beam of the scan, never a mixture of two: across an edge nothing is invented.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from dsom_jax.data import se2
from dsom_jax.data.log import Report
from dsom_jax.data.turns import middle_of, turns
from dsom_jax.lidar import LidarConfig

TURN = 2 * math.pi
COVERED = 0.5
"""Share of the lidar's beams that a scan must cover to be used."""


@dataclass(frozen=True)
class Scans:
    """N scans of at most B readings.

    Attributes:
        ranges: (N, B) float32 metres, NaN beyond ``counts``.
        counts: (N,) readings of each scan.
        stamps: (N,) float64 seconds, of the first beam.
        start, end, step: (N,) radians, bearing of the first beam and of the last, and from beam to beam, as told.
        beam_time: (N,) seconds from beam to beam as told, 0 where all are taken at once.
    """

    ranges: np.ndarray
    counts: np.ndarray
    stamps: np.ndarray
    start: np.ndarray
    end: np.ndarray
    step: np.ndarray
    beam_time: np.ndarray

    def __len__(self) -> int:
        return len(self.stamps)

    def select(self, keep: np.ndarray) -> Scans:
        """The scans ``keep`` (mask or indices)."""
        return Scans(*(getattr(self, name)[keep] for name in self.__dataclass_fields__))

    def last(self) -> np.ndarray:
        """(N,) bearing of the last beam by start, step and count."""
        return self.start + self.step * (self.counts - 1)


@dataclass(frozen=True)
class Beams:
    """The bearings that all scans are brought to: ``count`` from ``start`` by ``step`` radians in the lidar's frame."""

    count: int
    start: float
    step: float

    def bearings(self) -> np.ndarray:
        """(B,) radians."""
        return self.start + self.step * np.arange(self.count)

    def circle(self) -> bool:
        """Whether the last beam is the neighbour of the first."""
        return self.count * abs(self.step) > TURN - 1.5 * abs(self.step)


def table(ranges: list[np.ndarray], **columns: np.ndarray) -> Scans:
    """Scans of readings of any lengths; ``columns`` are the other fields."""
    counts = np.array([len(row) for row in ranges])
    padded = np.full((len(ranges), counts.max(initial=0)), np.nan, np.float32)
    with np.errstate(over="ignore"):  # beyond single precision is beyond any lidar: inf
        for row, values in zip(padded, ranges, strict=True):
            row[: len(values)] = values
    return Scans(padded, counts, **columns)


def common_beams(scans: Scans) -> Beams:
    """The most frequent geometry if half of the scans have it, else the middle of all; a whole turn is closed."""
    kinds = np.stack([scans.counts, scans.start, scans.step], axis=-1)
    _, index, votes = np.unique(kinds, axis=0, return_index=True, return_counts=True)
    if votes.max() * 2 >= len(scans):
        most = index[votes.argmax()]
        return Beams(int(scans.counts[most]), float(scans.start[most]), float(scans.step[most]))
    start, step, count = (float(np.median(v)) for v in (scans.start, scans.step, scans.counts))
    if round(count) * abs(step) > TURN - 1.5 * abs(step):
        return Beams(round(count), start, math.copysign(TURN / round(count), step))
    end = float(np.median(scans.last()))
    return Beams(round((end - start) / step) + 1, start, step)


def differing(scans: Scans, beams: Beams) -> np.ndarray:
    """(N,) bool: scans whose beams are not those of ``beams``, to a tenth of a beam."""
    far = 0.1 * abs(beams.step)
    first, last = np.abs(scans.start - beams.start), np.abs(scans.last() - beams.bearings()[-1])
    return (scans.counts != beams.count) | (first > far) | (last > far)


def onto(scans: Scans, beams: Beams) -> np.ndarray:
    """Ranges (N, count) of the nearest beam of each scan, NaN where it has none within three quarters of a beam."""
    ranges = np.full((len(scans), beams.count), np.nan, np.float32)
    other = differing(scans, beams)
    ranges[~other] = scans.ranges[~other][:, : beams.count]
    for n in np.flatnonzero(other):
        own = scans.start[n] + scans.step[n] * np.arange(scans.counts[n])
        ranges[n] = nearest(own, scans.ranges[n, : scans.counts[n]], beams, abs(scans.step[n]))
    return ranges


def nearest(bearings: np.ndarray, ranges: np.ndarray, beams: Beams, spacing: float) -> np.ndarray:
    """Ranges (B,) at the bearings of ``beams``, each of the nearest of ``bearings`` (n,), or NaN if that is too far."""
    wanted = beams.bearings()
    if beams.circle():
        wanted = wanted % TURN
        bearings = bearings % TURN
        bearings, ranges = np.concatenate([bearings - TURN, bearings, bearings + TURN]), np.tile(ranges, 3)
    order = np.argsort(bearings, kind="stable")
    after = np.clip(np.searchsorted(bearings[order], wanted), 1, max(len(order) - 1, 1))
    pairs = order[np.minimum(np.stack([after - 1, after]), len(order) - 1)]
    apart = np.abs(bearings[pairs] - wanted)
    closer = apart.argmin(axis=0)[None]
    found = np.take_along_axis(pairs, closer, axis=0)[0]
    near = np.take_along_axis(apart, closer, axis=0)[0] <= 0.75 * max(spacing, abs(beams.step))
    return np.where(near, ranges[found], np.float32(np.nan))


def deskewed(scans: Scans, motion: np.ndarray, beams: Beams, lidar: LidarConfig) -> np.ndarray:
    """Ranges (N, B) as if all beams of a scan had been taken at its stamp.

    ``motion`` (N, 3) is how far the base moved from the stamp to the last beam, in the base frame at the stamp; what is
    not known moves nothing. Scans that this changes by less than a tenth of a beam and a centimetre stay as they are.
    """
    ranges = onto(scans, beams)
    motion = np.nan_to_num(motion)
    moved = (np.abs(motion[:, 2]) > 0.1 * abs(beams.step)) | (np.hypot(motion[:, 0], motion[:, 1]) > 0.01)
    for n in np.flatnonzero(moved):
        values, own = scans.ranges[n, : scans.counts[n]], scans.start[n] + scans.step[n] * np.arange(scans.counts[n])
        bearings, reach = carried(own, values, motion[n], lidar)
        ranges[n] = nearest(bearings, reach, beams, abs(scans.step[n]))
    return ranges


def carried(
    bearings: np.ndarray, ranges: np.ndarray, motion: np.ndarray, lidar: LidarConfig
) -> tuple[np.ndarray, np.ndarray]:
    """Bearings and ranges (n,) of a scan's end points seen from where the lidar was at the first beam.

    A beam that did not return has a direction only.
    """
    sign = -1.0 if lidar.upside_down else 1.0
    part = np.linspace(0, 1, len(bearings))[:, None] * motion
    # The lidar at each beam, seen from the lidar at the first.
    mount = np.array(lidar.mount)
    sensor = se2.relative(mount, se2.compose(part, mount))
    direction = sensor[:, 2] + sign * bearings
    returned = np.isfinite(ranges)
    reach = np.where(returned, ranges, 0.0)
    x, y = sensor[:, 0] + reach * np.cos(direction), sensor[:, 1] + reach * np.sin(direction)
    seen = np.where(returned, np.arctan2(y, x), direction)
    # Near the old bearing, so that the order of beams survives the cut at pi.
    seen = bearings + se2.wrap(sign * seen - bearings)
    return seen, np.where(returned, np.hypot(x, y), ranges).astype(np.float32)


def brought_together(scans: Scans, report: Report) -> tuple[Scans, Beams]:
    """The scans that can be used, and the beams that they are to be brought to; says what was different."""
    beams = common_beams(scans)
    span = beams.step * (beams.count - 1)
    covered = np.minimum(np.abs(scans.last() - scans.start), abs(span)) / max(abs(span), 1e-9)
    few = (covered < COVERED) & (scans.counts < COVERED * beams.count)
    if few.any():
        sizes = f"{int(scans.counts[few][0])} beams"
        report.add(f"scans that cover less than half of the lidar's {beams.count} beams dropped", sizes, int(few.sum()))
        scans = scans.select(~few)
    other = differing(scans, beams)
    if other.any():
        low, high = int(scans.counts.min()), int(scans.counts.max())
        told = f"{low} to {high}" if low < high else f"{low}"
        kind = f"scans of other beams ({told}) brought to {beams.count} of {math.degrees(abs(beams.step)):.3f} deg"
        report.add(kind, count=int(other.sum()))
    return scans, beams


def with_right_steps(scans: Scans, heading: np.ndarray | None, range_max: float, report: Report) -> Scans:
    """The scans with the step that is right where ``angle_increment`` disagrees with ``angle_max`` and the count.

    A whole turn decides; else what makes walls straight; else the turns seen in the scans against the odometry's
    ``heading`` (N,), radians; else the increment is taken and the note says so.
    """
    said, gaps = scans.step, np.maximum(scans.counts - 1, 1)
    with np.errstate(invalid="ignore"):
        implied = (scans.end - scans.start) / gaps
    usable = np.isfinite(implied) & (np.abs(implied) > 1e-6) & (np.abs(implied) * gaps < 1.01 * TURN)
    impossible = (np.abs(said) * gaps > 1.003 * TURN + np.abs(said)) | (np.abs(said) < 1e-6) | ~np.isfinite(said)
    # More than a beam and a half at the far end: some drivers count angle_max one beam further.
    odd = (np.abs(said - implied) * gaps > 1.5 * np.abs(said)) | impossible
    odd &= scans.counts > 1
    if not odd.any():
        return scans
    closing = np.copysign(TURN / scans.counts, np.where(impossible & usable, implied, said))
    step, how = said.copy(), np.full(len(scans), "", object)
    whole, told = _whole_turn(implied, scans.counts) & usable, _whole_turn(said, scans.counts) & ~impossible
    for these, value, words in (
        (odd & told & ~whole, said, "angle_increment is taken: it makes a whole turn"),
        (odd & whole & ~told, implied, "angle_max is taken: it makes a whole turn"),
        (odd & impossible & ~whole & usable, implied, "angle_max is taken: the increment spans more than a turn"),
        (odd & impossible & ~whole & ~usable, closing, "one turn is taken: the increment spans more"),
    ):
        step[these], how[these] = value[these], words
    left = odd & (how == "")
    if left.any():
        wins, words = _by_both(scans, left, implied, heading, range_max)
        step[left], how[left] = np.where(wins, implied, said)[left], words
    for words in dict.fromkeys(how[odd]):
        these = np.flatnonzero(odd & (how == words))
        a = these[0]
        degrees = f"{math.degrees(said[a]):.4f} deg told, {math.degrees(implied[a]):.4f} deg by angle_max and count"
        report.add(f"scans whose angle_increment disagrees with their angles: {words}", degrees, len(these))
    return replace(scans, step=step)


def _whole_turn(step: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """(N,) bool: beams of ``step`` go round once, the last one beside or on the first."""
    spans = np.stack([np.abs(step) * counts, np.abs(step) * (counts - 1)])
    return np.asarray((np.abs(spans - TURN) < 0.006 * TURN).any(axis=0))


def _by_odometry(scans: Scans, said: float, implied: float, heading: np.ndarray, range_max: float) -> float | None:
    """Where between the steps ``said`` (0) and ``implied`` (1) the odometry's turns put it; None if they cannot."""
    beams = turns(scans.ranges, scans.stamps, said, range_max) / said
    turned = se2.wrap(np.diff(heading))
    told = np.isfinite(beams) & np.isfinite(turned)
    beams, turned = beams[told], turned[told]
    if len(beams) < 20 or np.abs(turned).sum() < 2.0:
        return None
    # Turns of the odometry are surer than those in the scans: beams are regressed on them, not they on beams.
    per_radian = (beams * turned).sum() / (turned**2).sum()
    error = np.sqrt(((beams - per_radian * turned) ** 2).mean() / (turned**2).sum()) / max(per_radian**2, 1e-12)
    # A lidar head down turns the other way.
    step = abs(1 / per_radian) if per_radian else math.inf
    return (step - abs(said)) / (abs(implied) - abs(said)) if 3 * error < abs(implied - said) else None


def _by_walls(scans: Scans, said: float, implied: float) -> float | None:
    """Where between the steps ``said`` (0) and ``implied`` (1) straight walls are straight; None if they do not tell.

    Of three points 25 deg apart on a wall the middle one lies off the chord of the outer two, always to the same side,
    if the step is wrong; by how much is linear in the step.
    """
    sags = []
    apart = max(1, round(math.radians(25) / abs(said)))
    if scans.ranges.shape[1] < 3 * apart:
        return None
    for step in (said, implied):
        angle = step * np.arange(scans.ranges.shape[1])
        ranges = np.where(np.isfinite(scans.ranges), scans.ranges, np.nan)
        x, y = ranges * np.cos(angle), ranges * np.sin(angle)
        a, b, c = (np.stack([v[:, k : v.shape[1] - 2 * apart + k] for v in (x, y)]) for k in (0, apart, 2 * apart))
        chord = np.hypot(*(c - a))
        # In shares of the chord, positive towards the lidar.
        sags.append(((c - a)[0] * (b - a)[1] - (c - a)[1] * (b - a)[0]) * np.sign(step) / chord**2)
    straight = np.isfinite(sags[0]) & (np.abs(sags[0] + sags[1]) < 0.06)
    if straight.sum() < 1000:
        return None
    first, second = (float(np.median(sag[straight])) for sag in sags)
    noise = 1.25 * float(np.std(sags[0][straight])) / math.sqrt(straight.sum() / apart)
    return first / (first - second) if abs(first - second) > 3 * noise else None


def _by_both(
    scans: Scans, odd: np.ndarray, implied: np.ndarray, heading: np.ndarray | None, range_max: float
) -> tuple[bool, str]:
    """Whether ``angle_max`` is right and not the increment; and the words for it."""
    # One size of scan, the most frequent.
    size = np.bincount(scans.counts[odd]).argmax()
    rows = np.flatnonzero(odd & (scans.counts == size))
    rows = rows[middle_of(len(rows))]
    these = replace(scans.select(rows), ranges=scans.ranges[rows, :size])
    said, other = float(np.median(these.step)), float(np.median(implied[rows]))
    walls = _by_walls(these, said, other)
    driven = None if heading is None else _by_odometry(these, said, other, heading[rows], range_max)
    for place, words in ((walls, "walls straight"), (driven, "the turns agree with the odometry")):
        if place is not None and abs(place - 0.5) > 0.2:
            return place > 0.5, f"{'angle_max' if place > 0.5 else 'angle_increment'} is taken: it makes {words}"
    return False, "angle_increment is taken, nothing tells which is right"
