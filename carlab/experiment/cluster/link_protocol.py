"""Messages between the process of a run and the process of its link to the cluster: one JSON object per line."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from typing import Any, Literal, get_args

Kind = Literal["connected", "answer", "done", "failed", "lost worker", "unreachable", "refused"]


@dataclass(frozen=True, slots=True)
class LinkEvent:
    """What happened on the link.

    Attributes:
        kind: ``connected``; ``answer``: a file arrived, or the training reports its state; ``done``: all files of the
            result are here; ``failed``: the training failed; ``lost worker``: its process died; ``unreachable``: the
            cluster does not answer; ``refused``: the cluster cannot be used as it is.
        message: reason of the last four.
        activity: name, steps done and number of steps of a training; empty for another answer.
    """

    kind: Kind
    message: str = ""
    activity: tuple[str, int, int] | None = None

    def to_line(self) -> str:
        """One line of JSON."""
        return json.dumps(asdict(self)) + "\n"

    @classmethod
    def from_line(cls, line: str) -> LinkEvent:
        """Read a line. Raises ValueError, KeyError or TypeError for another one."""
        content = json.loads(line)
        if content["kind"] not in get_args(Kind):
            raise ValueError(f"unknown kind {content['kind']!r}")
        activity = content["activity"]
        if activity is not None:
            name, done, total = activity
            activity = (str(name), int(done), int(total))
        return cls(content["kind"], str(content["message"]), activity)


@dataclass(frozen=True, slots=True)
class LinkRequest:
    """A request to the link: train the order in the folder ``order``, and write the result to the folder ``to``."""

    order: str
    to: str

    def to_line(self) -> str:
        """One line of JSON."""
        return json.dumps(asdict(self)) + "\n"

    @classmethod
    def from_line(cls, line: str) -> LinkRequest:
        """Read a line. Raises ValueError, KeyError or TypeError for another one."""
        content: dict[str, Any] = json.loads(line)
        return cls(str(content["order"]), str(content["to"]))
