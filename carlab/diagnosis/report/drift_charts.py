"""Charts of the estimated disturbances along a recording."""

from __future__ import annotations

import numpy as np

from carlab.diagnosis.findings import Drift
from carlab.diagnosis.report.figures import Figure
from carlab.diagnosis.report.numbers import unit_text
from carlab.diagnosis.report.svg import Chart, padded

AXES = (("share of the drive force", "1"), ("steering trim", "rad"), ("share of the grip", "1"), ("force", "m/s2"))


def drift_charts(drift: Drift) -> list[Figure]:
    """Each disturbance over time with its 90 % band; none for a recording without an estimate."""
    return [] if len(drift.t_s) < 2 else [_chart(drift, k) for k in range(len(AXES))]


def _chart(drift: Drift, k: int) -> Figure:
    name, unit = AXES[k]
    mean, spread = drift.mean[:, k], 1.645 * drift.std[:, k]
    label = name if unit == "1" else f"{name} [{unit_text(unit)}]"
    span = padded(np.concatenate([mean - spread, mean + spread, [0.0]]))
    chart = Chart(f"{name} over time", padded(drift.t_s), span, (300, 200), ("time [s]", label))
    chart.across(0.0, "floor")
    chart.line(drift.t_s, mean, "with_effects")
    for sign in (-1.0, 1.0):
        chart.line(drift.t_s, mean + sign * spread, "limit")
    return Figure(chart.render(), "")
