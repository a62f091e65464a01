"""YAML, JSON and TOML as plain fields, bounded in every direction, and fields as the dataclass that describes them.

YAML is read as what JSON can say too (the core schema of YAML 1.2): no dates, no octal numbers, ``yes`` is a word. A
key may stand only once. Aliases are followed, as long as what they stand for is small.
"""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar, get_type_hints

import msgspec
import yaml

from dsom_jax.data.files import MB, read_text
from dsom_jax.errors import UserError, shown

_T = TypeVar("_T")
DEPTH, VALUES = 24, 2_000_000
"""Most levels of lists and mappings within each other, and most values in all."""
DIGITS = 2**63
"""Whole numbers stay below it in size."""
_Loader: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
_NULL, _BOOL = re.compile(r"~|null|Null|NULL|"), re.compile(r"true|True|TRUE|false|False|FALSE")
_INT = re.compile(r"[-+]?(0|[1-9][0-9]*)")
_FLOAT = re.compile(
    r"[-+]?((0|[1-9][0-9]*)(\.[0-9]*)?|\.[0-9]+)([eE][-+]?[0-9]+)?|[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)"
)
_TAGS = {f"tag:yaml.org,2002:{name}": name for name in ("str", "int", "float", "bool", "null", "seq", "map")}


def read_yaml(path: str | Path, what: str) -> dict[str, Any]:
    """Mapping stored in a YAML file of at most 1 MB."""
    try:
        document = _Document(what).read(read_text(path, what, MB))
        check_tree(document)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f" at line {mark.line + 1}" if mark else ""
        raise UserError(f"{path}: not valid YAML{where}; the {what} must be a list of 'field: value' lines") from None
    except ValueError as error:
        raise UserError(f"{path}: {error}") from None
    if not isinstance(document, Mapping):
        raise UserError(f"{path}: holds no fields; the {what} must be a list of 'field: value' lines")
    return dict(document)


def read_json(path: str | Path, what: str, most: int = 64 * MB) -> Any:
    """What a JSON file holds."""
    return parse_json(read_text(path, what, most), f"{path}")


def parse_json(text: str, where: str) -> Any:
    """What a JSON text says; ``where`` names it in the error."""
    try:
        document = json.loads(text, object_pairs_hook=_once)
        check_tree(document)
    except json.JSONDecodeError as error:
        raise UserError(f"{where}: not JSON (line {error.lineno}: {error.msg}); restore it or make it again") from None
    except ValueError as error:
        raise UserError(f"{where}: not JSON that can be used: {error}") from None
    except RecursionError:
        raise UserError(f"{where}: nested too deeply, more than {DEPTH} levels; restore it or make it again") from None
    return document


def read_toml(path: str | Path, what: str) -> dict[str, Any]:
    """Fields of a TOML file of at most 1 MB."""
    try:
        document = tomllib.loads(read_text(path, what, MB))
        check_tree(document)
    except RecursionError:
        raise UserError(f"{path}: nested too deeply, more than {DEPTH} levels; flatten the {what}") from None
    except ValueError as error:  # TOMLDecodeError is one
        raise UserError(f"{path}: not valid TOML ({error})") from None
    return document


def _once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """A JSON object whose keys differ."""
    fields = dict(pairs)
    if len(fields) < len(pairs):
        names = [key for key, _ in pairs]
        raise ValueError(f"field {shown(next(n for n in names if names.count(n) > 1))} stands twice, remove one")
    return fields


def check_tree(document: Any) -> None:
    """ValueError unless a document is small: depth, number of values with aliases followed, digits."""
    rest, count = [(document, 0)], 0
    while rest:
        value, depth = rest.pop()
        count += 1
        if depth > DEPTH or count > VALUES:
            raise ValueError(f"holds more than {DEPTH} levels or {VALUES} values (aliases followed); flatten it")
        if isinstance(value, dict):
            rest += [(inner, depth + 1) for inner in value.values()]
        elif isinstance(value, list):
            rest += [(inner, depth + 1) for inner in value]
        elif isinstance(value, int) and abs(value) >= DIGITS:
            raise ValueError(f"{shown(value)} stands where no value is as large; correct it")


class _Document:
    """The values of a YAML text, built event by event so that nothing is built that is not wanted."""

    def __init__(self, what: str) -> None:
        self.what, self.anchors = what, dict[str, Any]()

    def read(self, text: str) -> Any:
        """The one document of a text, None for an empty one; ValueError for what is valid and not wanted."""
        events = yaml.parse(text, Loader=_Loader)
        found: list[Any] = []
        for event in events:
            if isinstance(event, yaml.DocumentStartEvent):
                if found:
                    raise ValueError(f"holds several documents (---); the {self.what} must be one")
                found.append(self._value(next(events), events, 0))
        return found[0] if found else None

    def _value(self, event: Any, events: Any, depth: int) -> Any:
        line = f"line {event.start_mark.line + 1}"
        if depth > DEPTH:
            raise ValueError(f"{line}: more than {DEPTH} levels of lists and fields; flatten it")
        if isinstance(event, yaml.AliasEvent):
            if event.anchor not in self.anchors:
                raise ValueError(f"{line}: *{event.anchor} names nothing; write the value out")
            return self.anchors[event.anchor]
        tag = None if event.tag in (None, "!") else _TAGS.get(event.tag, event.tag)
        if isinstance(event, yaml.ScalarEvent) and tag in (None, "str", *_SCALARS):
            value: Any = _scalar(event, tag, line)
        elif isinstance(event, yaml.SequenceStartEvent) and tag in (None, "seq"):
            value = self._sequence(events, depth)
        elif isinstance(event, yaml.MappingStartEvent) and tag in (None, "map"):
            value = self._mapping(events, depth)
        else:
            raise ValueError(f"{line}: tag {shown(event.tag)} is not read; write the value without it")
        if event.anchor:
            self.anchors[event.anchor] = value
        return value

    def _sequence(self, events: Any, depth: int) -> list[Any]:
        values = []
        while not isinstance(event := next(events), yaml.SequenceEndEvent):
            values.append(self._value(event, events, depth + 1))
        return values

    def _mapping(self, events: Any, depth: int) -> dict[str, Any]:
        fields: dict[str, Any] = {}
        shared: dict[str, Any] = {}
        while not isinstance(event := next(events), yaml.MappingEndEvent):
            line = f"line {event.start_mark.line + 1}"
            key = self._value(event, events, depth + 1)
            value = self._value(next(events), events, depth + 1)
            if isinstance(key, dict | list):
                raise ValueError(f"{line}: a list as the name of a field; name it by a word")
            if str(key) in fields:
                raise ValueError(f"{line}: field {shown(str(key))} stands twice; remove one of them")
            if key == "<<" and isinstance(value, dict):
                shared |= value  # YAML's merge key: what is written here itself counts more
            else:
                fields[str(key)] = value
        return shared | fields


def _scalar(event: Any, tag: str | None, line: str) -> Any:
    """A number, truth, null or text; numbers like 010 or 1_000, of which YAML has made several things, are text."""
    text = event.value
    if tag == "str" or (tag is None and not event.implicit[0]):
        return text
    for name, pattern in (("null", _NULL), ("bool", _BOOL), ("int", _INT), ("float", _FLOAT)):
        if tag in (None, name, "float" if name == "int" else name) and pattern.fullmatch(text):
            return _SCALARS[tag or name](text, line)
    if tag is None:
        return text
    raise ValueError(f"{line}: {shown(text)} is no {tag}; write the value without the tag !!{tag}")


def _whole(text: str, line: str) -> int:
    if len(text) > len(str(DIGITS)):
        raise ValueError(f"{line}: a number of {len(text)} digits stands where no value is as large; correct it")
    return int(text)


_SCALARS: dict[str, Callable[[str, str], Any]] = {
    "null": lambda text, line: None,
    "bool": lambda text, line: text.lower() == "true",
    "int": _whole,
    "float": lambda text, line: float(re.sub(r"\.(?=[inIN])", "", text)),
}


def fields_as(kind: type[_T], fields: Mapping[str, Any], path: str | Path, *, others: bool = True) -> _T:
    """The dataclass ``kind`` from ``fields``; UserError naming the file, the field, its value and what it must be.

    What a field must be is the description that ``msgspec.Meta`` gives it. ``others``: fields that it lacks are left
    alone.
    """
    notes = get_type_hints(kind, include_extras=True)
    if not others and (unknown := set(fields) - set(notes)):
        raise UserError(f"{path}: unknown field {shown(sorted(unknown)[0])}; the fields are {', '.join(notes)}")
    try:
        return msgspec.convert(dict(fields), kind, dec_hook=_path)
    except msgspec.ValidationError as error:
        text = str(error)
    if missing := re.match(r"Object missing required field `(\w+)`$", text):
        name = missing[1]
        raise UserError(f"{path}: field '{name}' is missing; it is {_wanted(notes[name])}") from None
    if place := re.search(r" - at `\$\.(\w+)", text):
        name = place[1]
        raise UserError(f"{path}: {name} = {shown(fields[name])}: must be {_wanted(notes[name])}") from None
    raise UserError(f"{path}: {text}") from None


def _path(kind: type, value: Any) -> Any:
    """Text as a path, the one type of a field that msgspec does not know."""
    if kind is Path and isinstance(value, str) and value:
        return Path(value)
    raise ValueError("another type")


def _wanted(note: Any) -> str:
    """What the annotation of a field says that it must be."""
    told = [meta.description for meta in getattr(note, "__metadata__", ()) if isinstance(meta, msgspec.Meta)]
    return next((text for text in told if text), "given in another form")
