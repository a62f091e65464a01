"""The trained networks that methods need: where they are, and that none is missing or does not fit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from dsom_jax import checkpoint
from dsom_jax.errors import UserError
from dsom_jax.filters.methods import METHODS, network_of
from dsom_jax.lidar import LidarConfig

OPTIONS = {"dsom": "--checkpoint", "pf_net": "--pf-net", "pfrnn": "--pfrnn"}
"""The option that names the folder of each kind of network."""


def by_kind(networks: Any) -> Mapping[str, Any]:
    """Networks, or their folders, by kind; a single one is a DSOM, and None means that there is none."""
    if networks is None:
        return {}
    return networks if isinstance(networks, Mapping) else {"dsom": networks}


def check_networks(methods: Sequence[str], networks: Mapping[str, Any]) -> None:
    """UserError for a method whose kind of network is not among ``networks``."""
    for name in methods:
        kind = network_of(name)
        if kind and networks.get(kind) is None:
            raise UserError(f"{OPTIONS[kind]}: {name} needs a trained network; name its folder")


def check_used(asked: Mapping[str, Path | None], methods: Sequence[str]) -> None:
    """UserError for a folder that is named and that no method draws from."""
    for kind, folder in asked.items():
        if folder and kind not in map(network_of, methods):
            users = ", ".join(name for name in METHODS if network_of(name) == kind)
            raise UserError(
                f"{OPTIONS[kind]} {folder}: has no use with --methods {','.join(methods)}; "
                f"leave it out, or add one of {users}"
            )


def find_networks(asked: Mapping[str, Path | None]) -> dict[str, Path | None]:
    """Folder of each kind of network: the one asked for, or the one that comes with the package, if there is any."""
    return {kind: folder or checkpoint.shipped(kind) for kind, folder in asked.items()}


def load_networks(folders: Mapping[str, Path | None], methods: Sequence[str], lidar: LidarConfig) -> dict[str, Any]:
    """The networks that ``methods`` need, by kind; UserError for one that is damaged or does not fit the lidar."""
    needed = dict.fromkeys(kind for kind in map(network_of, methods) if kind)
    found = {kind: folders.get(kind) for kind in needed}
    return {kind: checkpoint.load(folder, lidar, kind=kind) for kind, folder in found.items() if folder}
