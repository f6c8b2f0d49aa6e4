"""Sentence about the integration error of the simulator."""

from __future__ import annotations

from collections.abc import Mapping

from carlab.diagnosis.findings import Diagnosis
from carlab.diagnosis.report.numbers import listed


def integration_sentence(diagnosis: Diagnosis, channel_names: Mapping[str, str]) -> str:
    """The channels whose integration error exceeds the noise, if the verdict interprets errors; else empty."""
    channels = [fault.channel for fault in diagnosis.data_faults if fault.id == "integration_error"]
    if not channels or diagnosis.verdict not in ("mismatch", "unexplained"):
        return ""
    return (
        " The integration error of the simulator exceeds the noise of the recordings in "
        f"{listed([channel_names.get(channel, channel) for channel in channels])} (a car with stiff tyres at low speed "
        "needs a finer step): an error of this size is no missing physics."
    )


__all__ = ["integration_sentence"]
