"""A bag as a file: is it one, is it sound, and what are its messages; ``rosbags`` asks little of what it reads."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import msgspec

from dsom_jax.data.bag_types import odd_field
from dsom_jax.data.documents import read_yaml
from dsom_jax.data.files import check_file
from dsom_jax.data.log import Report
from dsom_jax.errors import UserError

SUFFIXES = (".bag", ".db3", ".mcap")


class Topic(msgspec.Struct):
    """A topic in the metadata.yaml of a rosbag2; what is not read of it may be anything."""

    name: str
    type: str


class Counted(msgspec.Struct):
    """How often a topic was recorded."""

    topic_metadata: Topic
    message_count: int


class Information(msgspec.Struct):
    """``rosbag2_bagfile_information``, what a rosbag2 is opened by."""

    storage_identifier: str
    relative_file_paths: list[str]
    topics_with_message_count: list[Counted]


class Metadata(msgspec.Struct):
    """The metadata.yaml of a rosbag2."""

    rosbag2_bagfile_information: Information


def is_bag(path: Path) -> bool:
    """Whether a path looks like a bag."""
    return path.suffix.lower() in SUFFIXES or (path.is_dir() and (path / "metadata.yaml").is_file())


@contextmanager
def open_bag(path: Path) -> Iterator[Any]:
    """Reader of any kind of bag. One that says nothing of its types, as Humble's do, is taken to be of Humble."""
    # Late, as most who import this package read no bag.
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    if not path.is_dir():
        check_file(path, "bag")
    elif (path / "metadata.yaml").exists():
        _check_metadata(path / "metadata.yaml")
    try:
        reader = AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE))
        reader.open()
    except Exception as error:
        # Broken bags surface as whatever the storage underneath raises: sqlite3, struct, zstd, ...
        cause = (str(error) or type(error).__name__).splitlines()[0]
        raise UserError(f"{path}: not a readable bag ({cause}); record it again or try rosbag reindex") from error
    try:
        yield reader
    finally:
        reader.close()


def _check_metadata(path: Path) -> None:
    """UserError unless what is read of a metadata.yaml is bounded and of the right types: rosbags asks neither."""
    try:
        msgspec.convert(read_yaml(path, "description of the bag"), Metadata)
    except msgspec.ValidationError as error:
        raise UserError(f"{path}: {error}; restore it, or make it anew by ros2 bag reindex") from None


def listed(topics: dict[str, str]) -> str:
    """The topics of a bag for an error message."""
    names = ", ".join(f"{topic} ({kind})" for topic, kind in sorted(topics.items()))
    return f"topics in the bag: {names or 'none'}"


def messages_of_topics(reader: Any, wanted: list[Any], report: Report) -> Iterator[tuple[str, int, Any]]:
    """Topic, time of recording (ns) and message, as far as the bag can be read; what cannot is counted."""
    odd = {c.topic: odd_field(reader.typestore.fielddefs, c.msgtype) for c in wanted}
    for topic, field_name in odd.items():
        if field_name:
            report.add(f"unreadable messages on {topic}", f"their definition in the bag lacks {field_name}")
    sound = [c for c in wanted if not odd[c.topic]]
    stream = reader.messages(connections=sound) if sound else iter(())  # of no connections rosbags reads all
    while True:
        try:
            connection, received, raw = next(stream)
        except StopIteration:
            return
        except Exception as error:
            report.add("broken places where the bag was left", type(error).__name__)
            return
        try:
            message = reader.deserialize(raw, connection.msgtype)
        except Exception as error:
            report.add(f"unreadable messages on {connection.topic}", type(error).__name__)
            continue
        yield connection.topic, received, message
