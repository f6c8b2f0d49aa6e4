"""Sentences about faults of the recording that look like physics of the car."""

from __future__ import annotations

from carlab.diagnosis.findings import Diagnosis
from carlab.diagnosis.report.numbers import listed

LIMITED = "limited_commands"


def recording_causes(diagnosis: Diagnosis) -> str:
    """Sentences, each after a space, about limited commands; empty without them."""
    return _limited_commands(diagnosis)


def limited_channels(diagnosis: Diagnosis) -> list[str]:
    """Commands that the log or the radio limits."""
    return list(dict.fromkeys(fault.channel for fault in diagnosis.data_faults if fault.id == LIMITED))


def _limited_commands(diagnosis: Diagnosis) -> str:
    """That limited commands cause errors of the simulator."""
    channels = limited_channels(diagnosis)
    if not channels:
        return ""
    return (
        f" The log or the radio limits the {listed(channels)}. The simulator has too small commands there, which looks "
        "like missing physics. Log the commands that the car executes, record again, and diagnose again."
    )
