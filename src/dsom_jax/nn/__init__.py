"""Networks as Flax NNX modules: DSOM of the paper, section III; PF-Net and PFRNN, which it is compared with."""

from dsom_jax.nn.config import DSOMConfig
from dsom_jax.nn.dsom import DSOM, MapFeatures, create, encode_map, evaluation_view, log_probability_map
from dsom_jax.nn.kinds import KINDS, kind_of
from dsom_jax.nn.pf_net import PFNet, PFNetConfig, create_pf_net
from dsom_jax.nn.pfrnn import PFRNN, PFRNNConfig, create_pfrnn

__all__ = [
    "DSOM",
    "KINDS",
    "PFRNN",
    "DSOMConfig",
    "MapFeatures",
    "PFNet",
    "PFNetConfig",
    "PFRNNConfig",
    "create",
    "create_pf_net",
    "create_pfrnn",
    "encode_map",
    "evaluation_view",
    "kind_of",
    "log_probability_map",
]
