"""PF-Net (Karkus, Hsu, Lee 2018) for a 2D lidar: the learned transition and observation models."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from dsom_jax import checks
from dsom_jax.geometry import compose
from dsom_jax.lidar import LidarConfig
from dsom_jax.nn.layers import Dense
from dsom_jax.nn.local_view import CornerMap, ViewConfig, local_view
from dsom_jax.nn.view_net import ScanCode, ViewNet, leaky
from dsom_jax.types import Array


@dataclass(frozen=True)
class PFNetConfig:
    """Architecture and scale.

    Attributes:
        view: local view of map and scan.
        width: channels of a patch.
        features: of a whole view.
        alpha: share of the weights in the mixture that soft resampling draws from; the rest is uniform.
        min_xy, min_theta: least standard deviations of the motion (m, rad), so that particles never coincide.
    """

    view: ViewConfig = ViewConfig()
    width: int = 32
    features: int = 64
    alpha: float = 0.5
    min_xy: float = 0.02
    min_theta: float = 0.01

    def __post_init__(self) -> None:
        checks.count(self, "width features")
        checks.share(self, "alpha", excluding="(")
        checks.not_negative(self, "min_xy min_theta")

    @property
    def resolution(self) -> float:
        """Metres per cell of the maps that it works on."""
        return self.view.map_resolution

    def misfit(self, lidar: LidarConfig) -> str | None:
        """Why scans of ``lidar`` are not what the network was trained for, or None."""
        return self.view.misfit(lidar)


class PFNet(nnx.Module):
    """p(x' | a, x) and p(z | x, map), both learned through the filter."""

    def __init__(self, config: PFNetConfig, rng: np.random.Generator) -> None:
        self.config = config
        self.observation = ViewNet(config.view, config.width, config.features, rng)
        self.likelihood = Dense(config.features, 1, rng)
        self.noise_hidden = Dense(2, 16, rng)
        self.noise = Dense(16, 3, rng)
        self.noise.bias[...] = jnp.asarray([-3.0, -3.0, -3.5])

    def spread(self, odometry: Array) -> Array:
        """Standard deviations (3,) of the motion (m, m, rad) ahead, to the left and in heading, in the base frame."""
        way = jnp.sqrt((odometry[:2] ** 2).sum() + 1e-8)
        hidden = leaky(self.noise_hidden(jnp.stack([way, jnp.abs(odometry[2])])))
        floor = jnp.asarray([self.config.min_xy, self.config.min_xy, self.config.min_theta])
        return floor + jax.nn.softplus(self.noise(hidden))

    def move(self, poses: Array, odometry: Array, noise: Array) -> Array:
        """Successors of poses (N, 3) for standard normal ``noise`` (N, 3): x' = x (+) (a + spread * noise)."""
        return compose(poses, odometry + self.spread(odometry) * noise)

    def log_likelihood(self, place: CornerMap, poses: Array, code: ScanCode) -> Array:
        """log p(z | x) (N,) up to a constant of the scan."""
        views = local_view(place, poses, self.config.view)
        return self.likelihood(self.observation(views, code))[..., 0]


def create_pf_net(config: PFNetConfig, seed: int = 0) -> PFNet:
    """A PF-Net with fresh weights."""
    return PFNet(config, np.random.default_rng(seed))
