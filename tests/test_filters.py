"""Filters by what they do: equivalences, guards, inheritance, Algorithm 1, convergence."""

# ruff: noqa: F811

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import tiny_world
from dsom_jax import montecarlo
from dsom_jax.episode import Episode
from dsom_jax.filters.adam import AdamMCL
from dsom_jax.filters.adam_robust import RobustState
from dsom_jax.filters.common import ParticleState, heaviest_cluster
from dsom_jax.filters.mcl import MCL
from dsom_jax.filters.methods import make_filter
from dsom_jax.filters.mixture import MixtureMCL
from dsom_jax.filters.settings import Settings, with_motion, with_sensor
from dsom_jax.filters.updates import FilterConfig
from dsom_jax.geometry import wrap_angle
from dsom_jax.montecarlo import run, run_keys
from dsom_jax.motion import OdometryMotion, omni_like
from dsom_jax.proposals.likelihood_grid import likelihood_grid
from dsom_jax.proposals.uniform import free_space
from filters_kit import (  # noqa: F401, fixtures
    GRID,
    LIDAR,
    MCL_ONLY,
    STILL,
    at,
    episode,
    follow,
    grid,
    in_spot,
    robust,
    spot,
    step,
    tiny_trust,
    world,
)
from reference import alg1, se2


@pytest.fixture(scope="module")
def scan_grid(grid):
    return likelihood_grid(grid, LIDAR, GRID)


def identical(a, b):
    jax.tree.map(np.testing.assert_array_equal, a, b)


@pytest.mark.parametrize("power", [1.0, 5.0])
def test_adam_that_trusts_everyone_is_mcl_is_mixture_that_never_redraws(power, world, spot, episode):
    config = replace(MCL_ONLY, weight_power=power, estimate_power=3.0)
    mcl = follow(MCL(world, config, injection=0.0), episode, 4)
    adam = follow(AdamMCL(world, spot, config, t_cut=0.0), episode, 4)
    mixture = follow(MixtureMCL(world, spot, config, p=1.0), episode, 4)
    for (a, _), (b, _), (c, _) in zip(mcl, adam, mixture, strict=True):
        identical(a, b)
        identical(a, c)


def test_mixture_that_always_redraws_is_dual_mcl_after_the_first_update(world, spot, episode):
    dual = follow(MixtureMCL(world, spot, MCL_ONLY, p=0.0), episode, 3)
    mcl = follow(MCL(world, MCL_ONLY, injection=0.0), episode, 1)
    identical(dual[0][0], mcl[0][0])
    assert float(dual[0][1].redrawn) == 0 and not in_spot(spot, dual[0][0].poses).any()
    for (before, _), (after, info) in pairwise(dual):
        assert float(info.redrawn) == 1 and in_spot(spot, after.poses).mean() > 0.95
        assert np.isin(np.asarray(after.weights), np.asarray(before.weights)).all()


def test_mixture_tosses_one_coin_for_the_whole_set(world, spot, episode):
    shares = [float(info.redrawn) for seed in range(6) for _, info in follow(half(world, spot), episode, 4, seed)[1:]]
    assert set(shares) == {0.0, 1.0}
    assert 3 <= sum(shares) <= 15  # 18 tosses: outside has a probability of 1e-3


def half(world, spot):
    return MixtureMCL(world, spot, MCL_ONLY, p=0.5)


def test_first_update_of_adam_is_mcl_and_later_ones_are_not(world, spot, episode):
    passed = follow(AdamMCL(world, spot, MCL_ONLY, t_cut=0.6), episode, 2)
    assert float(passed[0][1].redrawn) == 0 and not in_spot(spot, passed[0][0].poses).any()
    share = in_spot(spot, passed[1][0].poses).mean()
    assert 0.1 < share < 1 and abs(share - float(passed[1][1].redrawn)) < 0.05


def test_trust_decides_who_is_redrawn(world, spot, episode):
    """T above T_cut is always kept, below it with probability T."""
    poses = jnp.broadcast_to(episode.poses[0], (64, 3))
    trust = jnp.repeat(jnp.array([0.65, 0.5, 0.1, 0.0]), 16)
    f = AdamMCL(world, spot, MCL_ONLY, t_cut=0.6)
    state = ParticleState(poses, trust, jnp.full(64, 1 / 64), jnp.int32(1))
    # Slots keep their order: quarter by quarter.
    sets = [step(f, key, state, at(episode, 1))[0].poses for key in jax.random.split(jax.random.key(0), 60)]
    kept = [1 - in_spot(spot, poses).reshape(4, -1).mean(1) for poses in sets]
    np.testing.assert_allclose(np.mean(kept, 0), [1.0, 0.5, 0.1, 0.0], atol=5 * 0.5 / np.sqrt(60 * 16))


def test_weights_are_raised_to_a_power_and_trust_is_not(world, spot, episode):
    """The first update is the same for all powers but for w_norm; the next one resamples by it, systematically."""
    still = replace(world, motion=STILL)
    ((first, _),) = follow(AdamMCL(still, spot, MCL_ONLY, t_cut=0.0), episode, 1)
    config = replace(MCL_ONLY, weight_power=5.0)
    (sharp, _), (after, _) = follow(AdamMCL(still, spot, config, t_cut=0.0), episode, 2)
    identical((first.poses, first.weights), (sharp.poses, sharp.weights))
    powered = np.asarray(first.weights, np.float64) ** 5
    np.testing.assert_allclose(sharp.normalised, powered / powered.sum(), rtol=1e-5)
    np.testing.assert_allclose(first.normalised, first.weights / first.weights.sum(), rtol=1e-5)
    moved = se2.compose(np.asarray(first.poses, np.float64), np.asarray(episode.odometry[1], np.float64))
    parents = np.abs(np.asarray(after.poses)[:, None, :2] - moved[None, :, :2]).sum(-1).argmin(1)
    children = np.bincount(parents, minlength=64)
    assert (np.abs(children - 64 * powered / powered.sum()) < 1.001).all()  # a systematic draw rounds up or down
    assert np.abs(children - 64 * np.asarray(first.normalised)).max() > 1.5


def test_estimates_have_a_power_of_their_own(world, spot, episode):
    """It changes no particle; the mean is that of the weights to the power."""
    f = AdamMCL(world, spot, MCL_ONLY)
    plain, powered = (follow(replace(f, config=replace(MCL_ONLY, estimate_power=p)), episode, 3) for p in (1.0, 6.0))
    identical([state for state, _ in plain], [state for state, _ in powered])
    state, info = powered[-1]
    share = np.asarray(state.weights, np.float64) ** 6
    expected = (np.asarray(state.poses)[:, :2] * share[:, None]).sum(0) / share.sum()
    np.testing.assert_allclose(info.mean[:2], expected, rtol=1e-4)


def test_powers_of_tiny_weights_do_not_vanish(world, spot, episode, grid):
    """Weights of 1e-12 to the power of eight are below what single precision can hold."""
    f = AdamMCL(world, spot, replace(MCL_ONLY, weight_power=8.0))
    before = tiny_trust(grid, 64)  # all are redrawn and inherit one of these
    after, _ = step(f, jax.random.key(0), before, at(episode, 1))
    inherited = np.asarray(after.weights, np.float64) ** 8
    np.testing.assert_allclose(after.normalised, inherited / inherited.sum(), rtol=1e-4)


@pytest.mark.parametrize("rule", ["knn", "motion"])
def test_weights_are_inherited_from_a_predecessor(rule, world, episode, grid):
    n = 300
    motion = OdometryMotion(0.05, 0.05, 0.05, 0.05, 0.2, 0.2) if rule == "motion" else STILL
    f = AdamMCL(replace(world, motion=motion), world.space, FilterConfig(n, predecessor=rule), t_cut=0.6)
    before, odometry = tiny_trust(grid, n), episode.odometry[1]
    after, _ = step(f, jax.random.key(0), before, at(episode, 1))
    parents = np.round(np.asarray(after.weights) / 1e-12).astype(int) - 1
    fresh = np.asarray(after.poses, np.float64)
    if rule == "motion":
        log_p = np.asarray(motion.log_prob(after.poses[:, None], before.poses, odometry), np.float64)
        share = np.exp(log_p - log_p.max(1, keepdims=True))
    else:
        moved = se2.compose(np.asarray(before.poses), np.asarray(odometry))
        gap = np.hypot(*(fresh[:, None, :2] - moved[:, :2]).transpose(2, 0, 1))
        distance = np.hypot(gap, se2.angle_gap(fresh[:, None, 2], moved[:, 2]))
        third = np.sort(distance, 1)[:, 2:3]
        share = np.where(distance <= third, 1 / distance, 0.0)
        # Distances are compared to within 2^-14, as indices take their lowest bits.
        assert (distance[np.arange(n), parents] <= third[:, 0] * (1 + 2.0**-12)).all()
    share /= share.sum(1, keepdims=True)
    # Drawn by these shares, the mean share of the drawn is the mean of sum(share^2).
    got, expected = share[np.arange(n), parents], (share**2).sum(1)
    spread = np.sqrt(((share**3).sum(1) - expected**2).sum()) / n
    assert abs(got.mean() - expected.mean()) < 5 * spread


def test_algorithm_1_line_by_line(world, episode, grid):
    """Means over 40 updates of the same set by the filter and by the loop over particles."""
    n, runs = 48, 40
    rng = np.random.default_rng(0)
    near = np.asarray(episode.poses[0]) + rng.normal(0, [0.3, 0.3, 0.2], (n, 3))
    trust = rng.uniform(0.05, 0.9, n)
    config = FilterConfig(n, resampling="multinomial")
    state = ParticleState(*(jnp.asarray(v, jnp.float32) for v in (near, trust, trust / trust.sum())), jnp.int32(1))
    f, now = AdamMCL(world, world.space, config, t_cut=0.6), at(episode, 1)
    many = jax.jit(jax.vmap(lambda key: f.step(key, state, now, None)))
    after, info = many(jax.random.split(jax.random.key(0), runs))

    padded = lambda a: jnp.asarray(np.resize(a, (n, 3)), jnp.float32)  # noqa: E731, one shape, one compilation
    keys = iter(jax.random.split(jax.random.key(1), 3 * runs))
    move = jax.jit(lambda key, poses: world.motion.sample(key, poses, now.odometry))
    weigh = jax.jit(lambda poses: world.weigh(poses, now.ranges))
    draw = jax.jit(lambda key: world.space.sample(key, None, n)[0])
    slow = [
        alg1.adam_mcl(
            rng,
            near,
            trust / trust.sum(),
            trust,
            0.6,
            lambda poses: np.asarray(move(next(keys), padded(poses)), np.float64)[: len(poses)],
            lambda poses: np.asarray(weigh(padded(poses)))[: len(poses)],
            lambda count: np.asarray(draw(next(keys)), np.float64)[:count],
        )
        for _ in range(runs)
    ]
    ours = np.stack([1 - info.redrawn, after.weights.mean(1), *after.poses[..., :2].mean(1).T, after.weights.std(1)])
    theirs = np.array([[h / n, w.mean(), *p[:, :2].mean(0), w.std()] for p, w, h in slow]).T
    error = np.sqrt(ours.var(1) / runs + theirs.var(1) / runs)
    assert (np.abs(ours.mean(1) - theirs.mean(1)) < 4.5 * error).all(), (ours.mean(1), theirs.mean(1), error)


def final_errors(f, episode, runs=8):
    """(R, T) metres of the cluster estimate, and the result."""
    result = montecarlo.run(f, episode, montecarlo.run_keys(0, 0, runs))
    gap = np.asarray(result.info.cluster) - np.asarray(episode.poses)
    return np.hypot(gap[..., 0], gap[..., 1]), result


TRACES = []


@dataclass(frozen=True)
class Counted(OdometryMotion):
    """Notes each time that it is traced."""

    def sample(self, key, poses, odometry):
        TRACES.append(1)
        return super().sample(key, poses, odometry)


def test_adam_finds_the_robot_and_is_compiled_once(world, scan_grid, episode):
    f = AdamMCL(replace(world, motion=Counted()), scan_grid, FilterConfig(200))
    errors, result = final_errors(f, episode)
    assert np.median(errors[:, -1]) < 0.25 and (errors[:, -3:] < 0.5).mean() > 0.8
    # Weights are in units of w*: no trust exceeds one.
    assert float(result.state.weights.max()) <= 1 + 1e-5
    once = len(TRACES)
    backwards = jax.tree.map(lambda leaf: leaf[::-1], episode)
    montecarlo.run(f, backwards, montecarlo.run_keys(1, 5, 8))
    assert len(TRACES) == once > 0


def carried_away(episode):
    """Eight updates of the drive, then the robot stands in the corner beyond the nook for five."""
    corner = tiny_world.grid().from_grid(jnp.array([0.9, 0.9, 1.9]))
    poses = jnp.concatenate([episode.poses[:8], jnp.broadcast_to(corner, (5, 3))])
    odometry = jnp.concatenate([episode.odometry[:8], jnp.zeros((5, 3))])
    ranges = tiny_world.cast(tiny_world.tables(), poses, LIDAR)
    return Episode(ranges, odometry, poses, jnp.arange(13) == 8, jnp.arange(13.0))


def test_robust_finds_the_robot_keeps_it_and_finds_it_again(world, scan_grid, episode):
    f, moved = robust(world, scan_grid), carried_away(episode)
    errors, result = final_errors(f, moved)
    lost = np.asarray(result.info.lost)
    assert (errors[:, 3:8] < 0.25).all() and np.median(lost[:, 3:8]) < 0.1
    assert (errors[:, -1] < 0.25).all()
    assert not np.asarray(result.info.restarted).any()
    # Scans that say nothing leave it knowing that it knows nothing.
    blind = moved._replace(ranges=jnp.full_like(moved.ranges, jnp.nan))
    assert (np.asarray(final_errors(f, blind)[1].info.lost)[:, 0] > 0.7).all()


def test_heaviest_cluster_is_not_the_mean_of_two_places():
    rng = np.random.default_rng(0)
    here = np.array([1.0, 2.0, np.pi]) + rng.normal(0, 0.05, (60, 3))
    there = np.array([8.0, 2.0, 0.0]) + rng.normal(0, 0.05, (60, 3))
    weights = np.repeat([0.6 / 60, 0.4 / 60], 60)
    poses = jnp.asarray(np.concatenate([here, there]), jnp.float32)
    centre, mass = jax.jit(heaviest_cluster)(poses, jnp.asarray(weights, jnp.float32))
    assert np.hypot(*(np.asarray(centre)[:2] - [1.0, 2.0])) < 0.05 and se2.angle_gap(float(centre[2]), np.pi) < 0.05
    assert float(mass) == pytest.approx(0.6, abs=1e-4)


@pytest.mark.parametrize("name", ["beam", "likelihood_field", "score"])
def test_adam_robust_finds_the_robot_with_any_sensor_model(grid, episode, scan_grid, name):
    settings = with_sensor(Settings(particles=150, grid=GRID), name)
    filter = make_filter("adam_robust", scan_grid, grid, LIDAR, settings)
    assert filter.world.sensor.range_max == LIDAR.range_max
    found = np.asarray(run(filter, episode, run_keys(0, 0, 4)).info.cluster)[:, -1]
    off = found - np.asarray(episode.poses)[-1]
    assert (np.hypot(off[:, 0], off[:, 1]) < 0.5).all() and (np.abs(wrap_angle(off[:, 2])) < np.radians(10)).all()


def test_a_drive_that_moves_sideways_is_chosen_by_name(grid):
    settings = with_motion(Settings(), "omni")
    assert with_motion(Settings(), "differential") == Settings()
    for name, own in (("mcl", Settings().motion), ("adam_robust", Settings().robust_motion)):
        assert make_filter(name, free_space(grid), grid, LIDAR, settings).world.motion == omni_like(own)


@pytest.mark.parametrize("resampling", ["systematic", "multinomial"])
def test_kept_particles_descend_from_kept_ones(resampling, world, spot, episode):
    """Alg 1, line 11: h is sampled from H, however heavy those are that are not in it."""
    config = replace(MCL_ONLY, resampling=resampling)
    f = AdamMCL(replace(world, motion=STILL), spot, config, t_cut=0.6)
    here, there = episode.poses[0], episode.poses[9]
    poses = jnp.where(jnp.arange(64)[:, None] < 32, here, there)
    trust = jnp.where(jnp.arange(64) < 32, 0.9, 0.0)
    state = ParticleState(poses, trust, jnp.where(jnp.arange(64) < 32, 1e-3, 1.0), jnp.int32(1))
    after, info = step(f, jax.random.key(0), state, at(episode, 0)._replace(odometry=jnp.zeros(3)))
    assert float(info.redrawn) == 0.5
    np.testing.assert_allclose(after.poses[:32], jnp.broadcast_to(here, (32, 3)), atol=1e-5)
    assert in_spot(spot, after.poses[32:]).mean() > 0.9


@pytest.mark.parametrize("injection", [0.0, 0.25, 1.0])
def test_mcl_injects_its_share_of_random_particles(injection, world, episode):
    f = MCL(replace(world, motion=STILL), MCL_ONLY, injection)
    poses = jnp.broadcast_to(episode.poses[0], (64, 3))
    state = ParticleState(poses, jnp.ones(64), jnp.full(64, 1 / 64), jnp.int32(1))
    after, _ = step(f, jax.random.key(0), state, at(episode, 0)._replace(odometry=jnp.zeros(3)))
    away = np.hypot(*np.asarray(after.poses - poses)[:, :2].T) > 1e-4
    assert away.sum() == round(64 * injection)
    assert away[:: max(1, round(1 / max(injection, 1e-9)))].all() or injection == 0  # spread over the whole set


@pytest.mark.parametrize("lost", [0.8, 0.3])
def test_a_lost_filter_leaves_out_a_share_of_the_evidence(lost, world, spot, episode):
    """log w = prior + (1 - caution * lost) log p(z | x): of the same draws, all differences are the evidence's."""
    n, now, caution = 64, at(episode, 2), 0.5
    poses, _ = world.space.sample(jax.random.key(5), None, n)
    state = RobustState(poses, jnp.full(n, -np.log(n), jnp.float32), jnp.float32(lost), jnp.int32(3))
    weighed = []
    for share in (0.0, caution):
        f = robust(world, spot, n, caution=share)
        after, _ = step(f, jax.random.key(1), state, now)
        weighed.append(np.asarray(after.log_weights, np.float64))
    evidence = np.asarray(f.world.log_likelihood(after.poses, now.ranges), np.float64)
    alive = np.isfinite(weighed[0]) & np.isfinite(weighed[1])
    rest = (weighed[1] - weighed[0] + caution * lost * evidence)[alive]
    assert alive.sum() > 20 and np.ptp(evidence[alive]) > 1
    np.testing.assert_allclose(rest, rest.mean(), atol=2e-3)


def test_the_heaviest_cluster_is_the_mean_of_its_members_and_no_particle():
    rng = np.random.default_rng(1)
    poses = np.array([2.0, -1.0, 0.5]) + rng.normal(0, [0.2, 0.2, 0.05], (120, 3))
    weights = rng.uniform(0.1, 1.0, 120)
    weights /= weights.sum()
    centre, mass = jax.jit(heaviest_cluster)(jnp.asarray(poses, jnp.float32), jnp.asarray(weights, jnp.float32))
    # All lie within 1 m and 20 deg of their mean, so that it is the mean of the cluster.
    np.testing.assert_allclose(centre, weights @ poses, atol=1e-4)
    assert float(mass) == pytest.approx(1.0, abs=1e-5)


def test_a_cluster_is_found_from_its_edge():
    """The one candidate lies 0.8 m to one side of most of the weight; two mean shifts go there."""
    poses = np.zeros((120, 3))
    poses[:, 0] = np.linspace(0, 1.6, 120)
    weights = np.full(120, 1 / 120)
    centre, _ = jax.jit(heaviest_cluster)(jnp.asarray(poses, jnp.float32), jnp.asarray(weights, jnp.float32))
    assert abs(float(centre[0]) - 0.8) < 0.02
