"""What can be told from a log and a map without searching: codes among the ranges, the robot's own body, stamps,
odometry that stands still or leaps, a reference or unknown space that cannot be meant."""

from __future__ import annotations

import re
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from dsom_jax.data import se2
from dsom_jax.data.bag_file import is_bag
from dsom_jax.data.documents import read_yaml
from dsom_jax.data.log import RawLog, travelled
from dsom_jax.data.ros_map import decode_image, read_map_info
from dsom_jax.diagnosis.findings import Finding, Severity, ordered
from dsom_jax.occupancy import OccupancyGrid, is_free

CHANGED = 0.2
"""Metres by which the middle one of all readings changes when the robot has moved for sure."""


def cheap_findings(log: RawLog, grid: OccupancyGrid | None = None) -> list[Finding]:
    """Everything that needs no search. Give the log before ranges are cut by ``--laser-max-range``."""
    found = [*no_return_code(log), *self_hits(log), *beams_vary(log), *odd_stamps(log), *frozen(log), *_leaps(log)]
    if grid is not None:
        found += [*unknown_is_free(grid), *reference_off_map(log, grid)]
    return ordered(found)


def no_return_code(log: RawLog) -> list[Finding]:
    """A value at the top of the ranges that far too many readings share, or zeros in place of "no return"."""
    ranges = log.ranges[:: max(1, len(log) // 2000)]
    values = ranges[np.isfinite(ranges)]
    if len(values) < 1000:
        return []
    code = code_at_the_top(values)
    if code is not None:
        share = float((values >= code - 0.01).mean())
        return [Finding(
            "no_return_code", "warning",
            f"{share:.1%} of the readings are {code:.2f} m, at the end of the scale, and taken for walls",
            f"--laser-max-range {code - 0.02:.2f}, or range_no_return: {code:.2f} in meta.yaml beside the log",
        )]  # fmt: skip
    missing, none = float(np.isnan(ranges).mean()), not np.isposinf(ranges).any()
    if missing > 0.03 and none:
        return [Finding(
            "no_return_code", "warning",
            f"{missing:.1%} of the readings are 0 or invalid and none says 'no return': the driver may write 0 for it",
            "let the driver write inf beyond its reach; until then these beams are no evidence",
        )]  # fmt: skip
    return []


def code_at_the_top(values: np.ndarray) -> float | None:
    """The reading (m) near the greatest of all that is no wall: far more frequent than all of the two metres below.

    Walls spread over their centimetres, and the farther the fewer; a code is one value, at most some centimetres wide.
    """
    top = float(np.quantile(values, 1 - 2e-4)) if len(values) > 50_000 else float(values.max())
    upper = values[(values > 0.6 * top) & (values <= top + 0.05)]
    if len(upper) < 20:
        return None
    centimetres, counts = np.unique(np.rint(upper * 100).astype(np.int64), return_counts=True)
    most = int(counts.argmax())
    code, count = centimetres[most] / 100, int(counts[most])
    above = int((values > code + 0.1).sum())
    beside = ((values > code - 2.0) & (values < code - 0.1)).sum()
    alike = (np.abs(values - code) < 0.1).sum()
    common = count >= max(20, 0.002 * len(values), 0.5 * alike)
    return float(code) if common and count > 0.5 * beside + 10 and above < 0.2 * count else None


def self_hits(log: RawLog) -> list[Finding]:
    """Beams that return from the same short distance wherever the robot is."""
    if travelled(log.odometry) < 3.0 or len(log) < 30:
        return []
    ranges = log.ranges[:: max(1, len(log) // 500)]
    with np.errstate(invalid="ignore"):
        usable = np.where(np.isfinite(ranges), ranges, np.nan)
        half_filled = np.isfinite(usable).mean(0) > 0.5
        middle = np.full(ranges.shape[1], np.nan)
        middle[half_filled] = np.nanmedian(usable[:, half_filled], axis=0)
        same = (np.abs(ranges - middle) < 0.03).mean(0)
    own = (same > 0.6) & (middle < 1.2)
    if not own.any():
        return []
    beams = np.flatnonzero(own)
    far = float(np.nanmax(middle[own]))
    runs = np.split(beams, np.flatnonzero(np.diff(beams) > 1) + 1)
    named = ", ".join(f"{run[0]}:{run[-1]}" for run in runs[:4])
    masks = " ".join(mask_of(log, run) for run in runs)
    return [Finding(
        "self_hits", "warning",
        f"{len(beams)} of {ranges.shape[1]} beams ({named}) return from the same {far:.2f} m or less in "
        f"{same[own].mean():.0%} of the scans while the robot drives {travelled(log.odometry):.0f} m: its own body",
        f"--laser-mask {masks}, or --laser-min-range {far + 0.05:.2f}",
    )]  # fmt: skip


def mask_of(log: RawLog, run: np.ndarray) -> str:
    """FROM:TO of ``--laser-mask`` for neighbouring beams, half a beam wider on both sides."""
    step = log.lidar.angle_increment
    ends = np.sort(log.lidar.angle_min + step * run[[0, -1]]) + np.array([-0.5, 0.5]) * abs(step)
    start, end = np.degrees(se2.wrap(ends))
    return f"{start:.2f}deg:{end:.2f}deg"


def beams_vary(log: RawLog) -> list[Finding]:
    """Scans with another number of beams, as the reader counted them."""
    # The words of log.majority_beams and of scans.brought_together.
    said = r"scans of (\d+|other) beams|scans that cover less than half"
    lines = [line for line in log.report.lines() if re.search(said, line)]
    fix = "none needed if few; else let the driver keep to the same rays"
    return [Finding("beams_vary", "note", lines[0], fix)] if lines else []


def odd_stamps(log: RawLog) -> list[Finding]:
    """Stamps that run backwards or stand still."""
    steps = np.diff(log.stamps)
    odd = int((steps <= 0).sum())
    if not odd:
        return []
    kind: Severity = "warning" if odd > 0.05 * len(steps) else "note"
    return [Finding("odd_stamps", kind, f"{odd} of {len(log)} scans are not newer than the one before",
                    "use the header stamps of the driver, and one clock")]  # fmt: skip


def change(a: np.ndarray, b: np.ndarray) -> float:
    """Median change (m) of the readings from scan (B,) to scan (B,): of the whole view, not of somebody who passes."""
    both = np.isfinite(a) & np.isfinite(b)
    return float(np.median(np.abs(a[both] - b[both]))) if both.sum() >= 10 else 0.0


def frozen(log: RawLog) -> list[Finding]:
    """Odometry that says the very same pose while the view changes."""
    still = (np.abs(np.diff(log.odometry, axis=0)) < 1e-4).all(1)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], still.astype(np.int8), [0]])))
    stuck, moved, where = 0, 0.0, ""
    for start, stop in zip(edges[::2], edges[1::2], strict=True):
        # Each scan of a stretch against some before it: a drive in a circle ends where it began.
        numbers = np.unique(np.linspace(start, stop, min(stop - start + 1, 12)).astype(int))
        changes = [change(log.ranges[numbers[0]], log.ranges[n]) for n in numbers[1:]]
        if max(changes) > CHANGED and np.mean(np.array(changes) > CHANGED) > 0.3:
            if not stuck:
                where = f"from {log.stamps[start]:.2f} to {log.stamps[stop]:.2f} s"
            stuck, moved = stuck + stop - start, max(moved, *changes)
    if not stuck:
        return []
    share = stuck / max(len(log) - 1, 1)
    severe = share > 0.03 or stuck >= 15
    return [Finding(
        "odometry_frozen", "error" if severe else "warning",
        f"the odometry does not move in {share:.0%} of the log (first {where}) while the view changes by {moved:.2f} m "
        "in the middle beam",
        "check the encoders or the odometry topic (--odom-topic); cut these stretches out of the log",
    )]  # fmt: skip


def suspects(log: RawLog) -> np.ndarray:
    """Indices (k,) of steps i to i + 1 in which the odometry moves far more than it usually does, at most 16."""
    moves = se2.relative(log.odometry[:-1], log.odometry[1:])
    if len(moves) < 20:
        return np.zeros(0, int)
    far, turn = np.hypot(moves[:, 0], moves[:, 1]), np.abs(moves[:, 2])
    odd = np.maximum(far / max(0.4, 2.5 * np.quantile(far, 0.9)), turn / max(0.5, 2.5 * np.quantile(turn, 0.9)))
    worst = np.argsort(-odd)[:16]
    return np.sort(worst[odd[worst] > 1])


def _leaps(log: RawLog) -> list[Finding]:
    """Odometry that leaps from one scan to the next while the view stays, or faster than robots drive."""
    steps = []
    for i in suspects(log):
        move = se2.relative(log.odometry[i], log.odometry[i + 1])
        far, seconds = float(np.hypot(*move[:2])), float(max(log.stamps[i + 1] - log.stamps[i], 1e-3))
        stayed = change(log.ranges[i], log.ranges[i + 1]) < min(0.1, 0.15 * far + 0.1 * abs(move[2]))
        if stayed or (far > 1.0 and far / seconds > 4.0) or abs(move[2]) / seconds > 8.0:
            steps.append((i, far, move[2]))
    return [jump_finding(log, steps)] if steps else []


def jump_finding(log: RawLog, steps: list[tuple[int, float, float]]) -> Finding:
    """The finding for steps (index, metres, radians) that the robot has not made."""
    i, far, turn = max(steps, key=lambda s: s[1] + 2 * abs(s[2]))
    return Finding(
        "odometry_jump", "error",
        f"the odometry leaps {len(steps)} times, by {far:.2f} m and {np.degrees(turn):.0f} deg at "
        f"{log.stamps[i + 1]:.2f} s, and the scans do not",
        "cut the log there, or keep the odometry from being reset while it is recorded",
    )  # fmt: skip


def unknown_is_free(grid: OccupancyGrid) -> list[Finding]:
    """Free space that runs out over the edges of the map, as only unknown space does."""
    free = np.asarray(grid.free)
    border = np.concatenate([free[0], free[-1], free[1:-1, 0], free[1:-1, -1]])
    if border.mean() < 0.25 or free.mean() < 0.3:
        return []
    return [Finding(
        "unknown_is_free", "warning",
        f"{border.mean():.0%} of the map's edge and {free.mean():.0%} of all its cells are free: unknown space seems "
        "to count as free",
        "free_thresh: 0.196 in the map's yaml (nav2's saver writes 0.25, which makes the grey of unknown free)",
    )]  # fmt: skip


def grey_is_free(path: Path) -> list[Finding]:
    """A grey of the map's image that is free by the thresholds although a lighter one is, too: map_saver's unknown."""
    if is_bag(path) or path.suffix.lower() in (".dxf", ".dwg") or "drawing" in read_yaml(path, "map yaml"):
        return []
    info = read_map_info(path)
    if info.mode != "trinary":
        return []
    picture = decode_image(info.image)
    counts = np.bincount(picture.pixels.ravel(), minlength=picture.top + 1)
    occupancy = np.arange(picture.top + 1) / picture.top
    occupancy = occupancy if info.negate else 1 - occupancy
    free = np.flatnonzero((counts > 0.02 * counts.sum()) & (occupancy <= info.free_thresh + 1e-9))
    if len(free) < 2:
        return []
    darkest = free[occupancy[free].argmax()]
    next_one = np.delete(occupancy[free], occupancy[free].argmax()).max()
    # Between the two, close to the darker one, as 0.196 lies below map_saver's 205.
    below = np.floor(1e3 * (0.99 * occupancy[darkest] + 0.01 * next_one)) / 1e3
    return [Finding(
        "unknown_is_free", "warning",
        f"{counts[darkest] / counts.sum():.0%} of the pixels of {info.image.name} are of one grey that is free by "
        f"free_thresh = {info.free_thresh:g}, as are lighter ones: unknown space counts as free",
        f"free_thresh: {below:g} in {path.name}",
    )]  # fmt: skip


def reference_off_map(log: RawLog, grid: OccupancyGrid) -> list[Finding]:
    """A reference whose poses are not on free cells."""
    if log.reference is None:
        return []
    known = log.reference[np.isfinite(log.reference).all(-1)]
    share = float(np.asarray(is_free(grid, jnp.asarray(known, jnp.float32))).mean()) if len(known) else 1.0
    if share > 0.3:
        return []
    return [Finding(
        "reference_frame", "error", f"{share:.0%} of the reference's poses lie on free cells of the map",
        "give the reference in the frame of the map; python -m dsom_jax.inspect names the shift",
    )]  # fmt: skip
