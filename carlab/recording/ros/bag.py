"""Messages of a ROS bag: ROS 1 (.bag), ROS 2 (folder, .db3, .mcap), read by the library rosbags without ROS."""

from __future__ import annotations

import importlib.util
import re
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mcap.exceptions import McapError
from mcap.reader import make_reader

from carlab.core.errors import ConfigError, DataError

if TYPE_CHECKING:
    from rosbags.interfaces import Connection
    from rosbags.rosbag1 import Reader as Rosbag1
    from rosbags.rosbag2 import Reader as Rosbag2
    from rosbags.typesys.store import Typestore

METADATA = "metadata.yaml"
"""File in the folder of a ROS 2 bag."""
ENDINGS = (".bag", ".db3")
_NAME = re.compile(r"[A-Za-z]\w*", re.ASCII)
_TYPE_NAME = re.compile(r"[a-z]\w*(/[A-Za-z]\w*)+", re.ASCII)
_ACKERMANN = {
    "ackermann_msgs/msg/AckermannDrive": "\n".join(
        f"float32 {name}" for name in ("steering_angle", "steering_angle_velocity", "speed", "acceleration", "jerk")
    ),
    "ackermann_msgs/msg/AckermannDriveStamped": "std_msgs/Header header\nackermann_msgs/AckermannDrive drive",
}
"""Definitions that neither the library nor older bags contain (ackermann_msgs 2.0, docs.ros.org)."""


@dataclass(frozen=True, slots=True)
class Topic:
    """A topic of a bag: name, type of its messages, number of messages."""

    name: str
    message_type: str
    n_messages: int


@dataclass(frozen=True, slots=True)
class Message:
    """A message: its topic, the time at which the recorder received it [ns since 1970], and its decoded fields."""

    topic: str
    received_ns: int
    content: Any


def is_bag(path: Path) -> bool:
    """Whether a path is a ROS bag: a .bag or .db3 file, an MCAP of ROS 2, or the folder of a bag."""
    if path.is_dir():
        return (path / METADATA).is_file()
    return path.suffix in ENDINGS or (path.suffix == ".mcap" and path.is_file() and _has_ros_profile(path))


def _has_ros_profile(path: Path) -> bool:
    try:
        with path.open("rb") as file:
            return make_reader(file).get_header().profile == "ros2"
    except (OSError, McapError, ValueError):
        return False


class Bag:
    """An open bag. Use ``opened_bag``."""

    def __init__(self, path: Path, reader: Rosbag1 | Rosbag2) -> None:
        self.path = path
        self._reader = reader
        counts: dict[tuple[str, str], int] = {}
        for connection in reader.connections:
            key = connection.topic, connection.msgtype
            counts[key] = counts.get(key, 0) + connection.msgcount
        self.topics = tuple(Topic(name, kind, n) for (name, kind), n in sorted(counts.items()))

    def messages(self, topics: Iterable[str]) -> Iterator[Message]:
        """Decoded messages of the topics, in the order of the bag.

        Raises:
            DataError: a message cannot be read, or the bag lacks the definition of its type.
        """
        names = set(topics)
        connections = [connection for connection in self._reader.connections if connection.topic in names]
        store = _types_of(self.path, connections)
        for connection in connections:
            if connection.msgtype not in store.fielddefs:
                raise DataError(
                    f"{self.path.name} has no definition of {connection.msgtype} ({connection.topic}); convert it to "
                    "MCAP, which contains the definitions: ros2 bag convert."
                )
        decode = store.deserialize_ros1 if self.path.suffix == ".bag" else store.deserialize_cdr
        with _faults_of(self.path):
            for connection, received_ns, content in self._reader.messages(connections):
                yield Message(connection.topic, received_ns, decode(content, connection.msgtype))


@contextmanager
def opened_bag(path: Path) -> Iterator[Bag]:
    """Open a bag.

    Raises:
        ConfigError: the library rosbags is not installed.
        DataError: the bag cannot be read.
    """
    if importlib.util.find_spec("rosbags") is None:
        raise ConfigError(f"{path.name} is a ROS bag, which needs the package rosbags; run: pip install 'carlab[ros]'")
    from rosbags.rosbag1 import Reader as Rosbag1
    from rosbags.rosbag2 import Reader as Rosbag2

    with ExitStack() as stack:
        with _faults_of(path):
            reader = Rosbag1(path) if path.suffix == ".bag" else Rosbag2(path)
            stack.enter_context(reader)
            bag = Bag(path, reader)
        yield bag


@contextmanager
def _faults_of(path: Path) -> Iterator[None]:
    """Raise DataError for anything that the library raises: a damaged bag ends in many kinds of exceptions."""
    try:
        yield
    except DataError:
        raise
    except Exception as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise DataError(
            f"{path.name} cannot be read as a ROS bag ({reason[:200]}); record or copy it again, or run "
            "'ros2 bag reindex' (ROS 1: 'rosbag reindex')."
        ) from error


def _types_of(path: Path, connections: Iterable[Connection]) -> Typestore:
    """Types of the messages: of the library, and those that the bag itself defines.

    The library compiles definitions to Python code. Therefore only fields with plain names are passed to it, without
    constants and default values.
    """
    from rosbags.interfaces import MessageDefinitionFormat
    from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if path.suffix == ".bag" else Stores.LATEST)
    definitions: dict[str, Any] = {}
    with _faults_of(path):
        for name, text in _ACKERMANN.items():
            definitions.update(get_types_from_msg(text, name))
        for connection in connections:
            if connection.msgdef.format is MessageDefinitionFormat.MSG:
                definitions.update(get_types_from_msg(connection.msgdef.data, connection.msgtype))
            elif connection.msgdef.format is MessageDefinitionFormat.IDL:
                definitions.update(get_types_from_idl(connection.msgdef.data))
        for name, (_, fields) in definitions.items():
            if name not in store.fielddefs:
                _check_names(name, [field for field, _ in fields])
                store.register({name: ([], fields)})
    return store


def _check_names(type_name: str, fields: Iterable[str]) -> None:
    """Raise DataError if a type or a field has a name that ROS does not allow."""
    if not _TYPE_NAME.fullmatch(type_name):
        raise DataError(f"The bag defines a type with the name {type_name[:60]!r}, which is no name of ROS.")
    for field in fields:
        if not _NAME.fullmatch(field):
            raise DataError(f"The bag defines {type_name} with the field {field[:60]!r}, which is no name of ROS.")
