"""What explains a log best: the search of ``python -m dsom_jax.inspect``, and what follows from its numbers.

The scans alone say how the lidar moved (:mod:`~dsom_jax.diagnosis.matching`), which is held against the odometry
(:mod:`~dsom_jax.diagnosis.ego_motion`) and put together and held against the map (:mod:`~dsom_jax.diagnosis.map_fit`).
Three numbers then tell scales apart: distances by scans / by odometry, and the factor by which ranges fit the map. The
handedness is told apart in the same way: by the sign of turns, and by which of the two images lies on the map.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np

from dsom_jax.data import se2
from dsom_jax.data.bag_file import is_bag
from dsom_jax.data.log import RawLog
from dsom_jax.diagnosis import map_fit
from dsom_jax.diagnosis.ego_motion import EgoMotion, Steps, ego_motion, matched_steps, pieces_of
from dsom_jax.diagnosis.findings import Finding, Severity, ordered
from dsom_jax.diagnosis.map_fit import Geometry, MapField, Piece, Place, Thinned
from dsom_jax.diagnosis.matching import Reference, bearings, match, points_of
from dsom_jax.diagnosis.symptoms import cheap_findings, jump_finding, suspects
from dsom_jax.occupancy import OccupancyGrid

HOLDS = 0.5
"""A piece lies where it was put if its later scans agree with the map so much more often than they go through walls."""
SCALES = (0.9, 1.11, 0.8, 1.25)
FAR_SCALES = (0.5, 0.63, 1.6, 2.0)
_PIECES = 5
"""Pieces that are tried under unlikely geometries."""


@dataclass(frozen=True)
class MapAnswer:
    """What the search over the map found.

    Attributes:
        geometry: of the scans, as they fit best.
        scale_sd, spread_sd: standard errors of its two numbers; NaN where no piece holds.
        held: share of the pieces of the drive that hold.
        agree: median share of readings near what the map predicts, over the later scans of the best half of the pieces.
        through: the same of beams through walls.
        tried: score of every geometry that was tried, (geometry, median score, share that holds).
        places: the pieces that hold, in the grid's frame.
    """

    geometry: Geometry
    scale_sd: float
    spread_sd: float
    held: float
    agree: float
    through: float
    tried: list[tuple[Geometry, float, float]]
    places: list[Place]


@dataclass(frozen=True)
class Explanation:
    """Findings, most important first, and the numbers behind them."""

    findings: list[Finding]
    steps: Steps
    motion: EgoMotion | None
    on_map: MapAnswer | None

    def numbers(self) -> dict[str, Any]:
        """The numbers for ``--json``."""
        motion, on_map = self.motion, self.on_map
        found: dict[str, Any] = {}
        if motion:
            found["scans_against_odometry"] = {
                "matched": motion.steps, "moving": motion.moving, "odometry_signs": motion.variant,
                "agreement": motion.agreement, "agreement_as_is": motion.as_is, "clock_lag_s": motion.lag,
                "clock_gain": motion.lag_gain, "distance_scale": motion.distance_scale,
                "turn_scale": motion.turn_scale, "lidar_yaw_rad": motion.yaw, "lidar_yaw_sd": motion.yaw_sd,
                "frozen": motion.frozen,
            }  # fmt: skip
        if on_map:
            found["scans_against_map"] = {
                "mirrored": on_map.geometry.mirrored, "range_scale": on_map.geometry.scale,
                "range_scale_sd": on_map.scale_sd, "bearing_scale": on_map.geometry.spread,
                "bearing_scale_sd": on_map.spread_sd, "held": on_map.held, "agree": on_map.agree,
                "through": on_map.through,
                "tried": [{"mirrored": g.mirrored, "range_scale": g.scale, "score": s, "held": h}
                          for g, s, h in on_map.tried],
            }  # fmt: skip
        return found


def explain(log: RawLog, grid: OccupancyGrid | None = None, steps: Steps | None = None) -> Explanation:
    """All findings on a log, with the map if there is one. ``steps``: its matches, where they are known already."""
    cheap = cheap_findings(log, grid)
    steps = steps or matched_steps(log)
    if steps.good.sum() < 20:
        why = f"only {int(steps.good.sum())} of {len(steps.pairs)} pairs of scans can be matched: nothing was searched"
        few = Finding("not_judged", "note", why, "give a longer log of a robot that drives")
        return Explanation(ordered([*cheap, few]), steps, None, None)
    motion = ego_motion(log, steps)
    on_map = search_map(log, grid, steps, motion) if grid is not None else None
    found = [*cheap, *of_odometry(log, steps, motion), *of_geometry(log, grid, motion, on_map)]
    if on_map is not None and grid is not None:
        if on_map.places:
            # Which the search knows better.
            found = [f for f in found if f.code != "reference_frame"]
        found += [*of_map(on_map), *of_reference(log, grid, motion, on_map)]
    return Explanation(ordered(found), steps, motion, on_map)


def search_map(log: RawLog, grid: OccupancyGrid, steps: Steps, motion: EgoMotion) -> MapAnswer | None:
    """The geometry under which most pieces of the drive lie on the map; None without a piece."""
    pieces = pieces_of(log, steps, motion)
    if not pieces:
        return None
    field, every = MapField(grid), max(1, log.ranges.shape[1] // 180)
    scans = Thinned(log.ranges[:, ::every], bearings(log.lidar)[::every])
    tried: dict[Geometry, list[Place]] = {}
    for hypotheses, some in plans(pieces):
        for geometry in hypotheses:
            tried[geometry] = [map_fit.place(field, piece, scans, geometry) for piece in some]
            if held(tried[geometry]) >= 0.5 and geometry.scale == 1:
                break
        if max(held(places) for places in tried.values()) >= 0.5:
            break
    best = max(tried, key=lambda g: float(np.mean([max(p.score, 0) ** 2 for p in tried[g]])))
    if len(tried[best]) < len(pieces):
        tried[best] = [map_fit.place(field, piece, scans, best) for piece in pieces]
    listed = [(g, float(np.median([p.score for p in places])), held(places)) for g, places in tried.items()]
    return refined(field, scans, best, tried[best], listed)


def plans(pieces: list[Piece]) -> list[tuple[list[Geometry], list[Piece]]]:
    """Geometries to try in turn, and on which pieces: as it is, mirrored, scaled, scaled by far."""
    few = pieces[:: max(1, len(pieces) // _PIECES)][:_PIECES]
    scaled = [[Geometry(m, s) for s in scales for m in (False, True)] for scales in (SCALES, FAR_SCALES)]
    return [([Geometry(False), Geometry(True)], pieces), (scaled[0], few), (scaled[1], few)]


def held(places: list[Place]) -> float:
    """Share of the pieces that hold."""
    return float(np.mean([p.score > HOLDS for p in places]))


def refined(
    field: MapField, scans: Thinned, geometry: Geometry, places: list[Place], tried: list[tuple[Geometry, float, float]]
) -> MapAnswer:
    """The answer for the best geometry, its numbers refined on the pieces that hold."""
    good = [p for p in places if p.score > HOLDS] or sorted(places, key=lambda p: -p.score)[:2]
    numbers = np.concatenate([p.piece.scans for p in good])
    fit = map_fit.refine(field, scans, numbers, np.concatenate([p.poses for p in good]), geometry)
    seen, start, settled = scans.under(fit.geometry), 0, []
    for p in good:
        poses = fit.poses[start : start + len(p.poses)]
        start += len(p.poses)
        settled.append(Place(p.piece, poses, map_fit.fit_of(field, seen, p.piece.scans, poses)))
    share = len([p for p in settled if p.score > HOLDS]) / len(places)
    later = [p.fit.agree[p.piece.searched :].mean() for p in settled]
    past = [p.fit.through[p.piece.searched :].mean() for p in settled]
    kept = [p for p in settled if p.score > HOLDS]
    return MapAnswer(fit.geometry, fit.scale_sd if kept else np.nan, fit.spread_sd if kept else np.nan, share,
                     float(np.median(later)), float(np.median(past)), tried, kept)  # fmt: skip


def of_odometry(log: RawLog, steps: Steps, motion: EgoMotion) -> list[Finding]:
    """Findings on the odometry alone: standing still, leaping, its clock."""
    found = []
    if motion.frozen > 0.1:
        found.append(Finding(
            "odometry_frozen", "error",
            f"the odometry stands still in {motion.frozen:.0%} of the {motion.moving} steps in which the scans moved",
            "check the encoders or the odometry topic (--odom-topic)",
        ))  # fmt: skip
    jumps = judged_leaps(log)
    if jumps:
        found.append(jump_finding(log, jumps))
    if motion.lag_gain > 0.1 and abs(motion.lag) >= 0.04:
        size = abs(motion.lag)
        found.append(Finding(
            "clock_offset", "error" if size >= 0.25 else "warning" if size >= 0.1 else "note",
            f"the turns of the scans agree best with the odometry of {size:.2f} s "
            f"{'later' if motion.lag > 0 else 'earlier'} (unexplained turning falls by {motion.lag_gain:.0%})",
            f"--clock-offset {motion.lag:.2f}, added to one that is given" if is_bag(log.path)
            else f"add {motion.lag:+.2f} s to the stamps of the scans",
        ))  # fmt: skip
    return found


def judged_leaps(log: RawLog) -> list[tuple[int, float, float]]:
    """Steps (index, metres, radians) of the odometry that the scans contradict."""
    angles, found = bearings(log.lidar), []
    for i in suspects(log):
        seen = match(Reference(log.ranges[i], angles), points_of(log.ranges[i + 1], angles, 0.1))
        move = se2.relative(log.odometry[i], log.odometry[i + 1])
        if seen is None or seen.share < 0.6:
            continue
        more = np.hypot(*move[:2]) - np.hypot(*seen.move[:2])
        turned = abs(abs(move[2]) - abs(seen.move[2]))
        if more > max(0.4, 0.5 * np.hypot(*move[:2])) or turned > 0.4:
            found.append((int(i), float(np.hypot(*move[:2])), float(move[2])))
    return found


def of_geometry(log: RawLog, grid: OccupancyGrid | None, motion: EgoMotion, on_map: MapAnswer | None) -> list[Finding]:
    """Findings on how the lidar sits, on scales and on signs."""
    placed = on_map is not None and bool(on_map.places)
    geometry = on_map.geometry if on_map is not None and placed else None
    found = handedness(log, motion, geometry)
    mirrored = any(f.code in ("scan_mirrored", "upside_down") for f in found)
    spread = geometry.spread if geometry else 1.0
    if geometry and on_map and abs(spread - 1) > max(0.01, 4 * on_map.spread_sd):
        found.append(Finding(
            "angle_increment", "error" if abs(spread - 1) > 0.018 else "warning",
            f"the scans fit the map best if the angle between beams is {spread:.3f} of what the log says "
            f"(standard error {on_map.spread_sd:.4f})",
            f"angle_increment: {log.lidar.angle_increment * spread:.7f} in meta.yaml, or repair the driver",
        ))  # fmt: skip
    if motion.agreement > 0.4 and motion.lag_gain * abs(motion.lag) < 5:
        found += yaw(log, motion, mirrored, abs(spread - 1) * log.lidar.fov / 2)
    return found + scales(log, grid, motion, on_map if placed else None)


def handedness(log: RawLog, motion: EgoMotion, geometry: Geometry | None) -> list[Finding]:
    """Which of scans, odometry and map is the mirror image, if one is."""
    known = np.isfinite(motion.agreement) and motion.agreement > 0.4
    against = known and motion.variant == "mirrored"
    turns = f"turns by the scans have the opposite sign of the odometry's in {motion.agreement:.0%} of the steps"
    image = "the mirrored scans lie on the map" if geometry and geometry.mirrored else "the scans lie as they are on it"
    if known and motion.variant == "yaw negated":
        return [Finding(
            "odometry_yaw_sign", "error",
            f"turns by the scans agree with the odometry in {motion.agreement:.0%} of the steps if its yaw alone is "
            f"negated, in {motion.as_is:.0%} as it is", "negate the yaw of the odometry",
        )]  # fmt: skip
    mirrored = geometry.mirrored if geometry else against
    if not mirrored and against:
        return [Finding("odometry_yaw_sign", "error", f"{turns}, and {image}", "negate the yaw of the odometry")]
    if mirrored and known and not against:
        return [Finding("map_mirrored", "error", f"{image}, and turns agree with the odometry as they are",
                        "flip the image of the map")]  # fmt: skip
    if not mirrored:
        return []
    why = "; ".join([turns] * bool(against) + [image] * bool(geometry))
    x, y, yaw = (f"{v:g}" for v in log.lidar.mount)
    upright = Finding("upside_down", "error", f"{why}: the lidar does not hang upside down, as the log has it",
                      f"--mount {x},{y},{yaw}, or upside_down: false in meta.yaml")  # fmt: skip
    if log.lidar.upside_down:
        return [upright]
    fix = f"--mount {x},{y},{yaw},upside-down, or upside_down: true in meta.yaml"
    doubt = "" if geometry else "; it may as well be the yaw of the odometry, only a map can tell"
    return [
        Finding("scan_mirrored", "error", f"{why}: its beams run the other way round{doubt}", fix),
        Finding("upside_down", "warning", "a lidar that hangs head down is the usual cause of a mirrored scan", fix),
    ]


def yaw(log: RawLog, motion: EgoMotion, mirrored: bool, slack: float) -> list[Finding]:
    """A lidar that is turned on the base otherwise than the log says."""
    seen = -motion.yaw if mirrored else motion.yaw
    off = float(se2.wrap(np.asarray(seen - log.lidar.mount[2])))
    if abs(off) < np.radians(3) + 4 * motion.yaw_sd + slack:
        return []
    x, y, _ = log.lidar.mount
    return [Finding(
        "scan_turned", "error" if abs(off) > np.radians(5) + slack else "warning",
        f"driving forward moves the scans as if the lidar were turned by {np.degrees(seen):.1f} deg on the base, the "
        f"log says {np.degrees(log.lidar.mount[2]):.1f} deg (standard error {np.degrees(motion.yaw_sd):.1f} deg)",
        f"--mount {x:g},{y:g},{seen:.4f}, or mount: [{x:g}, {y:g}, {seen:.4f}] in meta.yaml",
    )]  # fmt: skip


def scales(log: RawLog, grid: OccupancyGrid | None, motion: EgoMotion, on_map: MapAnswer | None) -> list[Finding]:
    """Ranges, map or odometry that are too long or too short."""
    known = np.isfinite(motion.agreement) and motion.agreement > 0.4
    way = motion.distance_scale if known else np.nan
    factor, sd = (on_map.geometry.scale, on_map.scale_sd) if on_map else (1.0, 0.0)
    found = []
    if abs(np.log(factor)) > max(0.025, 4 * sd):
        severity: Severity = "error" if abs(np.log(factor)) > 0.035 else "warning"
        evidence = f"the scans fit the map best with ranges times {factor:.3f} (standard error {sd:.3f})"
        if known and abs(np.log(way)) < abs(np.log(way * factor)):
            cells = grid.resolution if grid is not None else np.nan
            found.append(Finding("map_scaled", severity,
                                 f"{evidence}, while ranges and odometry agree ({way:.3f} m by scans a metre)",
                                 f"resolution: {cells / factor:.5f} in the map's yaml"))  # fmt: skip
        else:
            agrees = f", and then agree with the odometry ({way * factor:.3f} m a metre)" if known else ""
            found.append(Finding("ranges_scaled", severity, f"{evidence}{agrees}",
                                 f"multiply the ranges by {factor:.3f}: check the units of the driver"))  # fmt: skip
            way = way * factor
    own = not any(f.code == "map_scaled" for f in found)
    if known and own and abs(np.log(way)) > max(0.04, 4 * motion.scale_sd):
        doubt = "" if on_map else "; or the ranges are, only a map can tell"
        found.append(Finding("odometry_scaled", "error" if abs(np.log(way)) > 0.08 else "warning",
                             f"the scans move {way:.3f} m for each metre of the odometry (standard error "
                             f"{motion.scale_sd:.3f}){doubt}",
                             f"multiply the odometry's distances by {way:.3f}: check the wheels"))  # fmt: skip
    turn = motion.turn_scale * (on_map.geometry.spread if on_map else 1.0)
    once = not any(f.code == "odometry_scaled" for f in found)
    if known and once and turn > 0 and abs(np.log(turn)) > 0.06:
        found.append(Finding("odometry_scaled", "error" if abs(np.log(turn)) > 0.12 else "warning",
                             f"the scans turn {turn:.3f} rad for each radian of the odometry",
                             f"multiply the odometry's turns by {turn:.3f}: check the wheel base"))  # fmt: skip
    return found


def of_map(on_map: MapAnswer) -> list[Finding]:
    """A map on which nothing fits."""
    if on_map.held >= 0.25:
        return []
    return [Finding(
        "wrong_map", "error" if max(score for _, score, _ in on_map.tried) < 0.3 else "warning",
        f"of all places, headings and scales the best leave {on_map.agree:.0%} of the readings within {map_fit.NEAR} m "
        f"of the map's walls and {on_map.through:.0%} of the beams go through them; {on_map.held:.0%} of it holds",
        "give the map of the building in which the log was recorded",
    )]  # fmt: skip


def of_reference(log: RawLog, grid: OccupancyGrid, motion: EgoMotion, on_map: MapAnswer) -> list[Finding]:
    """A reference that follows the robot and is shifted or turned against the map."""
    if log.reference is None or not on_map.places or abs(np.log(on_map.geometry.scale)) > 0.02:
        return []
    numbers = np.concatenate([p.piece.scans for p in on_map.places])
    sensor = np.asarray(grid.from_grid(jnp.asarray(np.concatenate([p.poses for p in on_map.places]))))
    turn = motion.yaw * (-1 if on_map.geometry.mirrored else 1) if motion.agreement > 0.4 else log.lidar.mount[2]
    base = se2.compose(sensor, se2.inverse(np.array([*log.lidar.mount[:2], turn])))
    given = log.reference[numbers]
    known = np.isfinite(given).all(1)
    if known.sum() < 20:
        return []
    shifts = se2.compose(base[known], se2.relative(given[known], np.zeros(3)))
    middle = np.array([*np.median(shifts[:, :2], axis=0), circular_median(shifts[:, 2])])
    moved = se2.compose(middle, given[known])
    before, after = (np.hypot(*(poses - base[known])[:, :2].T) for poses in (given[known], moved))
    if np.median(before) < 0.5 or np.quantile(after, 0.6) > 0.5:
        return []
    return [Finding(
        "reference_frame", "error",
        f"the reference lies {np.median(before):.2f} m beside where the scans fit the map; shifted by "
        f"({middle[0]:.2f}, {middle[1]:.2f}) m and turned by {np.degrees(middle[2]):.1f} deg it is within "
        f"{np.median(after):.2f} m",
        f"move the reference by x {middle[0]:+.2f}, y {middle[1]:+.2f}, yaw {middle[2]:+.4f}",
    )]  # fmt: skip


def circular_median(angles: np.ndarray) -> float:
    """Median of angles around their mean direction."""
    mean = np.arctan2(np.sin(angles).mean(), np.cos(angles).mean())
    return float(mean + np.median(se2.wrap(angles - mean)))
