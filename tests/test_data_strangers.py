"""Bags as strangers bring them: beams, ranges, odometry and clocks, against the drive they are made from."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dsom_jax.data import LogOptions, load_log, se2, thin, to_episode
from dsom_jax.data.clocks import convolved
from dsom_jax.errors import UserError
from fixtures.make_bag import Entry, write_bag
from fixtures.strangers import (
    DRIFT,
    DRIVE,
    LIDAR,
    MOUNT,
    SCANS,
    SPINNING,
    START,
    Lidar,
    drift,
    lasers,
    load,
    off,
    said,
    scan_stamps,
    wheels,
)  # fmt: skip


def test_every_scan_of_a_lidar_whose_beams_vary_is_used(tmp_path: Path) -> None:
    counts = np.random.default_rng(2).integers(170, 190, SCANS)
    log = load(tmp_path, [*lasers(DRIVE, LIDAR, beams=counts), *wheels(DRIVE), *MOUNT])
    assert len(log) == SCANS and log.lidar.beams == round(np.median(counts))
    assert log.lidar.fov == pytest.approx(2 * np.pi) and said(log, "170 to 189") > 0.9 * SCANS
    # Noise of 1 cm, and beams up to half a beam (1 deg) beside: 3 cm at 2 m on a slanted wall.
    assert off(log) < 0.03


def test_beams_that_start_elsewhere_in_every_scan(tmp_path: Path) -> None:
    entries = [*wheels(DRIVE), *MOUNT]
    for n, (t, topic, kind, (ranges, frame, start, step, dt)) in enumerate(lasers(DRIVE, LIDAR)):
        turned = n % 7
        entries.append((t, topic, kind, (np.roll(ranges, -turned), frame, start + turned * step, step, dt)))
    log = load(tmp_path, entries)
    assert len(log) == SCANS and said(log, "scans of other beams (180)") > 0.8 * SCANS
    assert off(log) < 0.02


def test_no_return_is_invented_between_a_near_and_a_far_wall() -> None:
    from dsom_jax.data.scans import Beams, nearest

    ranges = np.where(np.arange(90) < 45, 2.0, 8.0).astype(np.float32)
    found = nearest(np.linspace(-1, 1, 90), ranges, Beams(71, -1.0, 2 / 70), 2 / 89)
    assert set(found.tolist()) == {2.0, 8.0}
    # Outside of the scan nothing is known.
    wide = nearest(np.linspace(-1, 1, 90), ranges, Beams(101, -1.43, 2 / 70), 2 / 89)
    assert np.isnan(wide[[0, -1]]).all() and np.isfinite(wide[50])


def bent(factor: float, lidar: Lidar, *, of_end: bool) -> list[Entry]:
    """Scans whose angle_increment, or angle_max, is wrong by ``factor``."""
    out = []
    for t, topic, kind, (ranges, frame, start, step, dt) in lasers(DRIVE, lidar):
        span = step * (len(ranges) - 1)
        told = (step, start + span * factor) if of_end else (step * factor, start + span)
        out.append((t, topic, kind, (ranges, frame, start, told[0], dt, told[1])))
    return out


@pytest.mark.parametrize("span", [2 * np.pi, 1.5 * np.pi])
@pytest.mark.parametrize("of_end", [True, False])
@pytest.mark.parametrize("factor", [0.97, 1.03])
def test_of_two_increments_the_right_one_is_found(tmp_path: Path, span: float, of_end: bool, factor: float) -> None:
    lidar = Lidar(180, span)
    log = load(tmp_path, [*bent(factor, lidar, of_end=of_end), *wheels(DRIVE), *MOUNT])
    taken = "angle_increment is taken" if of_end else "angle_max is taken"
    assert said(log, taken) == SCANS and log.lidar.angle_increment == pytest.approx(span / 180, rel=1e-5)


def test_an_increment_that_nothing_decides_is_said(tmp_path: Path) -> None:
    entries = bent(0.97, Lidar(180, 1.5 * np.pi), of_end=False)[:15]
    log = load(tmp_path, [*entries, *wheels(DRIVE), *MOUNT])
    assert said(log, "angle_increment is taken, nothing tells") == 15


def spoilt(change) -> list[Entry]:
    """Odometry whose rows (x, y, yaw) from the middle on are changed."""
    half = START + 10.0
    return [(t, top, kind, (*change(np.array(v[:3])), v[3]) if t >= half else v) for t, top, kind, v in wheels(DRIVE)]


RESET = {
    "reset": lambda p: se2.relative(np.array([5.0, 1.0, 0.3]), p),
    "10 km": lambda p: se2.compose(np.array([1e4, 0.0, 0.0]), p),
    "turned": lambda p: se2.compose(np.array([0.0, 0.0, 2.0]), p),
}


@pytest.mark.parametrize("kind", RESET)
def test_a_jump_of_the_odometry_is_no_motion(tmp_path: Path, kind: str) -> None:
    log = load(tmp_path, [*lasers(DRIVE, LIDAR), *spoilt(RESET[kind]), *MOUNT])
    assert len(log) == SCANS and said(log, "jumps or resets") == 1 and (drift(log) < DRIFT).all()
    (at,) = np.flatnonzero(log.broken)
    assert log.stamps[at] == pytest.approx(START + 10.0, abs=0.11) and at in thin(log)
    assert np.abs(to_episode(log, thin(log)).odometry[:, :2]).max() < 0.5


def test_a_single_wild_odometry_message_is_dropped(tmp_path: Path) -> None:
    wild = [(t, a, b, (1e4, *v[1:]) if n in (100, 200) else v) for n, (t, a, b, v) in enumerate(wheels(DRIVE))]
    log = load(tmp_path, [*lasers(DRIVE, LIDAR), *wild, *MOUNT])
    assert said(log, "far from their neighbours") == 2 and not log.broken.any() and (drift(log) < DRIFT).all()


def test_odometry_that_never_moves_is_said(tmp_path: Path) -> None:
    frozen = [(t, a, b, (0.0, 0.0, 0.0, v[3])) for t, a, b, v in wheels(DRIVE)]
    assert said(load(tmp_path, [*lasers(DRIVE, LIDAR), *frozen, *MOUNT]), "never moves") == 1


@pytest.mark.parametrize("shift", [0.3, -0.3, 40.0, 86400.0])
def test_clocks_that_disagree_are_said_and_corrected(tmp_path: Path, shift: float) -> None:
    entries = [*lasers(DRIVE, LIDAR, shift=shift), *wheels(DRIVE), *MOUNT]
    log = load(tmp_path, entries, clock_offset="auto")
    assert said(log, "clock offset corrected") == 1
    # Scans are 0.1 s apart; a tenth of that, and the 0.6 m that the robot drives meanwhile.
    np.testing.assert_allclose(log.stamps[5:9], scan_stamps(DRIVE)[5:9], atol=0.05)
    if abs(shift) > 1:
        with pytest.raises(UserError, match=r"s apart, not corrected; give --clock-offset -?\d+\.\d\d, or auto"):
            load_log(tmp_path / "made")
    else:
        assert said(load_log(tmp_path / "made"), "not corrected") == 1
    by_hand = load_log(tmp_path / "made", LogOptions(clock_offset=str(-shift)))
    np.testing.assert_allclose(by_hand.stamps[:9], scan_stamps(DRIVE)[:9], atol=1e-6)
    assert not any("clock" in line for line in by_hand.report.lines())


def test_clocks_that_agree_get_no_word(tmp_path: Path) -> None:
    log = load(tmp_path, [*lasers(DRIVE, LIDAR), *wheels(DRIVE), *MOUNT])
    assert log.report.lines() == []
    asked = load_log(tmp_path / "made", LogOptions(clock_offset="auto"))
    assert said(asked, "none found") == 1
    np.testing.assert_array_equal(asked.stamps, log.stamps)


def test_scans_taken_while_turning_are_straightened(tmp_path: Path) -> None:
    stamps_as_taken = [*lasers(SPINNING, LIDAR, beam_time=0.1 / 180), *wheels(SPINNING), *MOUNT]
    log = load(tmp_path, stamps_as_taken)
    bent = load_log(tmp_path / "made", LogOptions(deskew=False))
    assert off(log, SPINNING, 0.85) < 0.03 < 0.05 < off(bent, SPINNING)
    quiet = [(t, a, b, (*v[:4], 0.0)) for t, a, b, v in stamps_as_taken if b == "laser"]
    by_hand = load(tmp_path / "quiet", [*quiet, *wheels(SPINNING), *MOUNT], scan_time=0.1 * 179 / 180)
    np.testing.assert_allclose(by_hand.ranges, log.ranges, atol=1e-4)


def test_a_time_increment_that_cannot_be_is_not_used(tmp_path: Path) -> None:
    wrong = [(t, a, b, (*v[:4], 1.0)) for t, a, b, v in lasers(DRIVE, LIDAR)]
    log = load(tmp_path, [*wrong, *wheels(DRIVE), *MOUNT])
    assert said(log, "time_increment is too long") == SCANS and off(log) < 0.02


def test_masks_and_least_ranges(tmp_path: Path) -> None:
    entries = [*lasers(DRIVE, LIDAR), *wheels(DRIVE), *MOUNT]
    log = load(tmp_path, entries, laser_mask=("170deg:-170deg", "0.0:0.1"), laser_min_range=1.0)
    bearings = np.degrees(log.lidar.angle_min + log.lidar.angle_increment * np.arange(180))
    hidden = np.isnan(log.ranges).all(axis=0)
    np.testing.assert_array_equal(hidden, (np.abs(bearings) >= 170 - 1e-4) | ((bearings > -1e-4) & (bearings < 5.73)))
    assert said(log, "beams of 180 masked") == hidden.sum() and log.lidar.range_min == 1.0
    assert np.isneginf(log.ranges).any() and log.ranges[np.isfinite(log.ranges)].min() >= 1.0
    with pytest.raises(UserError, match="covers every beam"):
        load_log(tmp_path / "made", LogOptions(laser_mask=("-180deg:180deg",)))


def test_the_first_of_several_echoes(tmp_path: Path) -> None:
    echoes = [
        (t, a, "echoes", ([[r, r + 1] if r < 6 else [] for r in v[0]], *v[1:4])) for t, a, _, v in lasers(DRIVE, LIDAR)
    ]
    log = load(tmp_path, [*echoes, *wheels(DRIVE), *MOUNT])
    assert said(log, "several echoes") == SCANS and off(log, least=0.7) < 0.02 and np.isnan(log.ranges).any()


@pytest.mark.parametrize(
    ("code", "told"), [(10.0, 10.0), (11.0, 10.0), (3.4028235e38, 10.0), (3.4e38, 3.4028235e38), (8.19, 30.0)]
)
def test_what_stands_for_no_return_is_found(tmp_path: Path, code: float, told: float) -> None:
    reach = min(8.0, code)
    entries = [
        (t, a, b, (np.where(v[0] < reach, v[0], code), *v[1:], None, told)) for t, a, b, v in lasers(DRIVE, LIDAR)
    ]
    log = load(tmp_path, [*entries, *wheels(DRIVE), *MOUNT])
    gone = np.stack([v[0] >= reach for _, _, _, v in lasers(DRIVE, LIDAR)])
    assert gone.mean() > 0.005
    np.testing.assert_array_equal(np.isposinf(log.ranges), gone)


def test_zeros_beside_long_readings_are_no_returns_and_others_errors(tmp_path: Path) -> None:
    scans, rng = lasers(DRIVE, LIDAR), np.random.default_rng(0)
    far = [(t, a, b, (np.where(v[0] < 6, v[0], 0.0), *v[1:])) for t, a, b, v in scans]
    log = load(tmp_path / "far", [*far, *wheels(DRIVE), *MOUNT])
    gone = np.stack([v[0] >= 6 for _, _, _, v in scans])
    np.testing.assert_array_equal(np.isposinf(log.ranges), gone)
    assert said(log, "readings of 0 m") == gone.sum()
    known = [(t, a, b, (np.where(np.isfinite(v[0]), v[0], np.nan), *v[1:])) for t, a, b, v in scans]
    lost = [(t, a, b, (np.where(rng.random(180) < 0.1, 0.0, v[0]), *v[1:])) for t, a, b, v in known]
    errors = load(tmp_path / "lost", [*lost, *wheels(DRIVE), *MOUNT])
    assert not np.isposinf(errors.ranges).any() and 0.05 < np.isnan(errors.ranges).mean() < 0.15


def test_scans_without_stamps_take_the_time_of_recording(tmp_path: Path) -> None:
    entries = [*lasers(DRIVE, LIDAR), *wheels(DRIVE), *MOUNT]
    path = write_bag(tmp_path, "db3", entries, unstamped="/scan")
    log = load_log(path)
    assert said(log, "the time of recording is taken") == SCANS
    np.testing.assert_allclose(log.stamps, scan_stamps(DRIVE), atol=1e-6)


def test_odometry_of_any_source_makes_a_log(tmp_path: Path) -> None:
    """What scan odometry will use: scans and rows are assembled without a bag."""
    from dsom_jax.data.assemble import Sensor, assemble
    from dsom_jax.data.log import Report
    from dsom_jax.data.log_options import AS_TOLD
    from dsom_jax.data.scans import table

    stamps, rows = scan_stamps(DRIVE), LIDAR.scans(DRIVE, scan_stamps(DRIVE))
    same = {"start": rows[0][2], "end": rows[0][2] + 179 * rows[0][3], "step": rows[0][3], "beam_time": 0.0}
    scans = table([r[0] for r in rows], stamps=stamps, **{k: np.full(len(stamps), v) for k, v in same.items()})
    known = np.column_stack([stamps, DRIVE.at(stamps)])
    log = assemble(scans, known, Sensor(0.1, 10.0, mount=LIDAR.mount), AS_TOLD, Report(), tmp_path)
    np.testing.assert_allclose(log.odometry[:, :2], known[:, 1:3], atol=1e-9)
    assert off(replace(log, path=tmp_path)) < 0.02


@pytest.mark.parametrize(("m", "n"), [(1, 1), (1, 7), (33, 32), (1009, 400)])
def test_the_convolution_is_that_of_its_definition(m: int, n: int) -> None:
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=m), rng.normal(size=n)
    np.testing.assert_allclose(convolved(a, b), np.convolve(a, b), atol=1e-12)
