"""Pillars, furniture and things along the walls of a floor plan."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from dsom_jax.simulate.floorplan import Style
from dsom_jax.simulate.morphology import grow
from dsom_jax.types import Array, Key

_TILES = 32
"""Tiles repeat after this many along each axis; with tiles of a metre and more that is rooms away."""


def furnish(key: Key, style: Style, labels: Array, is_corridor: Array, wall: Array, u: Array, v: Array) -> Array:
    """Cells (H, W) that furniture, pillars and shelves occupy; ``u``, ``v`` (H, W) metres in the building frame."""
    k_room, k_tile = jax.random.split(key)
    rooms = jax.random.uniform(k_room, (is_corridor.shape[0], 7))
    small, large, shelves = jnp.split(jax.random.uniform(k_tile, (_TILES * _TILES, 16)), (7, 14), axis=1)
    # Some rooms are full and some empty; corridors are nearly empty.
    density = style.furniture * jnp.where(is_corridor, 0.06, jnp.clip(2.2 * rooms[:, 0] - 0.5, 0.0, 1.0))
    items = _items(small, 1.1, (0.17, 0.35), (0.6 * density * rooms[:, 1])[labels], u, v)
    items |= _items(large, 2.7, (0.35, 1.0), density[labels], u, v)
    pillars = _pillars(rooms[:, 3:], (rooms[:, 2] < style.pillars) & ~is_corridor, labels, u, v)
    return items | pillars | _along_walls(shelves, wall, u, v, style.shelves)


def _tile(draws: Array, u: Array, v: Array, size: float) -> tuple[Array, Array, Array]:
    """Draws (n, ...) of the tile of ``size`` metres under each point, and the point's place from the tile's middle."""
    i, j = (jnp.floor(w / size).astype(jnp.int32) for w in (u, v))
    mine = jnp.moveaxis(draws[(i % _TILES) * _TILES + j % _TILES], -1, 0)
    return mine, u - (i + 0.5) * size, v - (j + 0.5) * size


def _items(draws: Array, size: float, half: tuple[float, float], density: Array, u: Array, v: Array) -> Array:
    """At most one box or disc in each tile of ``size`` metres, there with probability ``density``; ``half`` sizes."""
    r, x, y = _tile(draws, u, v, size)
    a, b = half[0] + (half[1] - half[0]) * r[1] ** 2, half[0] + (half[1] - half[0]) * r[2]
    x, y = (w - (2 * d - 1) * jnp.maximum(size / 2 - jnp.maximum(a, b), 0.0) for w, d in ((x, r[3]), (y, r[4])))
    turn = jnp.where(r[5] < 0.3, r[5] / 0.3 * jnp.pi, 0.0)
    c, s = jnp.cos(turn), jnp.sin(turn)
    box = (jnp.abs(c * x + s * y) < a) & (jnp.abs(c * y - s * x) < b)
    item = jnp.where(r[6] < 0.25, x**2 + y**2 < jnp.minimum(a, b) ** 2, box)
    return item & (r[0] < density)


def _pillars(draws: Array, has_pillars: Array, labels: Array, u: Array, v: Array) -> Array:
    """A lattice of square pillars, different in every room that has them."""
    r = draws[labels]
    space_u, space_v = 2.5 + 4 * r[..., 0], 2.5 + 4 * r[..., 1]
    size = 0.2 + 0.25 * r[..., 2]
    at_u = jnp.abs((u + 9 * r[..., 3]) % space_u - space_u / 2) < size
    at_v = jnp.abs((v + 7 * r[..., 2]) % space_v - space_v / 2) < size
    return at_u & at_v & has_pillars[labels]


def _along_walls(draws: Array, wall: Array, u: Array, v: Array, chance: Array) -> Array:
    """Cabinets and the raggedness that real maps have: stretches of wall that are a cell or two thicker."""
    (long, _), _, _ = _tile(draws, u, v, 1.9)
    (_, short), _, _ = _tile(draws, u, v, 1.03)
    return (grow(wall, 1) & (short < chance)) | (grow(wall, 2) & (long < 0.5 * chance))
