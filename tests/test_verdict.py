"""Hypotheses, the monitor's signs and the verdict, against counting, geometry and what must never happen."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import tiny_world
from dsom_jax.belief import verdict as v
from dsom_jax.belief.hypotheses import Hypotheses, gather, share_at
from dsom_jax.belief.monitor import Signs, fit, monitor
from dsom_jax.geometry import compose

CLEAN = Signs(*[jnp.float32(0.0)] * len(Signs._fields))


def test_places_are_counted():
    rng = np.random.default_rng(0)
    centres, counts = np.array([[0, 0, 3.1], [8, 0, -1.0], [0, 9, 1.0]]), (120, 60, 20)
    poses = np.concatenate([c + rng.normal(0, 0.1, (n, 3)) for c, n in zip(centres, counts, strict=True)])
    found = gather(jnp.asarray(rng.permutation(poses), jnp.float32), jnp.float32(0.8))
    np.testing.assert_allclose(found.weights[:4], [0.48, 0.24, 0.08, 0.0], atol=1e-6)
    np.testing.assert_allclose(found.means[:3, :2], centres[:, :2], atol=0.08)  # 3 sigma / sqrt(20)
    # pi wraps: the mean heading of the first place is still 3.1.
    assert abs(math.remainder(float(found.means[0, 2]) - 3.1, 2 * math.pi)) < 0.04
    expected = np.cov((poses[:120] - centres[0]).T, bias=True)
    np.testing.assert_allclose(found.covariances[0], expected, atol=2e-3)
    for turns in (-1, 0, 2):  # a filter of one's own need not wrap its headings
        place = jnp.array([8.2, 0.1, -1.1 + turns * 2 * math.pi])
        assert float(share_at(jnp.asarray(poses, jnp.float32), place)) == pytest.approx(0.3)


def test_fit_tells_short_from_long_from_unknown():
    wall = jnp.full(8, 4.0)
    ranges = jnp.array([4.0, 4.2, 1.0, 6.0, jnp.inf, -jnp.inf, jnp.nan, 4.0])
    seen = wall.at[7].set(2.0)
    # Beam 4 sees nothing where a wall is: it went through. 5 and 6 say nothing, 7 looks into the unknown.
    found = fit(ranges, wall, seen, 10.0)
    np.testing.assert_allclose(found, [2 / 5, 1 / 5, 2 / 5, 1 / 6, 5 / 8], atol=1e-6)
    # At an edge the neighbour's wall will do; nothing where nothing is expected is no evidence.
    step = jnp.array([2.0, 2.0, 6.0, 6.0])
    assert float(fit(jnp.array([2.0, 6.0, 2.0, 6.0]), step, step, 10.0).hit) == 1.0
    nothing = jnp.full(4, jnp.inf)
    assert float(fit(nothing, nothing, nothing, 10.0).known) == 0.0


def watched(offset: float, sign: float = 1.0):
    """Signs after a drive whose answers are turned by ``offset`` against the way that they go."""
    watcher = monitor(tiny_world.tables(), tiny_world.LIDAR)
    episode = tiny_world.drive(10)
    answers = jnp.asarray(np.asarray(episode.poses) + np.array([0, 0, offset]), jnp.float32)
    track = watcher.start(jnp.zeros(3))
    step = jax.jit(watcher.watch)
    for t in range(10):
        odometry = episode.odometry[t] * jnp.array([sign, sign, 1.0])
        first, zero = jnp.bool_(t == 0), jnp.float32(0.0)
        track, signs = step(track, answers[t], episode.ranges[t], odometry, first, zero, zero)
    return signs, track


def test_a_perfect_answer_shows_no_sign():
    signs, _ = watched(0.0)
    # The chord of an arc is half a turn ahead of its tangent: 0.06 rad, of which a third is believed after 1.35 m.
    for name, value in signs._asdict().items():
        # exp(-1.35 / 0.45) is left of what only driving can show.
        assert float(value) < {"crab": 0.08, "fresh": 0.051}.get(name, 0.02), name


def test_little_is_believed_before_the_robot_has_driven():
    watcher = monitor(tiny_world.tables(), tiny_world.LIDAR)
    scan = jnp.full(tiny_world.LIDAR.beams, jnp.nan)
    step, zero = jax.jit(watcher.watch), jnp.float32(0.0)
    track, fresh = watcher.start(jnp.zeros(3)), []
    for t, travel in enumerate([5.0, 0.0, 0.0, 0.9]):  # that of the first update is none; then turns on the spot
        pose = jnp.array([0.9 * (t == 3), 0.0, 0.5 * min(t, 2)])
        odometry = jnp.array([travel, 0.0, 0.5])
        track, signs = step(track, pose, scan, odometry, jnp.bool_(t == 0), zero, zero)
        fresh.append(float(signs.fresh))
    turned = np.array([0.0, 0.03, 0.06, 0.09])  # 0.06 m for each radian
    np.testing.assert_allclose(fresh, np.exp(-(turned + np.array([0, 0, 0, 0.9])) / 0.45), rtol=1e-5)
    # An encoder's glitch shows nothing, nor does a jump of the answer; without odometry the answers' own way must do.
    cases = [([0.9, 0, 1], [5, 0, 0], 0.0), ([9, 0, 1], [0.5, 0, 0], 0.0), ([1.1, 0, 1], [0, 0, 0], 0.2)]
    for pose, told, more in cases:
        pose, told = jnp.array(pose, jnp.float32), jnp.array(told, jnp.float32)
        after, _ = step(track, pose, scan, told, jnp.bool_(False), zero, zero)
        assert float(after.driven - track.driven) == pytest.approx(more, abs=1e-5)
    told = step(watcher.start(jnp.zeros(3)), jnp.zeros(3), scan, jnp.zeros(3), jnp.bool_(False), zero, zero)
    assert float(told[1].fresh) == 0.0


def test_a_turned_lidar_shows_as_a_crab():
    signs, track = watched(math.radians(20))
    crab = math.atan2(abs(float(track.cross)), float(track.along))
    assert crab == pytest.approx(math.radians(20), abs=0.07) and float(signs.backward) == 0
    # Turned right round, every step is answered backwards; the way itself is straight.
    signs, track = watched(math.pi)
    assert float(track.back) == pytest.approx(float(track.path)) and float(track.path) > 1
    assert float(signs.backward) == pytest.approx(float(track.path) / (float(track.path) + 0.3))
    assert math.atan2(abs(float(track.cross)), float(track.along)) < 0.1


def test_a_jump_is_no_step():
    watcher = monitor(tiny_world.tables(), tiny_world.LIDAR)
    episode = tiny_world.drive(3)
    zero = jnp.float32(0.0)
    track, _ = watcher.watch(
        watcher.start(jnp.zeros(3)),
        episode.poses[0],
        episode.ranges[0],
        episode.odometry[0],
        jnp.bool_(True),
        zero,
        zero,
    )
    away = compose(episode.poses[1], jnp.array([3.0, 0.0, 0.0]))
    track, signs = watcher.watch(track, away, episode.ranges[1], episode.odometry[1], jnp.bool_(False), zero, zero)
    assert float(signs.jump) == 1.0 and float(track.steps) == 0.0 and float(track.squared) == 0.0


@given(
    st.lists(st.floats(0, 1), min_size=len(Signs._fields), max_size=len(Signs._fields)),
    st.integers(0, len(Signs._fields) - 1),
    st.floats(0, 1),
)
def test_no_sign_of_trouble_makes_an_answer_more_credible(values, which, more):
    worse = list(values)
    worse[which] += more
    low, high = (float(v.p_lost(Signs(*map(jnp.float32, s)), v.SHIPPED_HEAD)) for s in (values, worse))
    assert high >= low - 1e-6


def test_the_shipped_head_is_whole():
    head = v.SHIPPED_HEAD
    assert len(head.tolerances) == len(Signs._fields) - 2 and min(head.tolerances) > 0 and head.slope > 0
    assert float(v.p_lost(CLEAN, head)) < v.CERTAIN
    # A crab is the error of the heading itself: at 10 degrees an answer is as likely wrong as right.
    assert float(v.p_lost(CLEAN._replace(crab=jnp.float32(math.radians(10))), head)) == pytest.approx(0.5, abs=0.01)


def test_doubt_by_hand():
    head = v.Head(2.0, tuple(0.5 if name == "long" else 0.25 for name in Signs._fields[2:]))
    signs = CLEAN._replace(long=jnp.float32(0.5), crab=jnp.float32(0.25), miss=jnp.float32(-1.0))
    assert float(v.doubt(signs, head)) == pytest.approx(2**0.125)
    faulty = 1 / (1 + math.exp(-2 * (2**0.125 - 1)))
    assert float(v.p_lost(signs, head)) == pytest.approx(faulty, abs=1e-6)
    # At one of two equal places an answer is right in half of all cases, at best.
    torn = signs._replace(elsewhere=jnp.float32(0.5), scattered=jnp.float32(0.1))
    assert float(v.p_lost(torn, head)) == pytest.approx(1 - 0.5 * (1 - faulty), abs=1e-6)


def told(before, p, off=0.0, on_map=True, unknown=0.0, weights=(1.0,)):
    padded = jnp.zeros(8).at[: len(weights)].set(jnp.array(weights))
    places = Hypotheses(padded, jnp.zeros((8, 3)), jnp.zeros((8, 3, 3)))
    words = map(jnp.asarray, (before, p, off, on_map, unknown))
    return v.Verdict(int(v.judge(*words, places)))


@pytest.mark.parametrize(
    ("case", "expected"),
    [
        ({"before": v.Verdict.LOST, "p": 0.01}, v.Verdict.LOCALIZED),
        ({"before": v.Verdict.LOST, "p": 0.04}, v.Verdict.LOST),
        ({"before": v.Verdict.LOCALIZED, "p": 0.04}, v.Verdict.LOCALIZED),
        ({"before": v.Verdict.LOCALIZED, "p": 0.06}, v.Verdict.LOST),
        ({"before": v.Verdict.LOCALIZED, "p": 0.5, "weights": (0.5, 0.5)}, v.Verdict.AMBIGUOUS),
        ({"before": v.Verdict.LOST, "p": 0.9, "weights": (0.1, 0.1)}, v.Verdict.LOST),
        ({"before": v.Verdict.LOCALIZED, "p": 0.9, "off": 0.8}, v.Verdict.OFF_MAP),
        ({"before": v.Verdict.LOCALIZED, "p": 0.9, "on_map": False, "weights": (0.5, 0.5)}, v.Verdict.OFF_MAP),
        ({"before": v.Verdict.LOST, "p": 0.3, "unknown": 0.6}, v.Verdict.OFF_MAP),
    ],
)
def test_verdicts(case, expected):
    assert told(**case) == expected
