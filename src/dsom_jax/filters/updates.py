"""The two updates that Alg 1 mixes: MCL for trusted particles, dual MCL for the rest; sizes vary, shapes do not."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple, get_args

import jax
import jax.numpy as jnp

from dsom_jax import checks
from dsom_jax.filters.common import Info, ParticleState, describe, normalise
from dsom_jax.filters.world import World
from dsom_jax.resampling import Resampling, pick
from dsom_jax.types import Array, Inputs, Key, Proposal

Predecessor = Literal["knn", "motion"]
_NEIGHBOURS = 3


@dataclass(frozen=True)
class FilterConfig:
    """Choices of a Score-weighted filter (static).

    Attributes:
        particles: N.
        predecessor: how dual MCL finds the particle whose weight a redrawn one inherits: ``knn`` draws from the three
            nearest moved particles by inverse distance (the authors' way), ``motion`` by p(l' | a, l).
        resampling: scheme for the MCL part.
        weight_power: w_norm, by which particles are drawn, is proportional to w to this power; trust is w itself.
        estimate_power: the same for the estimates. Both are 1 in the paper.
    """

    particles: int = 200
    predecessor: Predecessor = "knn"
    resampling: Resampling = "systematic"
    weight_power: float = 1.0
    estimate_power: float = 1.0

    def __post_init__(self) -> None:
        checks.count(self, "particles")
        checks.positive(self, "weight_power estimate_power")
        checks.choice(self, "predecessor", get_args(Predecessor))
        checks.choice(self, "resampling", get_args(Resampling))


class Draw(NamedTuple):
    """Poses (N, 3) and raw weights w (N,) of the new particles."""

    poses: Array
    weights: Array


def even_particles(key: Key, world: World, config: FilterConfig) -> ParticleState:
    """Uniform particles over free space: no prior."""
    poses, _ = world.space.sample(key, None, config.particles)
    even = jnp.full((config.particles,), 1.0 / config.particles, jnp.float32)
    return ParticleState(poses, jnp.zeros(config.particles), even, jnp.int32(0))


def masked_ancestors(key: Key, normalised: Array, member: Array, method: Resampling) -> Array:
    """(N,) ancestors drawn by w_norm among ``member`` (N,) only, one stratum for each member's slot."""
    mass = jnp.where(member, normalised, 0.0)
    # High powers of small weights vanish; members whose weights all do are equally good.
    cumulative = jnp.cumsum(jnp.where(mass.sum() > 0, mass, member))
    if method == "multinomial":
        return pick(cumulative, jax.random.uniform(key, member.shape))
    count = jnp.maximum(member.sum(), 1)
    rank = jnp.cumsum(member) - member
    return pick(cumulative, (rank % count + jax.random.uniform(key)) / count)


def resample_and_move(
    key: Key, state: ParticleState, member: Array, inputs: Inputs, world: World, config: FilterConfig
) -> Array:
    """Poses (N, 3): sample h from H by w_norm, move it (Alg 1, lines 10 to 12)."""
    k_resample, k_move = jax.random.split(key)
    ancestors = masked_ancestors(k_resample, state.normalised, member, config.resampling)
    return world.motion.sample(k_move, state.poses[ancestors], inputs.odometry)


def redraw(
    key: Key,
    state: ParticleState,
    inputs: Inputs,
    world: World,
    proposal: Proposal,
    prepared: Any,
    config: FilterConfig,
) -> tuple[Array, Array]:
    """Sample l' (N, 3) from PM and give it the weight (N,) of a predecessor (Alg 1, lines 15 to 19)."""
    k_draw, k_move, k_match = jax.random.split(key, 3)
    poses, _ = proposal.sample(k_draw, prepared, config.particles)
    if config.predecessor == "motion":
        log_match = world.motion.log_prob(poses[:, None], state.poses, inputs.odometry)
        parents = _by_motion(k_match, log_match)
    else:
        parents = _by_distance(k_match, poses, world.motion.sample(k_move, state.poses, inputs.odometry))
    return poses, state.weights[parents]


def _by_motion(key: Key, log_match: Array) -> Array:
    """One index per row of log p(l' | a, l) (N', N), by its exponential."""
    match = jnp.exp(log_match - log_match.max(-1, keepdims=True))
    return jax.vmap(pick)(jnp.cumsum(match, -1), jax.random.uniform(key, log_match.shape[:1]))


def _by_distance(key: Key, poses: Array, moved: Array) -> Array:
    """One of the three ``moved`` particles (N, 3) nearest to each of ``poses`` (N', 3), by inverse distance."""
    count = min(_NEIGHBOURS, moved.shape[0])
    squared, index = _nearest(poses, moved, count)
    closeness = 1.0 / (jnp.sqrt(squared) + 1e-6)
    chosen = jax.vmap(pick)(jnp.cumsum(closeness, -1), jax.random.uniform(key, poses.shape[:1]))
    return jnp.take_along_axis(index, chosen[:, None], 1)[:, 0]


def _nearest(poses: Array, others: Array, count: int) -> tuple[Array, Array]:
    """Squared distances in (x, y, theta) and indices (N', count) of the nearest ``others``.

    The index replaces the lowest bits of the distance, so that each neighbour is one vectorised minimum.
    """
    # Without the barriers XLA computes particles and distances again for each neighbour.
    poses, others = jax.lax.optimization_barrier((poses, others))
    dx, dy, turn = (jnp.abs(poses[:, None, axis] - others[:, axis]) for axis in range(3))
    squared = dx**2 + dy**2 + jnp.minimum(turn, 2 * jnp.pi - turn) ** 2  # headings lie in [-pi, pi)
    bits = max(1, (others.shape[0] - 1).bit_length())
    low = (1 << bits) - 1
    keys = (jax.lax.bitcast_convert_type(squared, jnp.int32) & ~low) | jnp.arange(others.shape[0], dtype=jnp.int32)
    keys = jax.lax.optimization_barrier(keys)
    found = [keys.min(-1)]
    for _ in range(count - 1):
        found.append(jnp.where(keys > found[-1][:, None], keys, jnp.iinfo(jnp.int32).max).min(-1))
    best = jnp.stack(found, -1)
    return jax.lax.bitcast_convert_type(best & ~low, jnp.float32), best & low


def powered(weights: Array, power: float) -> Array:
    """Weights (N,) to a power, normalised; taken in units of the largest, as powers of small numbers vanish."""
    return normalise(weights if power == 1 else (weights / weights.max()) ** power)


def conclude(
    state: ParticleState, draw: Draw, redrawn: Array, spare: Array, config: FilterConfig
) -> tuple[ParticleState, Info]:
    """P_t and what it says, ``redrawn`` () the share of new poses; if every weight has vanished, the poses ``spare``
    (N, 3) take over (flagged in Info).

    They are trusted for one update, or none of them would ever be weighed.
    """
    dead = ~(draw.weights.sum() > 0)
    poses = jnp.where(dead, spare, draw.poses)
    weights = jnp.where(dead, 1.0, draw.weights)
    info = describe(poses, powered(weights, config.estimate_power), redrawn, dead)
    return ParticleState(poses, weights, powered(weights, config.weight_power), state.updates + 1), info


def mixture_update(
    key: Key,
    state: ParticleState,
    high: Array,
    inputs: Inputs,
    world: World,
    proposal: Proposal,
    prepared: Any,
    config: FilterConfig,
) -> tuple[ParticleState, Info]:
    """MCL update of the particles ``high`` (N,), dual MCL update of the others (Alg 1, lines 10 to 21)."""
    k_high, k_low = jax.random.split(key)
    kept = resample_and_move(k_high, state, high, inputs, world, config)
    fresh, inherited = redraw(k_low, state, inputs, world, proposal, prepared, config)
    weights = jnp.where(high, world.weigh(kept, inputs.ranges), inherited)
    draw = Draw(jnp.where(high[:, None], kept, fresh), weights)
    return conclude(state, draw, 1.0 - high.mean(), fresh, config)


@dataclass(frozen=True)
class SharedProposal:
    """What the filters that mix MCL and dual MCL have in common.

    Attributes:
        world: map and models.
        proposal: samplable observation model of the dual update; DSOM in the paper.
        config: particles, predecessor rule, resampling (static).
    """

    world: World
    proposal: Proposal
    config: FilterConfig = field(metadata={"static": True})

    def begin(self) -> Any:
        """The proposal's memory."""
        return self.proposal.begin()

    def prepare(self, memory: Any, inputs: Inputs) -> tuple[Any, Any]:
        """The proposal for this scan, and its memory."""
        return self.proposal.prepare(memory, inputs)

    def init(self, key: Key) -> ParticleState:
        """Uniform particles."""
        return even_particles(key, self.world, self.config)
