"""Small drawings of drives as SVG: a map, the true path and what one run answered, in the colours of the page."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from dsom_jax.judging.by_drive import Worst
from dsom_jax.view.picture import broken
from dsom_jax.view.story import Plan

SIDE = 256
"""Cells along the longer side of a drawn map; finer ones are joined."""
_FAR = 1e6  # centimetres; an answer beyond is drawn there, out of sight


class Sheet(NamedTuple):
    """What is drawn on: centimetres from the upper left corner (x0, y1) of the known part of a map, metres."""

    x0: float
    y1: float
    width: int
    height: int

    def points(self, xy: np.ndarray) -> np.ndarray:
        """(n, 2) whole centimetres on the sheet of points (n, 2) of the map frame, metres; NaN stays."""
        return np.clip(np.rint(100 * (np.asarray(xy, float) - (self.x0, self.y1)) * (1, -1)), -_FAR, _FAR)

    @property
    def unit(self) -> int:
        """Radius of a mark, centimetres."""
        return max(1, max(self.width, self.height) // 45)


def sheet_of(plan: Plan) -> Sheet:
    """A sheet for what is known of a map."""
    corners = plan.corners()
    low, high = corners.min(0), corners.max(0)
    width, height = (max(1, math.ceil(100 * v)) for v in high - low)
    return Sheet(float(low[0]), float(high[1]), width, height)


def map_drawing(plan: Plan, sheet: Sheet) -> str:
    """The map as two paths, in cells, with what brings them onto the sheet."""
    fold = -(-max(plan.occupied.shape) // SIDE)
    known, walls = (_folded(cells, fold) for cells in (plan.occupied | plan.free, plan.occupied))
    cell, (x, y) = 100 * plan.resolution * fold, sheet.points(np.asarray(plan.origin)[None, :2])[0]
    c, s = cell * math.cos(plan.origin[2]), cell * math.sin(plan.origin[2])
    matrix = " ".join(f"{v:.6g}" for v in (c, -s, -s, -c, x, y))
    return (f'<g transform="matrix({matrix})"><path class="floor" d="{_rectangles(known)}"/>'
            f'<path class="walls" d="{_rectangles(walls)}"/></g>')  # fmt: skip


def _folded(cells: np.ndarray, fold: int) -> np.ndarray:
    """Cells (H, W) in blocks of ``fold``, true where any of the block is."""
    rows, columns = (-(-n // fold) for n in cells.shape)
    whole = np.zeros((rows * fold, columns * fold), bool)
    whole[: cells.shape[0], : cells.shape[1]] = cells
    return np.asarray(whole.reshape(rows, fold, columns, fold).any((1, 3)))


def _rectangles(cells: np.ndarray) -> str:
    """Path around true cells (H, W): equal stretches of neighbouring rows are one rectangle."""
    open_since: dict[tuple[int, int], int] = {}
    done = []
    for i, row in enumerate([*cells, np.zeros(cells.shape[1], bool)]):
        edges = np.flatnonzero(np.diff(np.r_[0, row.astype(np.int8), 0]))
        here = {(int(a), int(b)) for a, b in edges.reshape(-1, 2)}
        for a, b in sorted(set(open_since) - here):
            start = open_since.pop((a, b))
            done.append(f"M{a} {start}h{b - a}v{i - start}h{a - b}z")
        for stretch in here:
            open_since.setdefault(stretch, i)
    return "".join(done)


def truth_drawing(truth: np.ndarray, kidnapped: np.ndarray, sheet: Sheet, most: int) -> str:
    """The true path (T, 3); a cross where the robot was taken away, a ring where it was put down."""
    marks, r, at = [], sheet.unit, sheet.points(truth[:, :2])
    for t in np.flatnonzero(kidnapped):
        if t and np.isfinite(at[t - 1 : t + 1]).all():
            (x, y), (u, v) = at[t - 1 : t + 1].astype(int).tolist()
            marks.append(f'<path class="carried" d="M{x} {y}L{u} {v}"/><path class="taken" d="M{x - r} {y - r}'
                         f'l{2 * r} {2 * r}m0 {-2 * r}l{-2 * r} {2 * r}"/><circle class="taken" cx="{u}" cy="{v}"'
                         f' r="{r}"/>')  # fmt: skip
    return f'<path class="true" d="{_line(truth, kidnapped, sheet, most)}"/>{"".join(marks)}'


def run_drawing(worst: Worst, kidnapped: np.ndarray, sheet: Sheet, most: int) -> str:
    """What a run answered: a line where it is one, and a dot for each answer that is wrong."""
    wrong = sheet.points(worst.poses[worst.wrong, :2])
    wrong = wrong[np.isfinite(wrong).all(1)][:: _step(len(wrong), most)].astype(int)
    dots = "".join(f"M{x} {y}h0" for x, y in wrong.tolist())
    return f'<path class="said" d="{_line(worst.poses, kidnapped, sheet, most)}"/><path class="wrong" d="{dots}"/>'


def _step(count: int, most: int) -> int:
    return max(1, -(-count // most))


def _line(poses: np.ndarray, kidnapped: np.ndarray, sheet: Sheet, most: int) -> str:
    """Path through poses (T, 3) with gaps at jumps, of about ``most`` points; the ends of its pieces are kept.

    An answer that jumps about has more pieces than that, and evenly chosen ones are drawn.
    """
    at = sheet.points(broken(poses, kidnapped))
    gap = np.isnan(at).any(1)
    before, after = np.r_[True, gap[:-1]], np.r_[gap[1:], True]
    keep = before | after | (np.arange(len(at)) % _step(len(at), most) == 0)
    # A point between two gaps is no line.
    keep &= ~gap & ~(before & after)
    piece = np.cumsum(before & keep)
    keep &= piece % _step(int(piece[-1]), most) == 0
    return "".join(
        f"{'M' if first else 'L'}{x} {y}"
        for first, (x, y) in zip(before[keep].tolist(), at[keep].astype(int).tolist(), strict=True)
    )
