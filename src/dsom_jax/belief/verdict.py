"""How far an answer can be trusted: ``p_lost``, and a verdict in a word.

``p_lost`` is the probability that the answer is more than 2 m or 10 deg off. It is right if it is at the right one of
the places that the belief considers, and if belief, map and robot are what they seem. The first is a share of the
belief; of the second any one sign of :mod:`dsom_jax.belief.monitor` is enough to doubt: each is measured in its own
tolerance, and the doubt is their 8-norm, a smooth maximum. No sign of trouble can make an answer more credible. The
tolerances are set and trimmed on simulated drives alone (``experiments/trust/learn.py``).
"""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple

import jax
import jax.numpy as jnp

from dsom_jax.belief import learnt
from dsom_jax.belief.hypotheses import Hypotheses
from dsom_jax.belief.monitor import Signs
from dsom_jax.types import Array

CERTAIN = 0.05
"""``p_lost`` below which an answer may be called localized."""
_ENTER = 0.035
_PLACE = 0.05
"""Weight from which a place is worth a mention in ``ambiguous``."""

class Verdict(IntEnum):
    """What to make of an answer."""

    LOCALIZED = 0
    """One place, and nothing speaks against it."""
    AMBIGUOUS = 1
    """A few places hold the belief."""
    OFF_MAP = 2
    """The robot seems to be where the map shows nothing."""
    LOST = 3
    """None of these."""


_POWER = 8


class Head(NamedTuple):
    """Tolerances of the signs from the third on: alone at it, a sign makes an answer as likely wrong as right."""

    slope: float
    tolerances: tuple[float, ...]


SHIPPED_HEAD = Head(learnt.SLOPE, tuple(learnt.TOLERANCES.values()))
"""The head that comes with the package."""


def doubt(signs: Signs, head: Head) -> Array:
    """(...) smooth maximum of all signs (...) but the shares of the belief, each in its own tolerance."""
    others = zip(signs[2:], head.tolerances, strict=True)
    parts = jnp.stack([jnp.maximum(sign, 0.0) / tolerance for sign, tolerance in others])
    return (parts**_POWER).sum(0) ** (1 / _POWER)


def p_lost(signs: Signs, head: Head) -> Array:
    """Probability (...) that the answer is more than 2 m or 10 deg off."""
    here = 1.0 - jnp.maximum(signs.elsewhere, signs.scattered)
    return 1.0 - here * jax.nn.sigmoid(head.slope * (1.0 - doubt(signs, head)))


def judge(before: Array, p: Array, off: Array, on_map: Array, unknown: Array, places: Hypotheses) -> Array:
    """Verdict () of an answer, int8 of :class:`Verdict`.

    Args:
        before: () the verdict of the update before: an answer stays localized a little longer than it takes to be so.
        p: () ``p_lost``.
        off: () mass of the belief off the map.
        on_map: () whether the answer lies on a free cell.
        unknown: () share of the beams that look into unknown space.
        places: hypotheses; their weights leave out what lies off the map.
    """
    localized = p < jnp.where(before == Verdict.LOCALIZED, CERTAIN, _ENTER)
    away = (off > 0.5) | ~on_map | (unknown > 0.3)
    many = (places.weights > _PLACE).sum() >= 2
    held = jnp.where(places.weights > _PLACE, places.weights, 0.0).sum() > 0.6
    word = jnp.where(many & held, Verdict.AMBIGUOUS, Verdict.LOST)
    word = jnp.where(away, Verdict.OFF_MAP, word)
    return jnp.where(localized, Verdict.LOCALIZED, word).astype(jnp.int8)
