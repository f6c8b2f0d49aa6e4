"""The report of an audit: findings with evidence, and the option that acts on each."""

from __future__ import annotations

import enum
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field

import numpy as np

from carlab.core.errors import DataError
from carlab.recording.faults.fault import Fault
from carlab.recording.pose_velocity import BoolArray, IndexArray

AUDIT_SCHEMA = "carlab.audit/1"
"""Name and version of the report's JSON."""
MAX_ROWS = 60
"""Maximum number of rows that a finding lists."""


class Severity(enum.IntEnum):
    """Severity of a finding, in ascending order."""

    INFO = 0
    """A property of the recording, without a fault."""
    REPAIRED = 1
    """A fault that was repaired as declared in the mapping."""
    WARNING = 2
    """A fault that degrades models fitted to the recording."""
    FAULT = 3
    """The data are very probably wrong as imported; the option corrects them."""
    ERROR = 4
    """The recording cannot be imported as it is."""


@dataclass(frozen=True, slots=True)
class Finding:
    """One observation about a recording.

    ``rows`` are the first affected data rows (row 1 follows the header; checks after one that left out rows number the
    remaining rows), ``count`` is the number of affected rows;
    ``option`` is the ``carlab import`` option that acts on the finding.
    """

    id: str
    channel: str
    severity: Severity
    sentence: str
    count: int = 0
    rows: tuple[int, ...] = ()
    evidence: Mapping[str, float] = field(default_factory=dict)
    option: str | None = None

    @classmethod
    def at(
        cls,
        rows: IndexArray | BoolArray,
        identity: str,
        channel: str,
        severity: Severity,
        sentence: str,
        evidence: Mapping[str, float] | None = None,
        option: str | None = None,
    ) -> Finding:
        """A finding about rows, given by indices (n,) from 0 or a mask (N,)."""
        indices = np.flatnonzero(rows) if rows.dtype == bool else rows
        numbers = tuple(int(k) + 1 for k in indices[:MAX_ROWS])
        return cls(identity, channel, severity, sentence, len(indices), numbers, evidence or {}, option)

    @classmethod
    def of_fault(cls, fault: Fault, severity: Severity = Severity.FAULT, remedy: str | None = None) -> Finding:
        """A fault with its remedy, by default its option. A repaired fault has no option left.

        The name of a column at the beginning of the sentence keeps its spelling.
        """
        clause = f"use {fault.option}" if remedy is None and fault.option else remedy
        observation = fault.observation
        if observation.startswith(f"{fault.channel} "):
            observation = f"column{'s' if ', ' in fault.channel else ''} {observation}"
        sentence = observation[0].upper() + observation[1:] + (f"; {clause}." if clause else ".")
        option = None if severity is Severity.REPAIRED else fault.option
        return cls.at(fault.rows, fault.id, fault.channel, severity, sentence, fault.evidence, option)


@dataclass(frozen=True, slots=True)
class AuditReport:
    """All findings about one recording, in the order of the checks.

    ``refusal`` is the reason why the recording was not imported; None if it was imported.
    """

    source: str
    layout: str
    findings: tuple[Finding, ...]
    refusal: str | None = None

    def of(self, identity: str, channel: str | None = None) -> tuple[Finding, ...]:
        """Findings with this id, and this channel if one is given."""
        return tuple(f for f in self.findings if f.id == identity and channel in (None, f.channel))

    @property
    def worst(self) -> Severity:
        """The highest severity; INFO for an empty report."""
        return max((f.severity for f in self.findings), default=Severity.INFO)

    def rows(self) -> list[tuple[str, str, str, int, str, str]]:
        """Table rows: severity, id, channel, count, sentence, option; highest severity first."""
        ordered = sorted(self.findings, key=lambda f: -f.severity)
        return [(f.severity.name.lower(), f.id, f.channel, f.count, f.sentence, f.option or "") for f in ordered]

    def to_dict(self) -> dict[str, object]:
        """The report as plain data for JSON."""
        return {
            "schema": AUDIT_SCHEMA,
            "source": self.source,
            "layout": self.layout,
            "refusal": self.refusal,
            "findings": [
                {**asdict(f), "severity": f.severity.name.lower(), "rows": list(f.rows)} for f in self.findings
            ],
        }


class RefusedError(DataError):
    """A file that cannot be imported as declared.

    Attributes:
        all_findings: all findings up to the refusal.
        findings: those of severity ERROR.
    """

    def __init__(self, source: str, findings: Sequence[Finding]) -> None:
        self.all_findings = tuple(findings)
        self.findings = tuple(f for f in findings if f.severity is Severity.ERROR)
        if len(self.findings) == 1:
            super().__init__(f"{source}: {self.findings[0].sentence}")
        else:
            faults = "".join(f"\n  - {f.sentence}" for f in self.findings)
            super().__init__(f"{source} has {len(self.findings)} faults:{faults}")


def raise_errors(source: str, findings: Sequence[Finding]) -> None:
    """Raise one RefusedError with the sentence of every finding that is an ERROR."""
    if any(f.severity is Severity.ERROR for f in findings):
        raise RefusedError(source, findings)
