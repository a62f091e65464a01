"""SE(2) as 3 x 3 homogeneous matrices in float64."""

from __future__ import annotations

import numpy as np


def matrix(pose: np.ndarray) -> np.ndarray:
    """(..., 3, 3) matrix that takes points of the pose's own frame to its parent frame."""
    pose = np.asarray(pose, np.float64)
    c, s, zero, one = np.cos(pose[..., 2]), np.sin(pose[..., 2]), np.zeros(pose.shape[:-1]), np.ones(pose.shape[:-1])
    rows = [np.stack([c, -s, pose[..., 0]], -1), np.stack([s, c, pose[..., 1]], -1), np.stack([zero, zero, one], -1)]
    return np.stack(rows, -2)


def compose(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Pose ``b`` of the frame ``a`` in the parent frame of ``a``, (..., 3)."""
    product = matrix(a) @ matrix(b)
    theta = np.arctan2(product[..., 1, 0], product[..., 0, 0])
    return np.stack([product[..., 0, 2], product[..., 1, 2], theta], -1)


def angle_gap(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Absolute difference of angles on the circle, radians."""
    return np.abs(np.angle(np.exp(1j * (np.asarray(a, np.float64) - np.asarray(b, np.float64)))))
