"""The log-likelihood of a scan at a place for many headings, beam by beam, with bounds for rounded ranges."""

from __future__ import annotations

import numpy as np

from reference import rays, sensor


def terms(reading: float, reach: float, clearance: float, rounding: float, model: dict) -> tuple[float, float]:
    """Least and greatest log-likelihood of a reading if the expected range (m) is off by up to ``rounding``.

    A beam that passes a corner within 2e-3 cells may see anything: it gets the widest bounds.
    """
    top = model["top"]
    near = min(reach, top) + rounding * np.linspace(-1, 1, 9)
    options = [float(v) for v in near if 0 <= v < top] + ([np.inf] if near[-1] >= top else [])
    if clearance < 2e-3:
        options = [*np.linspace(0.0, top, 200, endpoint=False), np.inf]
    values = [sensor.beam_log(reading, p, **model) for p in options]
    return min(values), max(values)


def bounds(
    occupied: np.ndarray,
    resolution: float,
    place: tuple[float, float],
    directions: np.ndarray,
    columns: np.ndarray,
    readings: np.ndarray,
    rounding: float,
    model: dict,
) -> np.ndarray:
    """(K, 2) bounds at ``place`` (x, y) in cells; beam b of heading k looks along ``directions[columns[b, k]]``."""
    seen = [rays.cast(occupied, *place, angle) for angle in directions]
    table = np.array([[terms(z, r * resolution, c, rounding, model) for r, c in seen] for z in readings])
    return table[np.arange(len(readings))[:, None], columns].sum(0)
