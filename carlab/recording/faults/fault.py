"""A fault of a recording, as the detection returns it. Audit and diagnosis decide about its repair."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from carlab.recording.pose_velocity import IndexArray


@dataclass(frozen=True, slots=True)
class Fault:
    """One fault of a recording.

    Attributes:
        id: kind of the fault, as in reports.
        channel: the columns that it touches.
        observation: one clause without full stop.
        evidence: numbers by name, in SI units.
        option: ``carlab import`` option that corrects it; None where there is none.
        rows: indices (n,) from 0 of the rows that it touches; empty if it touches all.
    """

    id: str
    channel: str
    observation: str
    evidence: Mapping[str, float] = field(default_factory=dict)
    option: str | None = None
    rows: IndexArray = field(default_factory=lambda: np.zeros(0, dtype=np.intp))
