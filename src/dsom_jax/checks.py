"""Checks of configuration fields, for ``__post_init__``; traced numbers and arrays are passed over."""

from __future__ import annotations

import math
from collections.abc import Sequence
from numbers import Real
from typing import Any

from dsom_jax.errors import shown


def within(config: Any, names: str, least: float, most: float, fix: str, *, excluding: str = "") -> None:
    """ValueError unless every field of ``names`` (space-separated) is a number from ``least`` to ``most``.

    ``excluding`` holds ``(`` where ``least`` itself is refused and ``)`` where ``most`` is; infinity and NaN are too.
    """
    for name in names.split():
        value = getattr(config, name)
        if hasattr(value, "aval"):  # a traced number or an array on the device
            continue
        low = _number(value) and (value > least if "(" in excluding else value >= least)
        if not (low and (value < most if ")" in excluding else value <= most)):
            raise ValueError(message(config, name, fix))


def positive(config: Any, names: str) -> None:
    """ValueError unless the fields are positive numbers."""
    within(config, names, 0, math.inf, "give a positive number", excluding="()")


def not_negative(config: Any, names: str) -> None:
    """ValueError unless the fields are numbers from zero on."""
    within(config, names, 0, math.inf, "must not be negative, give 0 or more", excluding=")")


def finite(config: Any, names: str) -> None:
    """ValueError unless the fields are finite numbers."""
    within(config, names, -math.inf, math.inf, "give a finite number", excluding="()")


def share(config: Any, names: str, *, excluding: str = "") -> None:
    """ValueError unless the fields are probabilities or shares; ``excluding`` as in :func:`within`."""
    edges = {"(": " above 0", ")": " below 1", "()": " between 0 and 1, neither of them"}
    within(config, names, 0, 1, f"give a share{edges.get(excluding, ' from 0 to 1')}", excluding=excluding)


def span(config: Any, name: str) -> None:
    """ValueError unless the field is a pair of shares, the least and the greatest, neither of them 0 or 1."""
    value = getattr(config, name)
    if not (isinstance(value, tuple) and len(value) == 2 and all(map(_number, value)) and 0 < value[0] <= value[1] < 1):
        raise ValueError(message(config, name, "give two shares between 0 and 1, the least and the greatest"))


def count(config: Any, names: str, least: int = 1) -> None:
    """ValueError unless the fields are whole numbers from ``least`` on."""
    for name in names.split():
        value = getattr(config, name)
        if not hasattr(value, "aval") and not (_number(value) and value >= least and value == int(value)):
            raise ValueError(message(config, name, f"give at least {_NAMES.get(least, least)}, a whole number"))


_NAMES = {1: "one"}


def choice(config: Any, name: str, allowed: Sequence[str]) -> None:
    """ValueError unless the field is one of ``allowed``."""
    if getattr(config, name) not in allowed:
        raise ValueError(message(config, name, f"choose {' or '.join(map(repr, allowed))}"))


def low_high(config: Any, names: str, least: float = -math.inf) -> None:
    """ValueError unless the fields are pairs (low, high) of finite numbers with least <= low <= high."""
    for name in names.split():
        pair = getattr(config, name)
        sound = isinstance(pair, tuple) and len(pair) == 2 and all(map(_number, pair))
        if not (sound and least <= pair[0] <= pair[1]):
            bounds = f", from {least:g} on" if math.isfinite(least) else ""
            raise ValueError(message(config, name, f"give two numbers, the lower one first{bounds}"))


def sum_to_one(config: Any, names: str) -> None:
    """ValueError unless the fields sum to one."""
    total = sum(getattr(config, name) for name in names.split())
    if abs(total - 1) > 1e-6:
        raise ValueError(f"{' + '.join(names.split())} = {total:g}: must be 1")


def message(config: Any, name: str, fix: str) -> str:
    """Field and value, and what to do; whoever reads a file puts its name before it."""
    return f"{name} = {shown(getattr(config, name))}: {fix}"


def _number(value: Any) -> bool:
    if isinstance(value, int):  # perhaps too large for a float
        return not isinstance(value, bool)
    return isinstance(value, Real) and math.isfinite(value)
