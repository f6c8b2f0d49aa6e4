"""Numbers in ROS messages, addressed as in rqt_plot and PlotJuggler: ``/topic/field/field``.

``/poses/poses[car]/pose/position/x`` chooses the element of a list that has the text ``car`` in one of its own fields
(a name or ``child_frame_id``); ``poses[0]`` chooses by position, ``poses["0"]`` by the text 0. ``/orientation/yaw`` is
the yaw of a quaternion.
"""

from __future__ import annotations

import dataclasses
import keyword
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from carlab.core.errors import DataError
from mocap.axes import rotate

_STEP = re.compile(r"/([A-Za-z]\w*)(?:\[([^\]]+)\])?")
_QUATERNION = ("x", "y", "z", "w")


@dataclass(frozen=True, slots=True)
class FieldPath:
    """A number in the messages of a topic. ``steps`` are fields, each with the chosen element of a list or None."""

    topic: str
    steps: tuple[tuple[str, str | None], ...]

    def text(self, n_steps: int) -> str:
        """The first steps as in the name of a column."""
        steps = (f"/{name}" + ("" if key is None else f"[{key}]") for name, key in self.steps[:n_steps])
        return self.topic + "".join(steps)


@dataclass(frozen=True, slots=True)
class Sample:
    """A number of a message, and the stamp of the innermost header around it [ns]; None without a header."""

    value: float
    stamp_ns: int | None


class MissingElementError(Exception):
    """A list of a message lacks the chosen element. The text states which elements it has."""


def field_path(column: str, topic: str) -> FieldPath | None:
    """The path that a column name means in the messages of a topic; None if it is no path of the topic."""
    rest = column.removeprefix(topic)
    steps = tuple((match[1], match[2]) for match in _STEP.finditer(rest))
    is_path = column.startswith(topic) and steps and _STEP.sub("", rest) == ""
    return FieldPath(topic, steps) if is_path else None


def sample(message: Any, path: FieldPath) -> Sample:
    """The number at ``path``.

    Raises:
        DataError: the message has no such field, or the field is not a number.
        MissingElementError: a list of the message lacks the chosen element.
    """
    stamp_ns: int | None = None
    value = message
    for k, (_, key) in enumerate(path.steps):
        stamp_ns = _header_stamp_ns(value) or stamp_ns
        value = _field(value, path, k)
        if key is not None:
            value = _element(value, path, k)
    if not isinstance(value, (bool, int, float)):
        raise DataError(f"{path.text(len(path.steps))} is not a number: {_description(value)}.")
    return Sample(float(value), stamp_ns)


def _field(message: Any, path: FieldPath, k: int) -> Any:
    """Field of a message by step ``k`` of the path, or the yaw of a quaternion."""
    name = path.steps[k][0]
    names = _field_names(message)
    attribute = f"{name}_" if keyword.iskeyword(name) else name
    if attribute in names:
        return getattr(message, attribute)
    components = [getattr(message, axis) for axis in _QUATERNION if axis in names]
    is_quaternion = len(components) == len(_QUATERNION) and all(isinstance(c, (int, float)) for c in components)
    if name == "yaw" and is_quaternion:
        return _yaw_rad(components)
    raise DataError(f"{path.text(k)} has no field '{name}': {_description(message)}.")


def _yaw_rad(quaternion: Sequence[float]) -> float:
    """Yaw of a quaternion (x, y, z, w) of any length [rad]; NaN if it is zero, as of a body that is not tracked."""
    length = math.hypot(*quaternion)
    if length == 0.0:
        return math.nan
    x, y, z, w = (component / length for component in quaternion)
    forward = rotate((x, y, z, w), (1.0, 0.0, 0.0))
    return math.atan2(forward[1], forward[0])


def _field_names(message: Any) -> list[str]:
    if not dataclasses.is_dataclass(message):
        return []
    return [field.name for field in dataclasses.fields(message) if not field.name.startswith("_")]


def _is_list(value: Any) -> bool:
    return isinstance(value, (list, np.ndarray))


def _description(value: Any) -> str:
    """What a part of a message is, for messages of errors."""
    if names := _field_names(value):
        return f"{getattr(value, '__msgtype__', 'the message')} has the fields {', '.join(names)}"
    if _is_list(value):
        return f"it is a list of {len(value)} elements, of which [0] is the first one"
    return "it is a text" if isinstance(value, str) else "it is a number"


def _element(values: Any, path: FieldPath, k: int) -> Any:
    """Element of a list by step ``k`` of the path: by its position, or by a text in one of its own fields."""
    key = path.steps[k][1] or ""
    if not _is_list(values):
        raise DataError(f"{path.text(k + 1)} is not an element of a list: {_description(values)}.")
    text = key.strip("\"'")
    texts = [_texts(element) for element in values] if isinstance(values, list) else []
    index = next((k for k, own in enumerate(texts) if text in own), None)
    if key.isdecimal():
        if index is not None:
            raise DataError(
                f"{path.text(k + 1)} is the name of an element, and {key} may be the position of another one; write "
                f'["{key}"] for the name.'
            )
        index = int(key) if int(key) < len(values) else None
    if index is None:
        names = ", ".join(dict.fromkeys(repr(name) for own in texts for name in own[:1]))
        raise MissingElementError(f"{len(values)} elements" + (f" ({names[:200]})" if names else ""))
    return values[index].item() if isinstance(values, np.ndarray) else values[index]


def _texts(element: Any) -> list[str]:
    """Texts in the own fields of a message."""
    return [text for name in _field_names(element) if isinstance(text := getattr(element, name), str)]


def _header_stamp_ns(message: Any) -> int | None:
    """Stamp of the header of a message [ns]; None without a header or with a stamp of zero."""
    stamp = getattr(getattr(message, "header", None), "stamp", None)
    sec, nanosec = getattr(stamp, "sec", None), getattr(stamp, "nanosec", None)
    if not (isinstance(sec, int) and isinstance(nanosec, int)):
        return None
    return sec * 1_000_000_000 + nanosec or None
