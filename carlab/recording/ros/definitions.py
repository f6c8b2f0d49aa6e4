"""Types of the messages of a ROS bag: those that the bag defines, and those of the library rosbags."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

from carlab.core.errors import DataError

if TYPE_CHECKING:
    from rosbags.interfaces import Connection
    from rosbags.typesys.store import Typestore

MAX_FIXED_ELEMENTS = 1000
"""Largest fixed size of a list of texts or messages. The library writes code for each element."""
_NAME = re.compile(r"[A-Za-z]\w*", re.ASCII)
_TYPE_NAME = re.compile(r"[A-Za-z]\w*(/[A-Za-z]\w*)+", re.ASCII)
_BASE_NAME = re.compile(r"[a-z]+\d*", re.ASCII)
_ACKERMANN = {
    "ackermann_msgs/msg/AckermannDrive": "\n".join(
        f"float32 {name}" for name in ("steering_angle", "steering_angle_velocity", "speed", "acceleration", "jerk")
    ),
    "ackermann_msgs/msg/AckermannDriveStamped": "std_msgs/Header header\nackermann_msgs/AckermannDrive drive",
}
"""Definitions that neither the library nor older bags contain (ackermann_msgs 2.0, docs.ros.org)."""
_IDL_SEPARATOR = "=" * 80 + "\nIDL: "
_IDL_DIRECTIVE = re.compile(r"^[ \t]*#.*$", re.MULTILINE)
_IDL_TEXT = re.compile(r'"(?:\\.|[^"\\])*"|//[^\n]*')
_IDL_NESTED_BRACKETS = re.compile(r"\([^()]*\(")


def types_of(connections: Iterable[Connection], *, is_ros1: bool) -> Typestore:
    """Types of the messages of connections. The definitions of the bag replace those of the library.

    The library compiles definitions to Python code. Therefore only plain names and sizes are passed to it, without
    constants and default values.

    Raises:
        DataError: a definition has a name or a size that ROS does not allow.
        Exception: the library cannot read a definition.
    """
    from rosbags.interfaces import MessageDefinitionFormat
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.LATEST)
    definitions: dict[str, Any] = {}
    for name, text in _ACKERMANN.items():
        definitions.update(get_types_from_msg(text, name))
    for connection in connections:
        if connection.msgdef.format is MessageDefinitionFormat.MSG:
            definitions.update(get_types_from_msg(connection.msgdef.data, connection.msgtype))
        elif connection.msgdef.format is MessageDefinitionFormat.IDL:
            definitions.update(_idl_types(connection.msgdef.data))
    for name, (_, fields) in definitions.items():
        _check_definition(name, fields)
        store.fielddefs.pop(name, None)
        store.register({name: ([], fields)})
    return store


def _idl_types(text: str) -> dict[str, Any]:
    """Types of a definition in IDL, which may have several parts. The library reads no preprocessor directives."""
    from rosbags.typesys import get_types_from_idl

    if _IDL_NESTED_BRACKETS.search(_IDL_TEXT.sub("", text)):  # The library needs minutes for two levels.
        raise DataError("The bag has a definition in IDL with nested brackets, which is not supported.")
    parts = [part.partition("\n")[2] for part in text.split(_IDL_SEPARATOR)[1:]] or [text]
    types: dict[str, Any] = {}
    for part in parts:
        types.update(get_types_from_idl(_IDL_DIRECTIVE.sub("", part)))
    return types


def _check_definition(type_name: str, fields: Iterable[tuple[str, Any]]) -> None:
    """Raise DataError if a definition has a name or a size that ROS does not allow."""
    if not _TYPE_NAME.fullmatch(type_name):
        raise DataError(f"The bag defines a type with the name {type_name[:60]!r}, which is no name of ROS.")
    for field, description in fields:
        if not (_NAME.fullmatch(field) and _is_plain(description)):
            raise DataError(
                f"The bag defines {type_name[:60]} with the field {field[:60]!r}, whose name, type or size ROS does "
                "not allow."
            )


def _is_plain(description: Sequence[Any]) -> bool:
    """Whether the description of a field by the library has only plain names and sizes."""
    from rosbags.interfaces import Nodetype

    node, content = description
    if node == Nodetype.BASE:
        name, size = content
        return _BASE_NAME.fullmatch(name) is not None and _is_size(size)
    if node == Nodetype.NAME:
        return _TYPE_NAME.fullmatch(content) is not None
    element, size = content
    is_short = node == Nodetype.SEQUENCE or (element[0] == Nodetype.BASE and element[1][0] != "string")
    return _is_plain(element) and _is_size(size) and (is_short or size <= MAX_FIXED_ELEMENTS)


def _is_size(size: object) -> bool:
    return type(size) is int and size >= 0
