"""Messages of a ROS bag: ROS 1 (.bag), ROS 2 (folder, .db3, .mcap), read by the library rosbags without ROS."""

from __future__ import annotations

import importlib.util
from collections.abc import Collection, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mcap.exceptions import McapError
from mcap.reader import make_reader

from carlab.core.errors import ConfigError, DataError
from carlab.core.extras import install_hint
from carlab.recording.ros.definitions import types_of

if TYPE_CHECKING:
    from rosbags.interfaces import Connection
    from rosbags.rosbag1 import Reader as Rosbag1
    from rosbags.rosbag2 import Reader as Rosbag2
    from rosbags.typesys.store import Typestore

METADATA = "metadata.yaml"
"""File in the folder of a ROS 2 bag."""
ENDINGS = (".bag", ".db3")
_ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
"""First bytes of content that is compressed by zstd. A message of ROS 2 begins with a zero."""


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
        self._is_ros1 = path.suffix == ".bag"
        counts: dict[tuple[str, str], int] = {}
        for connection in reader.connections:
            key = connection.topic, connection.msgtype
            if not all(isinstance(name, str) and name.isprintable() for name in key):
                raise DataError(f"{path.name} has a topic or a type with the name {key!r}, which is no name of ROS.")
            counts[key] = counts.get(key, 0) + connection.msgcount
        self.topics = tuple(Topic(name, kind, n) for (name, kind), n in sorted(counts.items()))

    def fields(self, topic: str) -> tuple[str, ...]:
        """Names of the fields of the messages of a topic; empty without a definition.

        Raises:
            DataError: a definition cannot be read.
        """
        connections = self._connections({topic})
        store = self._types(connections)
        fields = [field for one in connections for field, _ in store.fielddefs.get(one.msgtype, ((), ()))[1]]
        return tuple(dict.fromkeys(fields))

    def messages(self, topics: Iterable[str]) -> Iterator[Message]:
        """Decoded messages of the topics, in the order of the bag.

        Raises:
            DataError: a message cannot be read, or the bag lacks the definition of its type.
        """
        connections = self._connections(set(topics))
        store = self._types(connections)
        for connection in connections:
            if connection.msgtype not in store.fielddefs:
                raise DataError(
                    f"{self.path.name} has no definition of {connection.msgtype} ({connection.topic}); convert it to "
                    "MCAP, which contains the definitions: ros2 bag convert."
                )
        decode = store.deserialize_ros1 if self._is_ros1 else store.deserialize_cdr
        with _faults_of(self.path):
            for connection, received_ns, content in self._reader.messages(connections):
                if content[:4] == _ZSTD_MAGIC and not self._is_ros1:
                    raise DataError(
                        f"The messages of {self.path.name} are compressed; name the folder of the bag, in which "
                        f"{METADATA} states the compression."
                    )
                yield Message(connection.topic, int(received_ns), decode(content, connection.msgtype))

    def _connections(self, topics: Collection[str]) -> list[Connection]:
        return [connection for connection in self._reader.connections if connection.topic in topics]

    def _types(self, connections: Iterable[Connection]) -> Typestore:
        with _faults_of(self.path):
            return types_of(connections, is_ros1=self._is_ros1)


@contextmanager
def opened_bag(path: Path) -> Iterator[Bag]:
    """Open a bag.

    Raises:
        ConfigError: the library rosbags is not installed.
        DataError: the bag cannot be read.
    """
    if importlib.util.find_spec("rosbags") is None:
        raise ConfigError(f"{path.name} is a ROS bag, which needs the package rosbags; {install_hint('ros')}.")
    from rosbags.rosbag1 import Reader as Rosbag1
    from rosbags.rosbag2 import Reader as Rosbag2

    _check_path(path)
    with ExitStack() as stack:
        with _faults_of(path):
            reader = Rosbag1(path) if path.suffix == ".bag" else Rosbag2(path)
            stack.enter_context(reader)
            bag = Bag(path, reader)
        yield bag


def _check_path(path: Path) -> None:
    """Raise DataError for a database whose path the library would read as another one."""
    has_database = path.suffix == ".db3" or any(path.glob("*.db3"))
    if has_database and any(character in str(path) for character in "#?%"):
        raise DataError(f"The path {path} of a bag has one of the characters # ? %; rename the file or its folder.")


@contextmanager
def _faults_of(path: Path) -> Iterator[None]:
    """Raise DataError for anything that the library raises: a damaged bag ends in many kinds of exceptions."""
    try:
        yield
    except DataError:
        raise
    except Exception as error:
        words = "".join(c if c.isprintable() else " " for c in str(error)).split()
        reason = " ".join(words)[:200] or type(error).__name__
        raise DataError(
            f"{path.name} cannot be read as a ROS bag ({reason}); copy it again, or repair it: 'ros2 bag reindex', "
            "'mcap recover' or 'rosbag reindex'."
        ) from error
