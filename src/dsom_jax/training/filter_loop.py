"""Training of PF-Net and PFRNN on sequences: configuration, state, one jitted step, called from a Python loop."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import nnx

from dsom_jax import checks
from dsom_jax.compiling import training_options
from dsom_jax.filters.learned import Learned, Prior, scatter
from dsom_jax.filters.pf_net import PFNetFilter
from dsom_jax.filters.pfrnn import PFRNNFilter
from dsom_jax.nn.kinds import KINDS, kind_of
from dsom_jax.nn.local_view import CornerMap, pack_corners
from dsom_jax.nn.pf_net import PFNetConfig
from dsom_jax.nn.pfrnn import PFRNNConfig
from dsom_jax.training.descent import descend, follow_average, optimizer
from dsom_jax.training.filter_loss import FilterLosses, particle_loss, prediction_loss
from dsom_jax.training.sequences import PathPool, SequenceConfig, Window
from dsom_jax.types import Array, Inputs, Key

FILTERS: dict[str, type[Learned]] = {"pf_net": PFNetFilter, "pfrnn": PFRNNFilter}


@dataclass(frozen=True)
class FilterTrainConfig:
    """Everything that determines a training run together with the maps and its number of steps.

    Attributes:
        model: the network, which is also the choice between PF-Net and PFRNN.
        data: the sequences.
        batch: sequences in a batch.
        particles: N while training.
        start_xy, start_theta: least and largest scatter (m, rad) of the particles at the start of a sequence.
        strays: largest share of particles that start anywhere; half of the sequences have none.
        heading_weight: weight of the heading in the prediction loss, m^2 / rad^2.
        particle_weight: weight of PFRNN's particle loss; PF-Net has none.
        particle_xy, particle_theta: standard deviations (m, rad) of the pose given a particle, in that loss.
        learning_rate: peak of Adam's rate, warm-up then cosine decay to zero.
        warmup: steps to the peak.
        clip: largest norm of the gradient.
        ema: decay of the averaged weights that are shipped.
        seed: of weights and data.
    """

    model: PFNetConfig | PFRNNConfig = PFNetConfig()
    data: SequenceConfig = field(default_factory=SequenceConfig)
    batch: int = 12
    particles: int = 32
    start_xy: tuple[float, float] = (0.2, 2.0)
    start_theta: tuple[float, float] = (math.radians(6), math.radians(45))
    strays: float = 0.5
    heading_weight: float = 1.0
    particle_weight: float = 0.1
    particle_xy: float = 0.5
    particle_theta: float = 0.2
    learning_rate: float = 1.5e-3
    warmup: int = 100
    clip: float = 1.0
    ema: float = 0.99
    seed: int = 0

    def __post_init__(self) -> None:
        checks.count(self, "batch particles")
        checks.low_high(self, "start_xy start_theta", 1e-3)
        checks.share(self, "strays ema", excluding=")")
        checks.not_negative(self, "heading_weight particle_weight")
        checks.positive(self, "particle_xy particle_theta learning_rate clip")
        checks.count(self, "warmup seed", 0)
        checks.within(self, "seed", 0, 2**31 - 1, "give less than 2^31")

    @property
    def kind(self) -> str:
        """``pf_net`` or ``pfrnn``."""
        return kind_of(self.model)


class FilterTrainState(NamedTuple):
    """All that a step changes; saved and restored, training continues bit for bit.

    Attributes:
        step: () int32, steps done.
        params: weights.
        optimizer: moments of Adam.
        average: exponential average of ``params``.
    """

    step: Array
    params: Any
    optimizer: Any
    average: Any


def graph_of(config: FilterTrainConfig) -> Any:
    """Structure of the network."""
    return nnx.split(nnx.eval_shape(lambda: KINDS[config.kind].create(config.model)))[0]


def init_filter_state(config: FilterTrainConfig, model: Any = None) -> FilterTrainState:
    """State before the first step, with the weights of ``model`` or fresh ones."""
    params = nnx.as_pure(nnx.split(model or KINDS[config.kind].create(config.model, config.seed))[1])
    # The average gets buffers of its own: the step donates all of the state.
    average = jax.tree.map(jnp.copy, params)
    return FilterTrainState(jnp.zeros((), jnp.int32), params, optimizer(config).init(params), average)


def averaged_filter_model(config: FilterTrainConfig, state: FilterTrainState) -> Any:
    """The network that is shipped: averaged weights."""
    return nnx.merge(graph_of(config), state.average)


def start_poses(key: Key, window: Window, config: FilterTrainConfig) -> Array:
    """(N, 3) particles at the start of a sequence: about the truth, more or less widely, and some anywhere."""
    k_width, k_mean, k_poses, k_stray = jax.random.split(key, 4)
    low, high = (jnp.asarray([xy, xy, theta]) for xy, theta in zip(config.start_xy, config.start_theta, strict=True))
    std = low * (high / low) ** jax.random.uniform(k_width)
    middle = scatter(k_mean, Prior(window.poses[0], 0.5 * std), 1)[0]
    poses = scatter(k_poses, Prior(middle, std), config.particles)
    r = jax.random.uniform(k_stray, (2,))
    count = jnp.where(r[0] < 0.5, 0.0, config.strays * r[1] * config.particles)
    return jnp.where((jnp.arange(config.particles) < count)[:, None], window.strays, poses)


def follow(params: Any, graph: Any, config: FilterTrainConfig, places: CornerMap, key: Key, window: Window) -> Any:
    """States of the filter after each update of a sequence, leaves (L, ...)."""
    k_start, k_steps = jax.random.split(key)
    filter: Any = make_tracker(params, graph, config, replace(places, codes=places.codes[window.where]))

    def update(state: Any, now: tuple[Key, Array, Array]) -> tuple[Any, Any]:
        inputs = Inputs(now[1], now[2], jnp.int32(0))
        state = filter.advance(now[0], state, inputs, filter.prepare((), inputs)[0])
        return state, state

    keys = jax.random.split(k_steps, window.odometry.shape[0])
    first = filter.start(start_poses(k_start, window, config))
    return jax.lax.scan(update, first, (keys, window.ranges, window.odometry))[1]


def make_tracker(params: Any, graph: Any, config: FilterTrainConfig, place: CornerMap) -> Learned:
    """The filter on one map; its scans are thinned already."""
    lidar = config.data.lidar.every(config.data.beam_step)
    # Its particles are given, so that no free space is needed.
    return FILTERS[config.kind](params, place, None, None, graph, lidar, 1, config.particles)  # type: ignore[arg-type]


def window_losses(states: Any, window: Window, config: FilterTrainConfig) -> tuple[Array, Array]:
    """Prediction and particle loss of one sequence, means over its updates."""
    prediction = prediction_loss(states.poses, states.log_weights, window.poses, config.heading_weight)
    particles = particle_loss(states.poses, window.poses, config.particle_xy, config.particle_theta)
    return prediction.mean(), particles.mean()


def _batch_losses(
    params: Any, graph: Any, config: FilterTrainConfig, places: CornerMap, key: Key, windows: Window
) -> FilterLosses:
    """Losses of a batch of sequences."""

    def one(key: Key, window: Window) -> tuple[Array, Array]:
        return window_losses(follow(params, graph, config, places, key, window), window, config)

    keys = jax.random.split(key, windows.where.shape[0])
    prediction, particles = (part.mean() for part in jax.vmap(one)(keys, windows))
    weight = config.particle_weight if config.kind == "pfrnn" else 0.0
    return FilterLosses(prediction + weight * particles, prediction, particles)


def stack_maps(pool: PathPool, resolution: float) -> CornerMap:
    """The maps of a pool, ready to be cropped; codes (M, H + 3, W + 3)."""
    return CornerMap(jax.vmap(pack_corners)(pool.occupied), jnp.zeros(3), resolution)


def make_filter_step(config: FilterTrainConfig, places: CornerMap) -> Callable[..., Any]:
    """The jitted step: (state, batch, total steps) -> (state, metrics). The state given is consumed."""
    graph, root = graph_of(config), jax.random.key(config.seed + 2)

    def objective(params: Any, key: Key, windows: Window) -> tuple[Array, FilterLosses]:
        losses = _batch_losses(params, graph, config, places, key, windows)
        return losses.total, losses

    def step(state: FilterTrainState, windows: Window, total: Array) -> tuple[FilterTrainState, dict[str, Array]]:
        key = jax.random.fold_in(root, state.step)
        (_, losses), gradient = jax.value_and_grad(objective, has_aux=True)(state.params, key, windows)
        params, moments, facts = descend(config, state.step, total, state.params, state.optimizer, gradient)
        average = follow_average(config, state.step, state.average, params)
        return FilterTrainState(state.step + 1, params, moments, average), {**losses._asdict(), **facts}

    return jax.jit(step, donate_argnums=0, compiler_options=training_options())
