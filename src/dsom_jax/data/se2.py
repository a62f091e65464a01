"""Poses (x, y, theta) of logs in float64 NumPy: odometry far from its origin would lose centimetres in float32."""

from __future__ import annotations

import numpy as np


def wrap(angle: np.ndarray) -> np.ndarray:
    """Angle in [-pi, pi), radians."""
    return (angle + np.pi) % (2 * np.pi) - np.pi


def compose(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Pose ``b`` of the frame ``a`` in the parent frame; shapes (..., 3) broadcast."""
    c, s = np.cos(a[..., 2]), np.sin(a[..., 2])
    x = a[..., 0] + c * b[..., 0] - s * b[..., 1]
    y = a[..., 1] + s * b[..., 0] + c * b[..., 1]
    return np.stack([x, y, wrap(a[..., 2] + b[..., 2])], axis=-1)


def relative(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Pose ``b`` seen from ``a``; shapes (..., 3) broadcast."""
    c, s = np.cos(a[..., 2]), np.sin(a[..., 2])
    x, y = b[..., 0] - a[..., 0], b[..., 1] - a[..., 1]
    return np.stack([c * x + s * y, c * y - s * x, wrap(b[..., 2] - a[..., 2])], axis=-1)


def inverse(a: np.ndarray) -> np.ndarray:
    """The pose that composed with ``a`` gives the identity."""
    return relative(a, np.zeros(3))


def interpolate(stamps: np.ndarray, poses: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Poses (M, 3) at times ``at`` (M,), linear between the rows of ``poses`` (N, 3) at sorted ``stamps`` (N,)."""
    heading = np.unwrap(poses[:, 2])
    columns = [np.interp(at, stamps, column) for column in (poses[:, 0], poses[:, 1], heading)]
    return np.stack([columns[0], columns[1], wrap(columns[2])], axis=-1)
