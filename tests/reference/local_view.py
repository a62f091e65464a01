"""Slow, obvious crops of a map around a pose."""

from __future__ import annotations

import math

import numpy as np


def occupancy_at(occupied: np.ndarray, x: float, y: float, resolution: float) -> float:
    """Bilinear between cell centres at (x, y) metres from the map's lower-left corner; nothing outside is occupied."""
    total = 0.0
    for i in range(occupied.shape[0]):
        for j in range(occupied.shape[1]):
            away_x, away_y = (abs(v / resolution - (n + 0.5)) for v, n in ((x, j), (y, i)))
            if occupied[i, j] and away_x < 1 and away_y < 1:
                total += (1 - away_x) * (1 - away_y)
    return total


def crop(occupied: np.ndarray, resolution: float, pose: np.ndarray, cells: int, cell: float) -> np.ndarray:
    """(cells, cells) picture around ``pose``, which is in the map's own frame: i to the robot's left, j ahead."""
    picture = np.zeros((cells, cells))
    for i in range(cells):
        for j in range(cells):
            ahead, left = (j + 0.5 - cells / 2) * cell, (i + 0.5 - cells / 2) * cell
            x = pose[0] + math.cos(pose[2]) * ahead - math.sin(pose[2]) * left
            y = pose[1] + math.sin(pose[2]) * ahead + math.cos(pose[2]) * left
            picture[i, j] = occupancy_at(occupied, x, y, resolution)
    return picture
