"""Data-parallel training: every device takes its share of a batch, all hold the same state.

The step itself knows nothing of it: XLA sees where its arguments lie and adds what the devices have to tell each
other, batch norm's statistics included, so that several devices follow the loss curve of one.
"""

from __future__ import annotations

from typing import TypeVar

import jax
from jax.sharding import AxisType, Mesh, NamedSharding
from jax.sharding import PartitionSpec as P

from dsom_jax.training.batches import Batch

_T = TypeVar("_T")


def data_mesh() -> Mesh:
    """All visible devices in a row."""
    return jax.make_mesh((jax.device_count(),), ("data",), axis_types=(AxisType.Auto,))


def replicate(tree: _T, mesh: Mesh) -> _T:
    """The same arrays on every device; as they are if there is only one."""
    return tree if mesh.size == 1 else jax.device_put(tree, NamedSharding(mesh, P()))


def spread(batch: Batch, mesh: Mesh) -> Batch:
    """Worlds shared out over the devices; if they do not come out even, the scans of each; else all to everyone."""
    worlds, scans = batch.poses.shape[:2]
    if worlds % mesh.size and scans % mesh.size:
        return replicate(batch, mesh)
    if mesh.size == 1:
        return batch
    maps, seen = (P("data"), P("data")) if worlds % mesh.size == 0 else (P(), P(None, "data"))

    def place(tree: _T, spec: P) -> _T:
        return jax.tree.map(lambda leaf: jax.device_put(leaf, NamedSharding(mesh, spec)), tree)

    by_world = {name: place(getattr(batch, name), maps) for name in ("occupied", "free", "views")}
    return Batch(**by_world, **{name: place(getattr(batch, name), seen) for name in ("ranges", "conditions", "poses")})
