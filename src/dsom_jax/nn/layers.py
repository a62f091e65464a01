"""Convolution, matrix product, batch norm and ELU; on a CPU with gradients of their own, elsewhere with JAX's.

XLA's CPU backend runs a convolution fast only in the layout NHWC, HWIO -> NHWC; the gradients that JAX derives are in
another one, which falls to a naive loop inside ``scan`` bodies. On a CPU all are spelled out in the fast layout: the
same numbers to rounding. On a GPU that would be slow, as the gradient becomes a convolution with a kernel of the size
of the map; there :func:`own_gradients` says no, and what is differentiated is what Flax's layers compute.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from dsom_jax.types import Array

LAYOUT = ("NHWC", "HWIO", "NHWC")
MOMENTUM = 0.97
EPSILON = 1e-5
OWN_GRADIENTS: bool | None = None
"""Whether layers use the gradients written here; None: on a CPU they do. Looked at when a step is traced."""
_LARGE = 2048
"""Pixels from which the transposition in the weights' gradient is faster in two steps, each of near neighbours."""


def normal(rng: np.random.Generator, shape: tuple[int, ...], gain: float) -> Array:
    """Weights with variance gain / fan-in; by NumPy, because compiling an initialiser for every shape takes longer."""
    return jnp.asarray(rng.normal(0.0, np.sqrt(gain / np.prod(shape[:-1])), shape), jnp.float32)


def own_gradients() -> bool:
    """The switch of this module: gradients written for a CPU's XLA, or JAX's."""
    return jax.default_backend() == "cpu" if OWN_GRADIENTS is None else OWN_GRADIENTS


def conv3x3(x: Array, kernel: Array) -> Array:
    """Same-size convolution of x (N, H, W, I) with kernel (3, 3, I, O): (N, H, W, O)."""
    return _conv3x3(x, kernel) if own_gradients() else _convolve(x, kernel)


def product(x: Array, kernel: Array) -> Array:
    """x (..., I) times kernel (I, O)."""
    return _product(x, kernel) if own_gradients() else x @ kernel


def batch_norm_elu(x: Array, scale: Array, bias: Array) -> tuple[Array, Array, Array]:
    """ELU of the batch-normalised x (..., C), and the mean and variance (C,) used (constants to the gradient)."""
    if own_gradients():
        return _batch_norm_elu(x, scale, bias)
    channels = tuple(range(x.ndim - 1))
    mean, variance = x.mean(channels), x.var(channels)
    return elu((x - mean) * (scale * jax.lax.rsqrt(variance + EPSILON)) + bias), mean, variance


def _convolve(x: Array, kernel: Array) -> Array:
    return jax.lax.conv_general_dilated(x, kernel, (1, 1), [(1, 1), (1, 1)], dimension_numbers=LAYOUT)


@jax.custom_vjp
def _conv3x3(x: Array, kernel: Array) -> Array:
    return _convolve(x, kernel)


def _conv3x3_fwd(x: Array, kernel: Array) -> tuple[Array, tuple[Array, Array]]:
    return _convolve(x, kernel), (x, kernel)


def _conv3x3_bwd(saved: tuple[Array, Array], gradient: Array) -> tuple[Array, Array]:
    x, kernel = saved
    of_input = _convolve(gradient, kernel[::-1, ::-1].transpose(0, 1, 3, 2))
    # The batch takes the place of the channels: x is the image (I, H, W, N), the gradient its kernel (H, W, N, O).
    image = x.transpose(1, 2, 3, 0)
    if x.shape[1] * x.shape[2] > _LARGE:
        image = jax.lax.optimization_barrier(image)
    of_kernel = _convolve(image.transpose(2, 0, 1, 3), gradient.transpose(1, 2, 0, 3))
    return of_input, of_kernel.transpose(1, 2, 0, 3)


_conv3x3.defvjp(_conv3x3_fwd, _conv3x3_bwd)


@jax.custom_vjp
def _product(x: Array, kernel: Array) -> Array:
    return x @ kernel


def _product_fwd(x: Array, kernel: Array) -> tuple[Array, tuple[Array, Array]]:
    return x @ kernel, (x, kernel)


def _product_bwd(saved: tuple[Array, Array], gradient: Array) -> tuple[Array, Array]:
    x, kernel = saved
    # Without the barrier XLA writes the gradient out transposed, which takes longer than the product itself.
    gradient = jax.lax.optimization_barrier(gradient)
    left, right = (v.reshape(-1, v.shape[-1]) for v in (x, gradient))
    return gradient @ kernel.T, jax.lax.dot_general(left, right, (((0,), (0,)), ((), ())))


_product.defvjp(_product_fwd, _product_bwd)


def elu(x: Array) -> Array:
    """Exponential linear unit; exp - 1 is half the cost of expm1 and as good for an activation."""
    return jnp.where(x > 0, x, jnp.exp(jnp.minimum(x, 0.0)) - 1.0)


def channel_sum(x: Array) -> Array:
    """Sum (C,) of x (..., C) over all but the channels.

    XLA's own reduction of a long axis is ten times slower on a CPU than adding sixteenths of it element by element.
    """
    flat = x.reshape(-1, x.shape[-1])
    while flat.shape[0] > 256 and flat.shape[0] % 16 == 0:
        parts = flat.reshape(16, -1, flat.shape[-1])
        flat = sum((parts[i] for i in range(1, 16)), parts[0])
    return flat.sum(0)


def _moments(x: Array) -> tuple[Array, Array]:
    """Mean and variance (C,) of x (..., C) over everything but the channels."""
    count = x.size // x.shape[-1]
    mean = channel_sum(x) / count
    return mean, jnp.maximum(channel_sum(x * x) / count - mean * mean, 0.0)


@jax.custom_vjp
def _batch_norm_elu(x: Array, scale: Array, bias: Array) -> tuple[Array, Array, Array]:
    mean, variance = _moments(x)
    return elu((x - mean) * (scale * jax.lax.rsqrt(variance + EPSILON)) + bias), mean, variance


def _batch_norm_elu_fwd(x: Array, scale: Array, bias: Array) -> tuple[tuple[Array, Array, Array], Any]:
    out, mean, variance = _batch_norm_elu(x, scale, bias)
    return (out, mean, variance), (x, out, scale, mean, variance)


def _batch_norm_elu_bwd(saved: Any, gradients: tuple[Array, ...]) -> tuple[Array, Array, Array]:
    x, out, scale, mean, variance = saved
    inverse = jax.lax.rsqrt(variance + EPSILON)
    # The slope of ELU follows from its value: 1 above zero, exp(x) = value + 1 below.
    slope = gradients[0] * jnp.where(out > 0, 1.0, out + 1.0)
    normed = (x - mean) * inverse
    of_bias, of_scale = channel_sum(slope), channel_sum(slope * normed)
    count = x.size // x.shape[-1]
    of_x = (scale * inverse) * (slope - (of_bias + normed * of_scale) / count)
    return of_x, of_scale, of_bias


_batch_norm_elu.defvjp(_batch_norm_elu_fwd, _batch_norm_elu_bwd)


class BatchNormELU(nnx.Module):
    """Batch norm and ELU; ``nnx.view(model, use_running_average=True)`` makes it use the stored statistics."""

    def __init__(self, channels: int) -> None:
        self.scale = nnx.Param(jnp.ones(channels))
        self.bias = nnx.Param(jnp.zeros(channels))
        self.mean = nnx.BatchStat(jnp.zeros(channels))
        self.variance = nnx.BatchStat(jnp.ones(channels))
        self.use_running_average = False

    def set_view(self, use_running_average: bool | None = None) -> None:
        """Class method used by ``nnx.view``.

        Args:
            use_running_average: normalise with the stored statistics rather than with the batch's.
        """
        if use_running_average is not None:
            self.use_running_average = use_running_average

    def __call__(self, x: Array) -> Array:
        """(..., C) -> (..., C)."""
        if self.use_running_average:
            factor = self.scale[...] * jax.lax.rsqrt(self.variance[...] + EPSILON)
            return elu(x * factor + (self.bias[...] - self.mean[...] * factor))
        out, mean, variance = batch_norm_elu(x, self.scale[...], self.bias[...])
        for running, value in ((self.mean, mean), (self.variance, variance)):
            running[...] = MOMENTUM * running[...] + (1 - MOMENTUM) * jax.lax.stop_gradient(value)
        return out


class ConvBlock(nnx.Module):
    """3 x 3 convolution, batch norm, ELU: the unit of all the paper's tables. No bias: the norm would remove it."""

    def __init__(self, inputs: int, outputs: int, rng: np.random.Generator) -> None:
        self.kernel = nnx.Param(normal(rng, (3, 3, inputs, outputs), 2.0))
        self.norm = BatchNormELU(outputs)

    def __call__(self, x: Array) -> Array:
        """(N, H, W, I) -> (N, H, W, O)."""
        return self.norm(conv3x3(x, self.kernel[...]))


class Dense(nnx.Module):
    """Affine map of the channels."""

    def __init__(self, inputs: int, outputs: int, rng: np.random.Generator) -> None:
        self.kernel = nnx.Param(normal(rng, (inputs, outputs), 1.0))
        self.bias = nnx.Param(jnp.zeros(outputs))

    def __call__(self, x: Array) -> Array:
        """(..., I) -> (..., O)."""
        return product(x, self.kernel[...]) + self.bias[...]


class Stack(nnx.Module):
    """Blocks one after the other, each with the number of output channels given."""

    def __init__(self, inputs: int, outputs: list[int], rng: np.random.Generator) -> None:
        sizes = [inputs, *outputs]
        self.blocks = nnx.List([ConvBlock(i, o, rng) for i, o in pairwise(sizes)])

    def __call__(self, x: Array) -> Array:
        """(N, H, W, I) -> (N, H, W, O)."""
        for block in self.blocks:
            x = block(x)
        return x


class CircularBlock(nnx.Module):
    """Convolution of three neighbours on a circle as one matrix product, batch norm, ELU."""

    def __init__(self, inputs: int, outputs: int, rng: np.random.Generator) -> None:
        self.kernel = nnx.Param(normal(rng, (3 * inputs, outputs), 2.0))
        self.norm = BatchNormELU(outputs)

    def __call__(self, x: Array) -> Array:
        """(N, A, I) -> (N, A, O), circular along A."""
        neighbours = jnp.concatenate([jnp.roll(x, 1, axis=1), x, jnp.roll(x, -1, axis=1)], axis=-1)
        return self.norm(product(neighbours, self.kernel[...]))
