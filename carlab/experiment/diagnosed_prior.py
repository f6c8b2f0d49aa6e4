"""A diagnosed car as a prior: what ``carlab diagnose`` found, and how sure it was of each number."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from carlab.cars import load_car_file
from carlab.core.errors import ConfigError, DataError
from sim_backends.car_parameters import SimulatorConfig
from sim_backends.registry import REGISTRY

REPORT = "report.json"
DOUBTS = 4.0
"""Standard deviations of the report that a range reaches to both sides."""
LEAST_SHARE = 0.05
"""Of a number, what its range reaches to both sides at least."""
SAME = 1e-6


def read_diagnosed(path: Path) -> SimulatorConfig:
    """The simulator of a car file, with ranges by the report of the diagnosis that wrote it.

    A ``report.json`` beside the file that speaks of the same numbers gives the ranges, of effects too. Without one the
    ranges are those of the file.

    Raises:
        ConfigError: the file is missing or wrong.
        DataError: the report is broken.
    """
    simulator = load_car_file(path).simulator
    report = path.parent / REPORT
    if not report.is_file():
        return simulator
    try:
        content = json.loads(report.read_text(encoding="utf-8"))
        found = with_doubts(simulator, content)
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise DataError(f"{report} cannot be read ({error!r}); diagnose again, or remove it.") from error
    return simulator if found is None else found


def with_doubts(simulator: SimulatorConfig, report: Mapping[str, Any]) -> SimulatorConfig | None:
    """The simulator with ranges about the numbers of a report; None where the report is of another simulator.

    Args:
        simulator: as the diagnosis wrote it.
        report: of the schema ``carlab.diagnosis/1``.
    """
    estimates = dict(report["parameters"])
    for effect in report["effects"]:
        estimates |= {f"effects.{effect['id']}.{name}": e for name, e in effect["parameters"].items()}
    values = simulator.values()
    ranges: dict[str, tuple[float, float]] = {}
    for name, estimate in estimates.items():
        value = float(estimate["value"])
        if name not in values or not math.isclose(values[name], value, rel_tol=SAME, abs_tol=SAME):
            return None
        if not REGISTRY[name].choices:
            ranges[name] = _range(name, value, estimate["std"])
    return replace(simulator, priors=ranges) if ranges else None


def _range(name: str, value: float, std: float | None) -> tuple[float, float]:
    info = REGISTRY[name]
    reach = max(DOUBTS * (std or 0.0), LEAST_SHARE * abs(value))
    low, high = max(value - reach, info.low), min(value + reach, info.high)
    # A number that must be above zero stays so, by as much as it is certain to.
    return (max(low, LEAST_SHARE * value) if info.positive else low), high


def check_period(prior: SimulatorConfig, period_s: float, of: str) -> None:
    """Raise ConfigError where a prior's control period is not that of a car or its recordings (``of``)."""
    own = prior.control_period_s
    if abs(own - period_s) > 0.05 * period_s:
        raise ConfigError(
            f"The prior's control period is {own:g} s and {of} {period_s:g} s; one step of the one is none of the "
            "other: choose a prior of the same control_period."
        )


__all__ = ["check_period", "read_diagnosed", "with_doubts"]
