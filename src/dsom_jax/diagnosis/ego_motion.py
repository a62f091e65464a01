"""Scans against odometry, without any map: how the lidar sits, and what the odometry does wrong.

Scans give the motion of the sensor (:mod:`dsom_jax.diagnosis.matching`), the odometry that of the base. One follows
from the other by where the sensor is mounted: a turn of the base is the same turn of the sensor, and driving forward
moves it along the direction in which the base's x axis lies in its frame. Whatever breaks this is named here.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from dsom_jax.data import se2
from dsom_jax.data.log import RawLog
from dsom_jax.diagnosis.map_fit import Piece
from dsom_jax.diagnosis.matching import Match, Reference, bearings, match, points_of

STEP = 0.6
"""Seconds between scans that are matched: some decimetres for a robot indoors, whatever its odometry says."""
PAIRS, BLOCKS = 300, 10
MATCHED = 0.5
"""Share of points from which on a match counts."""
LAGS = 90.0
"""Seconds by which clocks may differ."""

OdometryVariant = Literal["as is", "mirrored", "yaw negated"]
VARIANTS: dict[OdometryVariant, tuple[float, float]] = {"as is": (1, 1), "mirrored": (-1, -1), "yaw negated": (1, -1)}
"""Signs of y and of the heading of the odometry's poses."""


class Steps(NamedTuple):
    """Pairs of scans that were matched, in blocks of consecutive ones.

    Attributes:
        pairs: (n, 2) indices of the scans.
        moves: (n, 3) pose of the second sensor in the frame of the first.
        information: (n, 3, 3) of each move.
        good: (n,) bool, matches that count.
        block: (n,) number of the block.
    """

    pairs: np.ndarray
    moves: np.ndarray
    information: np.ndarray
    good: np.ndarray
    block: np.ndarray


@dataclass(frozen=True)
class EgoMotion:
    """How the odometry relates to the scans.

    Attributes:
        variant: the signs of the odometry under which it agrees best with the scans.
        agreement: share of the matched steps that it explains then, ``as_is`` with its own signs; NaN where none moves.
        lag: seconds to add to a scan's stamp to find its odometry.
        lag_gain: how much less the turns differ with ``lag`` than without, 0 to 1.
        turn_scale: turn of the scans per turn of the odometry.
        distance_scale: distance of the scans per distance of the odometry.
        yaw: heading of the sensor on the base, radians.
        yaw_sd: its standard error.
        scale_sd: standard error of ``distance_scale``.
        steps: number of matched steps.
        moving: how many of them move.
        frozen: share of the moving steps in which the odometry stands still.
    """

    variant: OdometryVariant
    agreement: float
    as_is: float
    lag: float
    lag_gain: float
    turn_scale: float
    distance_scale: float
    yaw: float
    yaw_sd: float
    scale_sd: float
    steps: int
    moving: int
    frozen: float


def matched_steps(log: RawLog, pairs: int = PAIRS, blocks: int = BLOCKS) -> Steps:
    """Matches of scans ``STEP`` seconds apart, in blocks spread over the log."""
    steps = np.diff(log.stamps)
    usual = np.median(steps[steps > 0]) if (steps > 0).any() else STEP
    stride = max(1, round(STEP / usual))
    chain = np.arange(0, len(log), stride)
    length = min(pairs // blocks, len(chain) - 1)
    starts = np.unique(np.linspace(0, max(len(chain) - 1 - length, 0), blocks).astype(int))
    angles, rows = bearings(log.lidar), []
    taken: set[int] = set()
    for number, start in enumerate(starts):
        for k in range(start, start + length):
            if k not in taken:
                taken.add(k)
                i, j = int(chain[k]), int(chain[k + 1])
                found = match(Reference(log.ranges[i], angles), points_of(log.ranges[j], angles, 0.1))
                rows.append((i, j, number, found or Match(np.zeros(3), np.zeros((3, 3)), 0.0)))
    return Steps(
        np.array([row[:2] for row in rows], int).reshape(-1, 2),
        np.array([row[3].move for row in rows]).reshape(-1, 3),
        np.array([row[3].information for row in rows]).reshape(-1, 3, 3),
        np.array([row[3].share > MATCHED for row in rows], bool),
        np.array([row[2] for row in rows], int),
    )


def odometry_moves(log: RawLog, steps: Steps, lag: float = 0.0, variant: OdometryVariant = "as is") -> np.ndarray:
    """(n, 3) what the odometry says of the steps; NaN where the log does not cover the stamps."""
    poses = log.odometry * [1, *VARIANTS[variant]]
    if lag == 0:
        return se2.relative(poses[steps.pairs[:, 0]], poses[steps.pairs[:, 1]])
    stamps, first = np.unique(log.stamps, return_index=True)
    at = log.stamps[steps.pairs] + lag
    ends = se2.interpolate(stamps, poses[first], at.ravel()).reshape(*at.shape, 3)
    moves = se2.relative(ends[:, 0], ends[:, 1])
    moves[((at < stamps[0]) | (at > stamps[-1])).any(1) | (at[:, 1] <= at[:, 0])] = np.nan
    return moves


def turns_costs(scan: np.ndarray, odometry: np.ndarray, fine: bool) -> np.ndarray:
    """(n,) squared differences of turns, their common scale fitted, in units of what wheels slip; at most 1.

    NaN where the odometry (n,) is, and all of them where it covers less than a third of the steps.
    """
    known = np.isfinite(odometry)
    if known.sum() < max(15, len(scan) / 3):
        return np.full(len(scan), np.nan)
    slope = np.clip(np.nansum(scan * odometry) / max(np.nansum(odometry**2), 1e-9), 0.7, 1.4)
    unit = 0.03 + 0.08 * np.abs(scan) if fine else 0.1 + 0.2 * np.abs(scan)
    return np.minimum(((scan - slope * odometry) / unit) ** 2, 1.0)


def mean_cost(costs: np.ndarray) -> float:
    """Mean of what is known, 1 if nothing is."""
    known = costs[np.isfinite(costs)]
    return float(known.mean()) if len(known) else 1.0


def find_lag(log: RawLog, steps: Steps, variant: OdometryVariant) -> tuple[float, float]:
    """(lag, gain): the shift of the clock under which the turns agree best, and by which share the cost falls.

    The odometry is looked up at the scans' shifted stamps, and the scans' own heading at the odometry's: where stamps
    lie seconds apart only the one of the two that was not interpolated when the log was written is sharp. The gain is
    0 where the difference is within five standard errors of chance.
    """
    turning = _select(steps, steps.good & (np.abs(steps.moves[:, 2]) > 0.06))
    if len(turning.pairs) < 15:
        return 0.0, 0.0
    dt = float(np.median(np.diff(np.unique(log.stamps))))
    stamps, heading = scan_heading(log, steps)
    sign = VARIANTS[variant][1]

    def odometry_moved(lag: float, fine: bool = True) -> np.ndarray:
        return turns_costs(turning.moves[:, 2], odometry_moves(log, turning, lag, variant)[:, 2], fine)

    def scans_moved(lag: float) -> np.ndarray:
        at = np.interp(log.stamps[steps.pairs] - lag, stamps, heading, left=np.nan, right=np.nan)
        own = sign * se2.wrap(np.diff(log.odometry[steps.pairs, 2], axis=1)[:, 0])
        return turns_costs(own, np.diff(at, axis=1)[:, 0], True)[np.abs(own) > 0.06]

    coarse = np.arange(-LAGS, LAGS, max(0.25, min(dt / 2, 1.0)))
    around = [float(min(coarse, key=lambda lag: mean_cost(odometry_moved(lag, False)))), 0.0]
    found = [(0.0, 0.0)]
    for costs in (odometry_moved, scans_moved):
        near = np.concatenate([start + np.arange(-1.5, 1.51, 0.1) for start in around])
        best = float(min(near, key=lambda lag: mean_cost(costs(lag))))
        best = float(min(best + np.arange(-0.1, 0.11, 0.02), key=lambda lag: mean_cost(costs(lag))))
        here, there = costs(0.0), costs(best)
        gained = (here - there)[np.isfinite(here - there)]
        if len(gained) >= 15 and gained.mean() > 5 * gained.std() / np.sqrt(len(gained)):
            found.append((best, float(gained.mean() / np.nanmean(here))))
    return max(found, key=lambda f: f[1])


def scan_heading(log: RawLog, steps: Steps) -> tuple[np.ndarray, np.ndarray]:
    """Stamps (m,) ascending and heading (m,) that the matches add up to; NaN where the chain is broken."""
    stamps, heading = [-np.inf], [np.nan]
    for pair, move, good in zip(steps.pairs, steps.moves, steps.good, strict=True):
        start, stop = log.stamps[pair]
        if start != stamps[-1]:
            stamps += [max(start, stamps[-1]) - 1e-9, max(start, stamps[-1])]
            heading += [np.nan, 0.0]
        stamps.append(max(stop, stamps[-1]))
        heading.append(heading[-1] + move[2] if good and stop > start else np.nan)
        if np.isnan(heading[-1]):
            stamps.append(stamps[-1])
            heading.append(0.0)
    return np.array(stamps[1:]), np.array(heading[1:])


def _select(steps: Steps, keep: np.ndarray) -> Steps:
    """The steps ``keep``."""
    return Steps(*(column[keep] for column in steps))


class LinearFit(NamedTuple):
    """Linear fit of the sensor's moves to the odometry's: yaw, scales, and the share of steps that agree with it."""

    yaw: float
    distance_scale: float
    turn_scale: float
    agreement: float
    sd: float


def fit_mount(steps: Steps, odometry: np.ndarray) -> LinearFit:
    """Yaw of the sensor and scale of distances from the steps (n) and the odometry's moves (n, 3).

    The sensor's translation is R(-yaw) [s d + (R(turn) - 1) m] with the base's move d and the mount m: linear in
    s (cos yaw, sin yaw) and in R(-yaw) m. Reweighted least squares, every step in the metric of its own match.
    """
    turn = steps.moves[:, 2]
    d, c, s = odometry[:, :2], np.cos(turn) - 1, np.sin(turn)
    rows = np.zeros((len(turn), 2, 4))
    rows[:, 0, 0], rows[:, 0, 1], rows[:, 1, 0], rows[:, 1, 1] = d[:, 0], d[:, 1], d[:, 1], -d[:, 0]
    rows[:, 0, 2], rows[:, 0, 3], rows[:, 1, 2], rows[:, 1, 3] = c, -s, s, c
    metric = steps.information[:, :2, :2] / np.maximum(np.trace(steps.information[:, :2, :2], axis1=1, axis2=2), 1e-9
                                                       )[:, None, None]  # fmt: skip
    prior = np.diag([1e-6, 1e-6, 0.05, 0.05]) * len(turn) * 0.05
    weight, found = np.ones(len(turn)), np.array([1.0, 0, 0, 0])
    tolerance = 0.08 + 0.12 * np.hypot(*d.T)
    for _ in range(20):
        normal = np.einsum("nij,n,nik,nkl->jl", rows, weight, metric, rows) + prior
        found = np.linalg.solve(normal, np.einsum("nij,n,nik,nk->j", rows, weight, metric, steps.moves[:, :2]))
        off = steps.moves[:, :2] - rows @ found
        size = np.sqrt(2 * np.maximum(np.einsum("ni,nij,nj->n", off, metric, off), 0))
        weight = 1 / (1 + (size / (0.5 * tolerance)) ** 2) ** 2
    scale = float(np.hypot(*found[:2]))
    angles = np.abs(odometry[:, 2]) > 0.08
    ratio = float(np.median(turn[angles] / odometry[angles, 2])) if angles.sum() >= 10 else np.nan
    right = (size < tolerance) & (np.abs(turn - odometry[:, 2]) < 0.05 + 0.2 * np.abs(turn))
    used = np.linalg.inv(normal) * (weight * size**2).sum() / max(weight.sum(), 1) / 2
    sd = float(np.sqrt(np.trace(used[:2, :2]) / 2)) / max(scale, 1e-3)
    return LinearFit(float(np.arctan2(found[1], found[0])), scale, ratio, float(right.mean()), sd)


def moving(steps: Steps) -> np.ndarray:
    """(n,) bool, steps in which the scans say for sure that the robot moved: 5 cm across some wall, or 3 deg."""
    metric = steps.information[:, :2, :2]
    across = np.einsum("ni,nij,nj->n", steps.moves[:, :2], metric, steps.moves[:, :2])
    size = np.sqrt(across / np.maximum(np.trace(metric, axis1=1, axis2=2), 1e-9))
    return steps.good & ((size > 0.05) | (np.abs(steps.moves[:, 2]) > 0.05))


def ego_motion(log: RawLog, steps: Steps) -> EgoMotion:
    """What the odometry has to be corrected by to agree with the scans."""
    went = _select(steps, moving(steps))
    own = odometry_moves(log, went)
    still = (np.hypot(own[:, 0], own[:, 1]) < 0.01) & (np.abs(own[:, 2]) < 0.01)
    if len(still) < 15 or still.mean() > 0.9:
        share = float(still.mean()) if len(still) else np.nan
        return EgoMotion("as is", np.nan, np.nan, 0.0, 0.0, np.nan, np.nan, np.nan, np.nan, np.nan,
                        int(steps.good.sum()), len(still), share)  # fmt: skip
    driven = _select(went, ~still)
    found: dict[OdometryVariant, tuple[float, float, LinearFit]] = {}
    for variant in VARIANTS:
        lag, gain = find_lag(log, driven, variant)
        # A lag is believed where it explains the turns; otherwise the search only finds luck.
        lag = lag if gain > 0.1 else 0.0
        moves = odometry_moves(log, driven, lag, variant)
        known = np.isfinite(moves).all(1)
        found[variant] = (lag, gain, fit_mount(_select(driven, known), moves[known]))
    best: OdometryVariant = max(found, key=lambda v: found[v][2].agreement + 0.1 * (v == "as is"))
    lag, gain, fit = found[best]
    plain = fit_mount(driven, own[~still])
    return EgoMotion(best, fit.agreement, plain.agreement, lag, gain, fit.turn_scale, fit.distance_scale, fit.yaw,
                     fit.sd, fit.sd, int(steps.good.sum()), len(went.pairs), float(still.mean()))  # fmt: skip


def pieces_of(log: RawLog, steps: Steps, motion: EgoMotion, way: float = 5.0) -> list[Piece]:
    """The blocks of matched steps as pieces of the drive; the first ``way`` metres of each are for the search."""
    trusted = motion.agreement > 0.7
    odometry = odometry_moves(log, steps, motion.lag, motion.variant)
    # The odometry, carried over to the sensor as the scans say.
    carried = np.column_stack([
        motion.distance_scale * odometry[:, :2] @ rotation(-motion.yaw).T, odometry[:, 2]
    ])  # fmt: skip
    pieces = []
    for number in np.unique(steps.block):
        chain: list[np.ndarray] = [np.zeros(3)]
        own = np.flatnonzero(steps.block == number)
        for k in own:
            guess = carried[k] if trusted and np.isfinite(carried[k]).all() else None
            move = _joined(steps.moves[k], steps.information[k], guess) if steps.good[k] else guess
            if move is None:
                break
            chain.append(se2.compose(chain[-1], move))
        poses = np.array(chain)
        gone = np.concatenate([[0], np.cumsum(np.hypot(*np.diff(poses[:, :2], axis=0).T))])
        searched = int(np.clip(np.searchsorted(gone, way) + 1, 4, 12))
        if len(poses) >= 8:
            scans = np.append(steps.pairs[own, 0], steps.pairs[own[-1], 1])[: len(poses)]
            pieces.append(Piece(scans, poses, min(searched, len(poses) // 2)))
    return pieces


def _joined(move: np.ndarray, information: np.ndarray, guess: np.ndarray | None) -> np.ndarray:
    """The move (3,) of a match, held by the odometry's ``guess`` in directions in which the scans say little."""
    if guess is None:
        return move
    size, turn = np.hypot(*guess[:2]), abs(guess[2])
    prior = np.diag([1 / (0.03 + 0.1 * size) ** 2] * 2 + [1 / (0.02 + 0.15 * turn) ** 2])
    # One in ten neighbouring points counts, each with 5 cm.
    own = information / (10 * 0.05**2)
    off = guess - move
    off[2] = se2.wrap(off[2])
    return move + np.linalg.solve(own + prior, prior @ off)


def rotation(angle: float) -> np.ndarray:
    """(2, 2) matrix of a turn."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s], [s, c]])
