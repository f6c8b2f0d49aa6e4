"""Sentences about parameters of the car file that differ from their fitted values."""

from __future__ import annotations

from carlab.diagnosis.findings import Diagnosis
from carlab.diagnosis.report.numbers import listed, with_unit
from carlab.diagnosis.settings import DEFAULT


def wrong_parameters(diagnosis: Diagnosis) -> str:
    """The parameters that differ most from the car file, in standard deviations; empty without any.

    Those at the limit of their range are left out: their standard deviations are too small.
    """
    differences = {
        name: abs(e.value - diagnosis.car_file_parameters[name]) / max(e.std, 1e-12)
        for name, e in diagnosis.parameters.items()
        if name in diagnosis.car_file_parameters
        and not (e.at_limit or e.low90 <= diagnosis.car_file_parameters[name] <= e.high90)
    }
    largest = sorted(differences, key=lambda name: -differences[name])
    shown = largest[: DEFAULT.report.max_wrong_parameters]
    parts = []
    for name in shown:
        e, stated = diagnosis.parameters[name], diagnosis.car_file_parameters[name]
        parts.append(f"{name} is {with_unit(e.value, e.unit)} (car file: {with_unit(stated, e.unit)})")
    others = len(largest) - len(shown)
    if others:
        parts.append(f"{others} more {'differs' if others == 1 else 'differ'}")
    return listed(parts)


def parameters_at_limit(diagnosis: Diagnosis) -> str:
    """Parameters whose fit ended at a limit of their range, with the remedy; empty without any."""
    names = [name for name, e in diagnosis.parameters.items() if e.at_limit]
    if not names:
        return ""
    ends = "ends" if len(names) == 1 else "end"
    return f" {listed(names)} {ends} at the limit of the range in the car file; widen it and diagnose again."
