"""PFRNN (Ma, Karkus, Hsu, Lee 2020): the particle filter GRU cell, for a 2D lidar on a map.

The paper's cell keeps K latent particles h with weights; the update of each is a GRU with a stochastic candidate
(reparameterisation trick), its weight is multiplied with p(z | h), and soft resampling follows. What the paper leaves
to the task is the input and the output. Here each latent particle also stands somewhere: its head corrects the pose
that odometry leads to, and its input is the scan compared with the local view of the map at that pose, so that
metres need not be remembered by a hidden layer.
"""

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
from dsom_jax.nn.view_net import ScanCode, ViewNet
from dsom_jax.types import Array

_ODOMETRY_SCALE = (2.0, 2.0, 3.0)  # updates are about half a metre or a third of a radian apart


@dataclass(frozen=True)
class PFRNNConfig:
    """Architecture and scale.

    Attributes:
        view: local view of map and scan.
        width: channels of a patch.
        features: of a whole view.
        hidden: length of a latent particle h.
        alpha: share of the weights in the mixture that soft resampling draws from; the rest is uniform.
        step_xy, step_theta: the largest correction of a pose in one update (m, rad).
    """

    view: ViewConfig = ViewConfig()
    width: int = 32
    features: int = 64
    hidden: int = 32
    alpha: float = 0.5
    step_xy: float = 0.5
    step_theta: float = 0.3

    def __post_init__(self) -> None:
        checks.count(self, "width features hidden")
        checks.share(self, "alpha", excluding="(")
        checks.positive(self, "step_xy step_theta")

    @property
    def resolution(self) -> float:
        """Metres per cell of the maps that it works on."""
        return self.view.map_resolution

    def misfit(self, lidar: LidarConfig) -> str | None:
        """Why scans of ``lidar`` are not what the network was trained for, or None."""
        return self.view.misfit(lidar)


class PFGRUCell(nnx.Module):
    """The particle filter GRU: gates as usual, the candidate drawn from a learned Gaussian."""

    def __init__(self, inputs: int, hidden: int, rng: np.random.Generator) -> None:
        self.gates = Dense(inputs + hidden, 2 * hidden, rng)
        self.candidate = Dense(inputs + hidden, 2 * hidden, rng)
        self.likelihood = Dense(inputs + hidden, 1, rng)

    def __call__(self, hidden: Array, inputs: Array, noise: Array) -> tuple[Array, Array]:
        """Latent particles (N, D), inputs (N, I) and standard normal ``noise`` (N, D) -> (N, D), log p(z | h) (N,)."""
        keep, reset = jnp.split(jax.nn.sigmoid(self.gates(jnp.concatenate([hidden, inputs], -1))), 2, -1)
        mean, spread = jnp.split(self.candidate(jnp.concatenate([reset * hidden, inputs], -1)), 2, -1)
        new = jnp.tanh(mean + jax.nn.softplus(spread - 1.0) * noise)
        hidden = (1 - keep) * new + keep * hidden
        return hidden, self.likelihood(jnp.concatenate([hidden, inputs], -1))[..., 0]


class PFRNN(nnx.Module):
    """Cell, observation network and head."""

    def __init__(self, config: PFRNNConfig, rng: np.random.Generator) -> None:
        self.config = config
        self.observation = ViewNet(config.view, config.width, config.features, rng)
        self.cell = PFGRUCell(config.features + 3, config.hidden, rng)
        self.head = Dense(config.hidden, 3, rng)
        # Fresh latent particles stay where odometry takes them.
        self.head.kernel[...] = 0.1 * self.head.kernel[...]

    def update(
        self, place: CornerMap, poses: Array, hidden: Array, odometry: Array, code: ScanCode, noise: Array
    ) -> tuple[Array, Array, Array]:
        """Corrected poses (N, 3), new latent particles (N, D) and log p(z | h) (N,).

        Args:
            place: the map.
            poses: (N, 3) where odometry leads to.
            hidden: (N, D) latent particles.
            odometry: (3,) the increment (m, m, rad).
            code: reading of the scan.
            noise: (N, D) standard normal.
        """
        hidden, log_likelihood = self.cell(hidden, self.inputs(place, poses, odometry, code), noise)
        return self.correct(poses, hidden), hidden, log_likelihood

    def inputs(self, place: CornerMap, poses: Array, odometry: Array, code: ScanCode) -> Array:
        """(N, F + 3): scan against map at the poses (N, 3), and the increment (3,)."""
        features = self.observation(local_view(place, poses, self.config.view), code)
        motion = jnp.broadcast_to(odometry * jnp.asarray(_ODOMETRY_SCALE), (*features.shape[:-1], 3))
        return jnp.concatenate([features, motion], axis=-1)

    def correct(self, poses: Array, hidden: Array) -> Array:
        """Poses (N, 3) moved in their own frames as the latent particles (N, D) say."""
        limit = jnp.asarray([self.config.step_xy, self.config.step_xy, self.config.step_theta])
        return compose(poses, limit * jnp.tanh(self.head(hidden)))


def create_pfrnn(config: PFRNNConfig, seed: int = 0) -> PFRNN:
    """A PFRNN with fresh weights."""
    return PFRNN(config, np.random.default_rng(seed))
