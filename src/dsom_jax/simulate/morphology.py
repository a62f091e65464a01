"""Small tools on boolean cells (H, W): neighbours, growing, connected components. All with static shapes."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from dsom_jax.types import Array


def shifted(cells: Array, di: int, dj: int, outside: bool | int = False) -> Array:
    """``out[i, j] = cells[i + di, j + dj]``, ``outside`` where that leaves the grid."""
    height, width = cells.shape
    reach = max(abs(di), abs(dj))
    padded = jnp.pad(cells, reach, constant_values=outside)
    return jax.lax.slice(padded, (reach + di, reach + dj), (reach + di + height, reach + dj + width))


def grow(cells: Array, steps: int) -> Array:
    """Cells grown by a square of 2 ``steps`` + 1 cells; for small ``steps``."""
    for axis in (0, 1):
        shifts = [(s, 0) if axis == 0 else (0, s) for s in range(-steps, steps + 1)]
        cells = jnp.stack([shifted(cells, *shift) for shift in shifts]).any(0)
    return cells


def clear_of(occupied: Array) -> Array:
    """Cells that neither are occupied nor share an edge with an occupied cell."""
    near = occupied
    for shift in ((0, 1), (0, -1), (1, 0), (-1, 0)):
        near = near | shifted(occupied, *shift)
    return ~near


def components(kinds: Array) -> Array:
    """(H, W) int32 label of the 4-connected component of cells of the same kind: the smallest flat index in it.

    ``kinds`` (H, W) integers or booleans; where they are zero the label is H * W. A round takes the smallest label of
    the neighbours, hands it to the cell that the label names, and jumps to the label's own label twice. Labels only
    fall and the loop stops when none does: it is bounded by the number of cells, and takes about five rounds.
    """
    kinds = kinds.astype(jnp.int32)
    count = kinds.size
    start = jnp.where(kinds > 0, jnp.arange(count, dtype=jnp.int32).reshape(kinds.shape), count)

    def spread(carry: tuple[Array, Array]) -> tuple[Array, Array]:
        labels, _ = carry
        best = _smallest_neighbour(kinds, labels)
        table = jnp.append(labels.ravel(), count).at[labels.ravel()].min(best.ravel())
        best = jnp.minimum(best, table[:-1].reshape(best.shape))
        for _ in range(2):
            best = jnp.append(best.ravel(), count)[best]
        return best, (best != labels).any()

    return jax.lax.while_loop(lambda carry: carry[1], spread, (start, jnp.bool_(True)))[0]


def _smallest_neighbour(kinds: Array, labels: Array) -> Array:
    """Smallest label among a cell and those of its four neighbours that are of its kind."""
    best = labels
    for shift in ((0, 1), (0, -1), (1, 0), (-1, 0)):
        near = jnp.where(shifted(kinds, *shift) == kinds, shifted(labels, *shift, outside=labels.size), labels.size)
        best = jnp.minimum(best, near)
    return best


def component_sizes(labels: Array) -> Array:
    """(H * W + 1,) number of cells of each label of :func:`components`; the last one, of no component, is 0."""
    return jnp.zeros(labels.size + 1, jnp.int32).at[labels.ravel()].add(1).at[labels.size].set(0)


def largest_component(cells: Array) -> Array:
    """(H, W) bool, the largest 4-connected component of ``cells``; empty if there is none."""
    labels = components(cells)
    return cells & (labels == jnp.argmax(component_sizes(labels)))


def renumber(kinds: Array, smallest: int, count: int) -> tuple[Array, Array]:
    """Connected components of ``kinds`` (H, W) with at least ``smallest`` cells, numbered from 1 in raster order.

    Returns their numbers (H, W) int32, zero elsewhere and beyond ``count`` - 1, and the kind of each number (count,).
    """
    labels = components(kinds)
    roots = component_sizes(labels)[:-1] >= smallest
    numbers = jnp.append(jnp.where(roots, jnp.cumsum(roots), 0), 0)
    numbers = jnp.where(numbers < count, numbers, 0)
    kind_of = jnp.zeros(count, kinds.dtype).at[numbers[:-1]].set(kinds.ravel()).at[0].set(0)
    return numbers[labels], kind_of
