"""Deadlines of an actuator that a busy test machine does not exceed."""

from __future__ import annotations

from typing import Any

from drivers.config import ActuatorConfig


def patient_config(**settings: Any) -> ActuatorConfig:
    """Configuration with long deadlines, and the given settings."""
    deadlines = {"watchdog_s": 2.0, "latch_s": 30.0, "telemetry_stale_s": 5.0, "telemetry_lost_s": 10.0}
    return ActuatorConfig(**(deadlines | settings))
