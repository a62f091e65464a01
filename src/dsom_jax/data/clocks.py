"""Do the clocks of the lidar and of the odometry agree? The turns of the robot are in both."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

RATE = 20.0
"""Hz at which the turn rates are compared."""
_LONGEST = 200_000
"""Samples at most; of longer logs the beginning."""
LEAST = 0.1
"""Seconds below which an offset is not worth a word."""


@dataclass(frozen=True)
class Offset:
    """Seconds to add to the stamps of the scans; correlation of the turn rates with that, and with them as they are."""

    seconds: float
    correlation: float
    as_stamped: float

    @property
    def says(self) -> str:
        """For a note."""
        return f"turn rates correlate by {self.correlation:.2f} with it, by {self.as_stamped:.2f} without"


def find_offset(stamps: np.ndarray, turned: np.ndarray, rows: np.ndarray) -> Offset | None:
    """What aligns ``turned`` (N - 1,), radians between scans at ``stamps`` (N,), with odometry rows (M, 4).

    None where the turns do not tell: too few, too alike all along, or none of the two sees what the other does; and
    where the stamps fit as they are, within 0.1 s and what the noise of the turns allows.
    """
    told = np.isfinite(turned) & (np.diff(stamps) > 0)
    if told.sum() < 20 or len(rows) < 20:
        return None
    starts, ends, turned = stamps[:-1][told], stamps[1:][told], turned[told]
    heading = np.unwrap(rows[:, 3])
    coarse = _coarse(starts, ends, turned, rows[:, 0], heading)
    if coarse is None:
        return None

    def misfit(offset: float) -> tuple[float, float]:
        """Mean square of what odometry does not explain, and the correlation."""
        seen = np.interp(ends + offset, rows[:, 0], heading) - np.interp(starts + offset, rows[:, 0], heading)
        norm = np.sqrt((seen**2).sum() * (turned**2).sum())
        gain = (seen * turned).sum() / max((seen**2).sum(), 1e-12)
        return float(((turned - gain * seen) ** 2).mean()), float((seen * turned).sum() / norm) if norm > 0 else 0.0

    around = coarse + np.arange(-0.5, 0.5, 0.01)
    best = float(around[int(np.argmin([misfit(offset)[0] for offset in around]))])
    (left, correlation), (left_now, as_stamped) = misfit(best), misfit(0.0)
    # Neighbouring turns err alike: a tenth of them counts.
    surer = 0.1 * len(turned) * (left_now / max(left, 1e-12) - 1)
    if abs(best) < LEAST or correlation < 0.6 or surer < 8 or left_now < 1.1 * left:
        return None
    return Offset(round(best, 2), correlation, as_stamped)


def _coarse(
    starts: np.ndarray, ends: np.ndarray, turned: np.ndarray, times: np.ndarray, heading: np.ndarray
) -> float | None:
    """Offset in seconds, to a sample, at which the turn rates go together best, whatever the clocks begin with.

    None if another one, more than a second away, does nearly as well.
    """
    scan_rate = _sampled(np.concatenate([starts, ends[-1:]]), np.concatenate([[0.0], np.cumsum(turned)]))
    odometry_rate = _sampled(times, heading)
    energy = np.sqrt((scan_rate**2).sum() * (odometry_rate**2).sum())
    if energy <= 0:
        return None
    # Not normalised by the overlap: recordings cover the same time, and a short overlap fits by chance.
    match = convolved(odometry_rate, scan_rate[::-1]) / energy
    offsets = times[0] - starts[0] + (np.arange(len(match)) - (len(scan_rate) - 1)) / RATE
    best = int(match.argmax())
    others = match[np.abs(offsets - offsets[best]) > 1.0]
    return None if others.size and others.max() > 0.9 * match[best] else float(offsets[best])


def convolved(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(M + N - 1,) convolution of (M,) and (N,). ``scipy.signal`` has one, and takes seconds to import."""
    size = len(a) + len(b) - 1
    # Zeros up to a power of two: a transform of a prime length is slow.
    padded = 1 << (size - 1).bit_length()
    return np.fft.irfft(np.fft.rfft(a, padded) * np.fft.rfft(b, padded), padded)[:size]


def _sampled(times: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Rates of an angle, one in 1 / RATE seconds."""
    span = min(times[-1] - times[0], _LONGEST / RATE)
    at = times[0] + np.arange(int(span * RATE) + 1) / RATE
    return np.diff(np.interp(at, times, angle)) if len(at) > 1 else np.zeros(1)
