"""DSOM: the deep samplable observation model of the paper, section III, as a Flax NNX module."""

from dsom_jax.nn.config import DSOMConfig
from dsom_jax.nn.dsom import DSOM, MapFeatures, create, encode_map, evaluation_view, log_probability_map

__all__ = ["DSOM", "DSOMConfig", "MapFeatures", "create", "encode_map", "evaluation_view", "log_probability_map"]
