"""Line drawings as cells, and which cells are floor: pure functions on arrays, whatever the file format."""

from __future__ import annotations

import numpy as np
from scipy import ndimage


def touched_cells(segments: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """(H, W) bool: the cells that segments (N, 2, 2) run through; ends are (x, y) in cells from the corner of (0, 0).

    Every cell that a line enters is marked, so that the marked cells of a line touch edge to edge: neither a ray nor
    :func:`regions` slips through a slanting wall. What lies outside of the shape is left out.
    """
    cells = np.zeros(shape, bool)
    for start, end in np.asarray(segments, float):
        x, y = np.floor(_middles(start, end)).astype(int)
        keep = (x >= 0) & (x < shape[1]) & (y >= 0) & (y < shape[0])
        cells[y[keep], x[keep]] = True
    return cells


def _middles(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """(2, K) points of a segment, one inside of each cell that it enters."""
    step = end - start
    # Parameters at which the line crosses the edges of cells: between two of them it is inside of one cell.
    crossings = [np.array([0.0, 1.0])]
    for axis in np.flatnonzero(step):
        low, high = sorted((start[axis], end[axis]))
        crossings.append((np.arange(np.floor(low) + 1, np.ceil(high)) - start[axis]) / step[axis])
    t = np.sort(np.concatenate(crossings))
    return start[:, None] + step[:, None] * (t[1:] + t[:-1]) / 2


def regions(occupied: np.ndarray) -> tuple[np.ndarray, int]:
    """(H, W) number of the region of each cell, 1..N, 0 where occupied; and N. Neighbours share an edge."""
    labels, count = ndimage.label(~np.asarray(occupied, bool))
    return labels, int(count)


def reachable(occupied: np.ndarray, cell: tuple[int, int]) -> np.ndarray:
    """(H, W) bool: what a robot on ``cell`` (i, j) can drive to; nothing if the cell is a wall or outside."""
    labels, _ = regions(occupied)
    i, j = cell
    if not (0 <= i < labels.shape[0] and 0 <= j < labels.shape[1]) or not labels[i, j]:
        return np.zeros(labels.shape, bool)
    return labels == labels[i, j]


def enclosed(occupied: np.ndarray, clearance: float) -> np.ndarray:
    """(H, W) bool: regions that do not reach the border, and somewhere are ``clearance`` cells away from every wall.

    The second leaves out the hollow of walls that are drawn as two lines.
    """
    labels, count = regions(occupied)
    border = np.unique(np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]]))
    room = ndimage.maximum(ndimage.distance_transform_edt(labels > 0), labels, np.arange(count + 1))
    keep = np.asarray(room) >= clearance
    keep[0], keep[border] = False, False
    return keep[labels]
