"""Algorithm 1 of the paper, line by line, one particle after the other."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np


def adam_mcl(
    rng: np.random.Generator,
    poses: np.ndarray,
    w_norm: np.ndarray,
    w: np.ndarray,
    t_cut: float,
    move: Callable[[np.ndarray], np.ndarray],
    weigh: Callable[[np.ndarray], np.ndarray],
    draw_from_pm: Callable[[int], np.ndarray],
) -> tuple[np.ndarray, np.ndarray, int]:
    """One update of P_{t-1} = (poses, w_norm, w in units of w*): new poses, new w, and the size of H."""
    high, low = [], []
    for i in range(len(poses)):
        trust = w[i]
        if trust > t_cut or rng.random() < trust:
            high.append(i)
        else:
            low.append(i)
    new_poses, new_w = [], []
    # MCL for H
    if high:
        share = w_norm[high] / w_norm[high].sum()
        ancestors = [high[rng.choice(len(high), p=share)] for _ in high]
        moved = move(poses[ancestors])
        for pose, weight in zip(moved, weigh(moved), strict=True):
            new_poses.append(pose)
            new_w.append(weight)
    # Dual MCL for L: the weight of one of the three nearest moved particles, by inverse distance
    everyone = move(poses)
    for fresh in draw_from_pm(len(low)):
        distances = []
        for other in everyone:
            turn = (fresh[2] - other[2] + np.pi) % (2 * np.pi) - np.pi
            distances.append(np.sqrt((fresh[0] - other[0]) ** 2 + (fresh[1] - other[1]) ** 2 + turn**2))
        nearest = np.argsort(distances)[:3]
        closeness = 1 / (np.array(distances)[nearest] + 1e-6)
        predecessor = nearest[rng.choice(len(nearest), p=closeness / closeness.sum())]
        new_poses.append(fresh)
        new_w.append(w[predecessor])
    return np.array(new_poses), np.array(new_w), len(high)
