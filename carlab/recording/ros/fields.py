"""Numbers in ROS messages, addressed as in rqt_plot and PlotJuggler: ``/topic/field/field``.

``/poses/poses[car]/pose/position/x`` chooses the element of a list that has the text ``car`` in one of its own fields
(a name or ``child_frame_id``); ``poses[0]`` chooses by position. ``/orientation/yaw`` is the yaw of a quaternion.
"""

from __future__ import annotations

import dataclasses
import keyword
import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from carlab.core.errors import DataError
from mocap.axes import rotate

_STEP = re.compile(r"/([A-Za-z]\w*)(?:\[([^\]]*)\])?")
_QUATERNION = ("x", "y", "z", "w")


@dataclass(frozen=True, slots=True)
class FieldPath:
    """A number in the messages of a topic. ``steps`` are fields, each with the chosen element of a list or None."""

    topic: str
    steps: tuple[tuple[str, str | None], ...]


@dataclass(frozen=True, slots=True)
class Sample:
    """A number of a message, and the newest stamp of a header on the way to it [ns]; None without a header."""

    value: float
    stamp_ns: int | None


def field_path(column: str, topics: Iterable[str]) -> FieldPath | None:
    """The path that a column name means; None if no topic begins it or the rest is not a path."""
    owners = [topic for topic in topics if column.startswith(f"{topic}/")]
    if not owners:
        return None
    topic = max(owners, key=len)
    rest = column.removeprefix(topic)
    steps = tuple((name, key if bracket else None) for name, key, bracket in _steps(rest))
    return FieldPath(topic, steps) if _STEP.sub("", rest) == "" else None


def _steps(rest: str) -> list[tuple[str, str, bool]]:
    return [(match[1], match[2] or "", match[2] is not None) for match in _STEP.finditer(rest)]


def sample(message: Any, path: FieldPath) -> Sample | None:
    """The number at ``path``; None if a list lacks the chosen element.

    Raises:
        DataError: the message has no such field, or the field is not a number.
    """
    stamp_ns: int | None = None
    value = message
    for name, key in path.steps:
        stamp_ns = _header_stamp_ns(value) or stamp_ns
        value = _field(value, name, path.topic)
        if key is not None:
            value = _element(value, key)
            if value is None:
                return None
    if not isinstance(value, (bool, int, float)):
        fields = ", ".join(_field_names(value)) or "no fields"
        raise DataError(f"{_text(path)} is not a number; it has {fields}.")
    return Sample(float(value), stamp_ns)


def _text(path: FieldPath) -> str:
    steps = "".join(f"/{name}" + ("" if key is None else f"[{key}]") for name, key in path.steps)
    return f"{path.topic}{steps}"


def _field(message: Any, name: str, topic: str) -> Any:
    names = _field_names(message)
    if name == "yaw" and name not in names and set(_QUATERNION) <= set(names):
        forward = rotate(tuple(getattr(message, axis) for axis in _QUATERNION), (1.0, 0.0, 0.0))
        return math.atan2(forward[1], forward[0])
    attribute = f"{name}_" if keyword.iskeyword(name) else name
    if attribute not in names:
        raise DataError(f"{topic} has no field '{name}'; in its place there is {', '.join(names) or 'a number'}.")
    return getattr(message, attribute)


def _field_names(message: Any) -> list[str]:
    return [field.name for field in dataclasses.fields(message)] if dataclasses.is_dataclass(message) else []


def _element(values: Any, key: str) -> Any:
    """Element of a list by its position, or by a text in one of its own fields."""
    if not isinstance(values, Sequence) and not hasattr(values, "tolist"):
        raise DataError(f"[{key}] chooses an element, but the field is not a list; remove it.")
    elements = values if isinstance(values, Sequence) else values.tolist()
    if key.isdecimal():
        return elements[int(key)] if int(key) < len(elements) else None
    return next((e for e in elements if key in (getattr(e, name) for name in _field_names(e))), None)


def _header_stamp_ns(message: Any) -> int | None:
    """Stamp of the header of a message [ns]; None without a header or with a stamp of zero."""
    stamp = getattr(getattr(message, "header", None), "stamp", None)
    if stamp is None:
        return None
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec) or None
