"""The log-likelihood of a scan at a pose, beam by beam, with bounds for rounded ranges."""

from __future__ import annotations

import numpy as np

from reference import rays, sensor


def bounds(
    occupied: np.ndarray,
    resolution: float,
    x: float,
    y: float,
    heading: float,
    bearings: np.ndarray,
    readings: list[float],
    rounding: float,
    model: dict[str, float],
) -> tuple[float, float, float]:
    """Least, nominal and greatest log-likelihood at (x, y) in cells if expected ranges are off by ``rounding`` m.

    A beam that passes a corner within 2e-3 cells may see anything from there on: it gets the widest bounds.
    """
    total = np.zeros(3)
    top = model["top"]
    for bearing, reading in zip(bearings, readings, strict=True):
        reach, clearance = rays.cast(occupied, x, y, heading + bearing)
        expected = reach * resolution if reach * resolution < top else np.inf
        near = min(expected, top) + rounding * np.linspace(-1, 1, 9)
        options = [float(v) for v in near if 0 <= v < top] + ([np.inf] if near[-1] >= top else [])
        if clearance < 2e-3:
            options = [*np.linspace(0.0, top, 200, endpoint=False), np.inf]
        terms = [sensor.beam_log(reading, p, **model) for p in options]
        total += [min(terms), sensor.beam_log(reading, expected, **model), max(terms)]
    return total[0], total[1], total[2]
