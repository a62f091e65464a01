"""The networks of this package by name: how each is configured and made. Checkpoints say which one they hold."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from dsom_jax.nn.config import DSOMConfig
from dsom_jax.nn.dsom import create
from dsom_jax.nn.pf_net import PFNetConfig, create_pf_net
from dsom_jax.nn.pfrnn import PFRNNConfig, create_pfrnn


class Kind(NamedTuple):
    """A network.

    Attributes:
        config: class of its configuration.
        create: (configuration, seed) -> network with fresh weights.
        command: what trains it.
    """

    config: type
    create: Callable[..., Any]
    command: str


KINDS = {
    "dsom": Kind(DSOMConfig, create, "dsom_jax.train"),
    "pf_net": Kind(PFNetConfig, create_pf_net, "dsom_jax.train_filter"),
    "pfrnn": Kind(PFRNNConfig, create_pfrnn, "dsom_jax.train_filter"),
}


def kind_of(config: Any) -> str:
    """Name of the network that ``config`` describes."""
    return next(name for name, kind in KINDS.items() if isinstance(config, kind.config))
