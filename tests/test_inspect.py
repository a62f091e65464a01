"""``inspect``: what scans, odometry and map say of each other, against a floor whose truth is known."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import inspect_kit as kit
from dsom_jax.data import se2
from dsom_jax.data.log import select
from dsom_jax.diagnosis import map_fit
from dsom_jax.diagnosis.ego_motion import EgoMotion, ego_motion, matched_steps, pieces_of
from dsom_jax.diagnosis.explain import MapAnswer, explain, handedness, of_map, of_odometry, scales, yaw
from dsom_jax.diagnosis.findings import CODES, Finding, ordered
from dsom_jax.diagnosis.map_fit import Geometry, MapField, Thinned
from dsom_jax.diagnosis.matching import Reference, bearings, match, points_of, transform
from dsom_jax.occupancy import from_cells

LOG = kit.drive()
ANGLES = bearings(kit.LIDAR)


@pytest.fixture(scope="module")
def steps():
    return matched_steps(LOG, pairs=100, blocks=4)


@pytest.fixture(scope="module")
def field():
    return MapField(kit.grid())


@pytest.fixture(scope="module")
def pieces(steps):
    return pieces_of(LOG, steps, ego_motion(LOG, steps))


def matched(a, b):
    """The match of scan b on scan a, each seen from a pose on the floor."""
    rng = np.random.default_rng(3)
    first, second = (kit.march(np.array(p), ANGLES) + rng.normal(0, 0.01, len(ANGLES)) for p in (a, b))
    return match(Reference(first, ANGLES), points_of(second, ANGLES, 0.1))


@pytest.mark.parametrize(
    ("a", "b"), [((4.5, 4.4, 0.0), (4.9, 4.6, -0.5)), ((8.3, 4.6, -1.2), (8.5, 4.0, -0.5)), ((2.0, 1.5, 0.3),) * 2]
)
def test_scans_say_how_the_lidar_moved(a, b):
    found = matched(a, b)
    off = se2.relative(se2.relative(np.array(a), np.array(b)), found.move)
    # Readings of 1 cm on some hundred points, marched in steps of 2 cm: 2 cm and half a degree are generous.
    assert found.share > 0.7 and np.hypot(*off[:2]) < 0.02 and abs(off[2]) < np.radians(0.5)


def test_a_mirrored_scan_moves_as_its_mirror_image():
    a, b = np.array([4.5, 4.4, 0.0]), np.array([4.9, 4.6, -0.5])
    scans = [kit.march(p, ANGLES)[::-1] for p in (a, b)]
    found = match(Reference(scans[0], ANGLES), points_of(scans[1], ANGLES, 0.1))
    np.testing.assert_allclose(found.move, se2.relative(a, b) * [1, -1, -1], atol=0.02)


def test_scans_that_show_too_little_are_not_matched():
    empty = np.full(len(ANGLES), np.inf)
    assert match(Reference(kit.march(kit.path()[0], ANGLES), ANGLES), points_of(empty, ANGLES, 0.1)) is None


def test_the_odometry_of_a_clean_drive(steps):
    found = ego_motion(LOG, steps)
    assert found.variant == "as is" and found.agreement > 0.95 and found.lag_gain == 0
    assert abs(found.distance_scale - 1) < 0.02 and abs(found.turn_scale - 1) < 0.02
    assert abs(found.yaw) < np.radians(1) and found.frozen == 0


def test_yaw_and_scale_of_a_lidar_that_sits_elsewhere(steps):
    """The sensor is where the base was; the odometry is that of a base from which it is turned and shifted."""
    mount = np.array([0.2, -0.1, 0.6])
    base = se2.compose(LOG.odometry, se2.inverse(mount)) * [0.8, 0.8, 1]
    found = ego_motion(replace(LOG, odometry=base), steps)
    assert abs(found.yaw - 0.6) < np.radians(1.5) and abs(found.distance_scale - 1.25) < 0.03


@pytest.mark.parametrize(("signs", "variant"), [((1, -1, -1), "mirrored"), ((1, 1, -1), "yaw negated")])
def test_signs_of_the_odometry(steps, signs, variant):
    turned = replace(LOG, odometry=se2.compose(np.array([0, 0, 0.7]), LOG.odometry) * signs)
    assert ego_motion(turned, steps).variant == variant


@pytest.mark.parametrize("seconds", [-0.4, 3.0])
def test_the_lag_of_a_clock(steps, seconds):
    at = LOG.stamps + seconds
    inside = (at >= LOG.stamps[0]) & (at <= LOG.stamps[-1])
    odometry = se2.interpolate(LOG.stamps, LOG.odometry, at)
    late = replace(LOG, odometry=np.where(inside[:, None], odometry, 0))
    kept = type(steps)(*(column[inside[steps.pairs].all(1)] for column in steps))
    found = ego_motion(late, kept)
    # Odometry interpolated over half a second of turning on the spot is soft by a tenth of it.
    assert found.lag_gain > 0.3 and abs(found.lag + seconds) < 0.1


def test_rays_of_the_field_are_those_of_the_march(field):
    rng = np.random.default_rng(0)
    poses = np.column_stack([rng.uniform(0.3, 14.6, 20), rng.uniform(0.3, 9.1, 20), rng.uniform(-3, 3, 20)])
    poses = poses[~kit.cells()[(poses[:, 1] / 0.1).astype(int), (poses[:, 0] / 0.1).astype(int)]]
    for pose in poses:
        cast = field.cast(np.tile(pose[:2], (len(ANGLES), 1)), pose[2] + ANGLES, 12.0)
        marched = kit.march(pose, ANGLES)
        # A ray that grazes a corner may be stopped by the one and not by the other.
        assert np.mean(np.abs(cast - marched) < 0.08) > 0.9


def test_pieces_of_the_drive_are_found_on_the_map(field, pieces):
    scans = Thinned(LOG.ranges, ANGLES)
    for piece in pieces:
        found = map_fit.place(field, piece, scans, Geometry())
        off = np.hypot(*(found.poses - kit.path()[piece.scans])[:, :2].T)
        assert found.score > 0.7 and np.median(off) < 0.1


def test_scale_and_spread_are_refined_together(field, pieces):
    wrong = Geometry(scale=1.04, spread=0.97)
    seen = Thinned(LOG.ranges, ANGLES).under(wrong)
    numbers = np.concatenate([p.scans for p in pieces])
    found = map_fit.refine(field, seen, numbers, kit.path()[numbers], Geometry())
    # Cells of 10 cm make walls 10 cm thick: 1 % of the ranges.
    assert abs(found.geometry.scale * 1.04 - 1) < 0.015 and abs(found.geometry.spread * 0.97 - 1) < 0.006


def test_a_geometry_undoes_itself():
    scans = Thinned(LOG.ranges[:3], ANGLES)
    there = scans.under(Geometry(True, 1.25, 1.03))
    back = there.under(Geometry(True, 0.8, 1 / 1.03))
    np.testing.assert_allclose(back.ranges, scans.ranges, rtol=1e-5)
    np.testing.assert_allclose(back.angles, scans.angles, atol=1e-9)
    mirror = transform(np.array([1.0, 2.0, 0.5]), scans.points(0)) * [1, -1]
    np.testing.assert_allclose(mirror, transform(np.array([1.0, -2.0, -0.5]), scans.under(Geometry(True)).points(0)))


def test_nothing_is_wrong_with_a_clean_drive(steps):
    found = explain(LOG, kit.grid(), steps)
    assert found.findings == [] and found.on_map.held == 1
    numbers = found.numbers()
    assert numbers["scans_against_map"]["mirrored"] is False
    assert abs(numbers["scans_against_map"]["bearing_scale"] - 1) < 0.01


def moved_reference(log):
    return replace(log, reference=se2.compose(np.array([15.05, -3.0, 0.5]), log.reference))


@pytest.mark.parametrize(
    ("code", "spoil"),
    [
        ("scan_turned", lambda log: replace(log, lidar=replace(log.lidar, mount=(0.0, 0.0, np.pi)))),
        ("odometry_yaw_sign", lambda log: replace(log, odometry=log.odometry * [1, -1, -1])),
        ("odometry_scaled", lambda log: replace(log, odometry=log.odometry * [1.2, 1.2, 1])),
        ("odometry_frozen", lambda log: replace(log, odometry=log.odometry * 0)),
        ("reference_frame", moved_reference),
    ],
)
def test_the_cause_is_named_first(steps, code, spoil):
    found = explain(spoil(LOG), kit.grid(), steps).findings
    assert found[0].code == code and found[0].severity == "error" and len(found) == 1


def test_a_moved_reference_is_named_with_its_shift(steps):
    (found,) = explain(moved_reference(LOG), kit.grid(), steps).findings
    x, y, turn = se2.inverse(np.array([15.05, -3.0, 0.5]))
    shift = [float(word) for word in found.fix.replace(",", "").split() if word[0] in "+-"]
    np.testing.assert_allclose(shift, [x, y, turn], atol=0.06)


def test_without_a_map_the_mirror_is_told_from_turns_alone(steps):
    found = explain(replace(LOG, odometry=LOG.odometry * [1, -1, -1]), None, steps).findings
    assert found[0].code == "scan_mirrored" and "only a map can tell" in found[0].says


def test_a_log_of_a_robot_that_sees_nothing_is_not_judged():
    blind = select(LOG, np.arange(10))
    (found,) = explain(blind, kit.grid()).findings
    assert (found.code, found.severity) == ("not_judged", "note")


MOTION = EgoMotion("as is", 0.95, 0.95, 0.0, 0.0, 1.0, 1.0, 0.0, 0.002, 0.002, 100, 100, 0.0)


def answer(scale: float = 1.0, mirrored: bool = False, held: float = 1.0) -> MapAnswer:
    return MapAnswer(Geometry(mirrored, scale), 0.001, 0.001, held, 0.4, 0.3, [(Geometry(), 0.1, 0.0)], [])


@pytest.mark.parametrize(
    ("way", "factor", "code"),
    [(1.0, 1.0, None), (0.8, 1.0, "odometry_scaled"), (1.0, 1.11, "map_scaled"), (0.9, 1.11, "ranges_scaled"),
     (1.1, 0.91, "ranges_scaled"), (1.0, 0.91, "map_scaled")],
)  # fmt: skip
def test_which_of_ranges_map_and_odometry_is_scaled(way, factor, code):
    found = scales(LOG, kit.grid(), replace(MOTION, distance_scale=way), answer(factor))
    assert [f.code for f in found] == ([code] if code else [])
    if code == "map_scaled":
        assert f"resolution: {0.1 / factor:.5f}" in found[0].fix


@pytest.mark.parametrize(
    ("variant", "mirrored", "code"),
    [("as is", False, None), ("mirrored", False, "odometry_yaw_sign"), ("mirrored", True, "scan_mirrored"),
     ("as is", True, "map_mirrored"), ("yaw negated", False, "odometry_yaw_sign")],
)  # fmt: skip
def test_which_of_scans_map_and_odometry_is_the_mirror_image(variant, mirrored, code):
    found = handedness(LOG, replace(MOTION, variant=variant), Geometry(mirrored))
    assert [f.code for f in found][:1] == ([code] if code else [])
    hanging = replace(LOG, lidar=replace(LOG.lidar, upside_down=True))
    if code == "scan_mirrored":
        (only,) = handedness(hanging, replace(MOTION, variant=variant), Geometry(True))
        assert only.code == "upside_down" and "upside_down: false" in only.fix


def test_a_mirrored_scan_turns_the_other_way():
    (found,) = yaw(LOG, replace(MOTION, yaw=0.5), mirrored=True, slack=0.0)
    assert "mount: [0, 0, -0.5000]" in found.fix
    assert yaw(LOG, replace(MOTION, yaw=0.04), mirrored=False, slack=0.0) == []


@pytest.mark.parametrize(
    ("log", "fix"),
    [("drive.bag", "--clock-offset -0.30, added to one that is given"),
     ("drive.log", "add -0.30 s to the stamps of the scans")],
)  # fmt: skip
def test_the_fix_of_a_clock_is_an_option_where_there_is_one(steps, log, fix):
    (found,) = of_odometry(replace(LOG, path=Path(log)), steps, replace(MOTION, lag=-0.3, lag_gain=0.5))
    assert (found.code, found.fix) == ("clock_offset", fix)


@pytest.mark.parametrize(("held", "codes"), [(0.0, ["wrong_map"]), (0.5, [])])
def test_a_map_on_which_nothing_holds_is_the_wrong_one(held, codes):
    assert [f.code for f in of_map(answer(held=held))] == codes


@pytest.mark.slow
def test_the_map_of_another_building_is_the_wrong_one(steps):
    y, x = np.mgrid[:120, :120] * 0.1
    hall = np.hypot(x - 6, y - 6) > 5.2
    for a, b in ((3.5, 4.0), (8.0, 3.5), (7.5, 8.2), (4.0, 8.4)):
        hall |= np.hypot(x - a, y - b) < 0.4
    found = explain(LOG, from_cells(hall, resolution=0.1), steps).findings
    assert found[0].code == "wrong_map"


def test_errors_come_first_and_causes_before_what_they_cause():
    given = [Finding(code, severity, "", "") for code, severity in (
        ("self_hits", "warning"), ("odometry_scaled", "error"), ("clock_offset", "error"), ("clock_offset", "note"),
    )]  # fmt: skip
    assert [f.code for f in ordered(given)] == ["clock_offset", "odometry_scaled", "self_hits"]
    assert len(set(CODES)) == len(CODES)
    with pytest.raises(ValueError, match="no such kind"):
        Finding("nonsense", "error", "", "")
