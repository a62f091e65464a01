"""Do the message definitions that a bag carries hold what the standard ones do? A bag may say anything of its types."""

from __future__ import annotations

from functools import cache
from typing import Any


@cache
def standard() -> dict[str, Any]:
    """Fields of the standard messages, by type: those of ROS 2 Humble, which are part of ROS 1's."""
    from rosbags.typesys import Stores, get_typestore

    return dict(get_typestore(Stores.ROS2_HUMBLE).fielddefs)


def odd_field(own: dict[str, Any], msgtype: str) -> str:
    """Name of a field that the standard message has, and ``own`` (definitions by type) lacks or has as another kind.

    Empty if there is none, or the message is no standard one.
    """
    if msgtype not in standard():
        return ""
    if msgtype not in own:
        return msgtype
    held = dict(own[msgtype][1])
    for name, wanted in standard()[msgtype][1]:
        if name not in held or _kind(held[name]) != _kind(wanted):
            return str(name)
        inner = _kind(wanted)[-1]
        if "/" in inner and (found := odd_field(own, inner)):
            return f"{name}.{found}"
    return ""


def _kind(definition: Any) -> tuple[str, ...]:
    """Words for a field: single or many, and what of: ``number``, ``string`` or the name of a message."""
    node, what = definition
    if node.name == "NAME":
        return ("one", what)
    if node.name == "BASE":
        return ("one", "string" if "string" in what[0] else "number")
    return ("many", _kind(what[0])[-1])
