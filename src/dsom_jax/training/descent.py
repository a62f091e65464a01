"""One step downhill, the same for every network: clipped Adam with a schedule, and an average of the weights."""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import optax

from dsom_jax.types import Array


class Schedule(Protocol):
    """The part of a configuration that says how to descend; every kind of network has it."""

    @property
    def learning_rate(self) -> float:
        """Peak of Adam's rate."""

    @property
    def warmup(self) -> int:
        """Steps to the peak."""

    @property
    def clip(self) -> float:
        """Largest norm of the gradient."""

    @property
    def ema(self) -> float:
        """Decay of the averaged weights."""


class Descent(NamedTuple):
    """What a step makes of the weights.

    Attributes:
        params: new weights.
        moments: of Adam, for the next step.
        facts: the rate, and the norm of the gradient before it was clipped.
    """

    params: Any
    moments: Any
    facts: dict[str, Array]


def optimizer(config: Schedule) -> optax.GradientTransformation:
    """Clip and Adam; the rate is applied by the step because the number of steps is not static."""
    return optax.chain(optax.clip_by_global_norm(config.clip), optax.scale_by_adam())


def learning_rate(config: Schedule, step: Array, total: Array) -> Array:
    """Linear warm-up, then half a cosine down to zero at ``total``."""
    progress = jnp.clip((step - config.warmup) / jnp.maximum(total - config.warmup, 1), 0.0, 1.0)
    warm = jnp.minimum((step + 1) / max(config.warmup, 1), 1.0)
    return config.learning_rate * warm * 0.5 * (1 + jnp.cos(jnp.pi * progress))


def descend(config: Schedule, step: Array, total: Array, params: Any, moments: Any, gradient: Any) -> Descent:
    """Step number ``step`` () of ``total`` ()."""
    update, moments = optimizer(config).update(gradient, moments, params)
    rate = learning_rate(config, step, total)
    params = jax.tree.map(lambda p, u: p - rate * u, params, update)
    return Descent(params, moments, {"rate": rate, "gradient": optax.global_norm(gradient)})


def follow_average(config: Schedule, step: Array, average: Any, new: Any) -> Any:
    """The exponential average after step number ``step`` (), whose result is ``new``."""
    # Early on the average follows faster, so that it does not remember the fresh weights.
    decay = jnp.minimum(config.ema, (1.0 + step) / (10.0 + step))
    return jax.tree.map(lambda a, b: decay * a + (1 - decay) * b, average, new)
