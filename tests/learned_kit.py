"""What the tests of PF-Net and PFRNN share: networks of a few hundred weights for the tiny room."""

from __future__ import annotations

import tiny_world
from dsom_jax.filters.learned import Prior
from dsom_jax.filters.pf_net import pf_net
from dsom_jax.filters.pfrnn import pfrnn
from dsom_jax.nn import PFNetConfig, PFRNNConfig, create_pf_net, create_pfrnn
from dsom_jax.nn.local_view import ViewConfig
from dsom_jax.simulate.drive import DriveConfig
from dsom_jax.training.filter_loop import FilterTrainConfig
from dsom_jax.training.sequences import SequenceConfig

VIEW = ViewConfig(cells=8, resolution=0.5, map_resolution=0.25, beams=32, reach_min=5.0)
PF_NET = PFNetConfig(VIEW, width=8, features=16)
PFRNN = PFRNNConfig(VIEW, width=8, features=16, hidden=12)
CONFIGS = {"pf_net": PF_NET, "pfrnn": PFRNN}
MODELS = {"pf_net": create_pf_net(PF_NET, 1), "pfrnn": create_pfrnn(PFRNN, 1)}
MAKERS = {"pf_net": pf_net, "pfrnn": pfrnn}
KINDS = tuple(CONFIGS)
DATA = SequenceConfig(
    tiny_world.LIDAR, 1, drives=4, length=12, window=4, obstacles=2, removed=1,
    drive=DriveConfig(update_min_d=0.2, margin=0.3, near=1.0),
)  # fmt: skip


def make(kind: str, particles: int = 24, prior: Prior | None = None):
    """A filter on the tiny room."""
    return MAKERS[kind](MODELS[kind], tiny_world.grid(), tiny_world.LIDAR, particles, prior)


def training(kind: str, **fields) -> FilterTrainConfig:
    """A training that takes seconds."""
    tiny = {"batch": 4, "particles": 12, "warmup": 2, "start_xy": (0.2, 0.5), "start_theta": (0.1, 0.3)}
    return FilterTrainConfig(CONFIGS[kind], DATA, **{**tiny, **fields})
