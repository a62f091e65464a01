"""Checks of fields one by one: both edges of every range, and numbers that only look like numbers."""

from __future__ import annotations

import math
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest

from dsom_jax import checks

NAN, INF = math.nan, math.inf


def passes(check, *values, names="a", **options) -> bool:
    """Whether fields a, b, ... with these values pass."""
    config = SimpleNamespace(**dict(zip("abc", values, strict=False)))
    try:
        check(config, names, **options)
    except ValueError as error:
        assert "SimpleNamespace" not in str(error) and "\n" not in str(error)
        return False
    return True


@pytest.mark.parametrize(
    ("check", "good", "bad"),
    [
        (checks.positive, [1e-9, 3, np.float32(2)], [0, -1.0, NAN, INF, "1", None, True]),
        (checks.not_negative, [0, 0.0, 1e9], [-1e-9, NAN, INF, False, "0"]),
        (checks.finite, [-1e9, 0, 2.5], [NAN, INF, -INF, True, [1]]),
        (checks.share, [0, 0.5, 1], [-1e-9, 1.0001, NAN, True]),
        (checks.count, [1, 2.0, 10**6], [0, -1, 1.5, NAN, INF, True, "3"]),
        (checks.low_high, [(1, 2), (1.0, 1.0), (-3, 5)], [(2, 1), (1,), (1, 2, 3), [1, 2], (1, NAN), (True, 2), 1.0]),
    ],
)
def test_edges(check, good, bad):
    assert [value for value in good if not passes(check, value)] == []
    assert [value for value in bad if passes(check, value)] == []


@pytest.mark.parametrize(
    ("excluding", "zero", "one"), [("", True, True), ("(", False, True), (")", True, False), ("()", False, False)]
)
def test_shares_with_and_without_their_edges(excluding, zero, one):
    assert passes(checks.share, 0, excluding=excluding) == zero and passes(checks.share, 1, excluding=excluding) == one
    assert passes(checks.share, 0.5, excluding=excluding)


def test_least_values():
    assert passes(checks.count, 0, least=0) and not passes(checks.count, 1, least=2)
    assert passes(checks.low_high, (1, 2), least=1) and not passes(checks.low_high, (0.9, 2), least=1)


@pytest.mark.parametrize("check", [checks.positive, checks.not_negative, checks.finite, checks.share, checks.count])
def test_every_field_is_looked_at(check):
    assert passes(check, 1, 1, names="a b") and not passes(check, 1, NAN, names="a b")
    assert not passes(checks.low_high, (1, 2), (2, 1), names="a b")


def test_choices_and_sums():
    assert passes(checks.choice, "fast", allowed=("fast", "exact")) and not passes(
        checks.choice, "slow", allowed=("fast",)
    )
    assert passes(checks.sum_to_one, 0.25, 0.75, names="a b") and not passes(
        checks.sum_to_one, 0.25, 0.751, names="a b"
    )


@pytest.mark.parametrize("check", [checks.positive, checks.count])
def test_what_is_on_the_device_is_not_fetched(check):
    assert passes(check, jnp.float32(-1.5))
