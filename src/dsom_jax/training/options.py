"""Configurations from plain mappings (YAML, JSON), with errors that name the field."""

from __future__ import annotations

from dataclasses import fields, is_dataclass, replace
from typing import Any

from dsom_jax.errors import UserError, one_line, shown

WORDS = {int: "a whole number", float: "a number", str: "a word", bool: "true or false", tuple: "a list"}
"""What the types of fields are called."""


def override(config: Any, given: Any, where: str) -> Any:
    """The frozen dataclass ``config`` with the fields of the mapping ``given``; nested ones alike."""
    if not isinstance(given, dict):
        raise UserError(f"{where}: expected a list of 'field: value' lines, got {shown(given)}")
    values = {}
    for name, value in given.items():
        if name not in {f.name for f in fields(config)}:
            known = ", ".join(f.name for f in fields(config))
            raise UserError(f"{where}: unknown field {one_line(str(name), 60)}; the fields are {known}")
        old = getattr(config, name)
        values[name] = (override if is_dataclass(old) else convert)(old, value, f"{where}: {name}")
    try:
        return replace(config, **values)
    except (TypeError, ValueError, ArithmeticError) as error:
        raise UserError(f"{where}: {error}") from error


def convert(old: Any, value: Any, where: str) -> Any:
    """``value`` as the type of ``old``: numbers, text, booleans and tuples of numbers; an empty one takes any list."""
    if isinstance(old, tuple) and isinstance(value, list):
        if not old:
            return tuple(value)
        if len(value) != len(old):
            raise UserError(f"{where}: expected {len(old)} values like {list(old)!r}, got {shown(value)}")
        return tuple(convert(a, b, where) for a, b in zip(old, value, strict=True))
    if isinstance(old, float) and isinstance(value, int) and not isinstance(value, bool):
        if abs(value) < 2**63:
            return float(value)
        raise UserError(f"{where}: {shown(value)} is too large; give a number like {old!r}")
    if type(old) is not type(value):
        raise UserError(f"{where}: expected {WORDS.get(type(old), 'a value')} like {old!r}, got {shown(value)}")
    return value
