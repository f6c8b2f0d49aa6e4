"""Artificial diagnoses with each verdict and data for their figures, for the tests of the report."""

import functools
import math
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from carlab.diagnosis.findings import (
    DataFault,
    Diagnosis,
    EffectFinding,
    ErrorLocation,
    Estimate,
    Evidence,
    FigureData,
    FitErrors,
    RecordingUse,
    Trace,
    Unexplained,
)
from carlab.diagnosis.report.next_drive import with_texts
from sim_backends.car_parameters import SimulatorConfig


def estimate(value: float, std: float, unit: str) -> Estimate:
    return Estimate(value, std, value - 1.6449 * std, value + 1.6449 * std, unit)


def drive(lag_s: float, seconds: float = 24.0, rate_hz: float = 30.0) -> tuple[NDArray, NDArray]:
    """Simulate a weaving kinematic car with a steering lag; return times (T,) and states (T, 6)."""
    t = np.arange(round(seconds * rate_hz)) / rate_hz
    return t, _weave(t, np.zeros(6), 0.0, lag_s)


def _weave(t: NDArray, start: NDArray, angle: float, lag_s: float) -> NDArray:
    states = [start]
    for k in range(len(t) - 1):
        dt = t[k + 1] - t[k]
        target_angle = 0.35 * np.sign(np.sin(2 * np.pi * t[k] / 3.1)) + 0.1 * np.sin(t[k])
        angle += (target_angle - angle) * (1.0 if lag_s <= 0 else -math.expm1(-dt / lag_s))
        x, y, yaw = states[-1][:3]
        v = 1.6 + 0.5 * np.sin(0.5 * t[k])
        r = v * np.tan(angle) / 0.3
        move = (x + dt * v * np.cos(yaw), y + dt * v * np.sin(yaw), yaw + dt * r)
        states.append(np.array([*move, v, 0.12 * r, r]))
    return np.array(states)


def trace(name: str = "recording 1") -> Trace:
    return replace(_trace(), name=name, predicted=dict(_trace().predicted))


@functools.cache
def _trace() -> Trace:
    t, recorded = drive(0.11)
    predicted: dict[str, NDArray] = {}
    for model, lag_s in (("nominal", 0.0), ("refit", 0.03), ("with_effects", 0.10)):
        rows = np.full_like(recorded, np.nan)
        for first in range(30, len(t) - 60, 30):
            part = slice(first, first + 30)
            rows[part] = _weave(t[part], recorded[first], float(np.arctan(recorded[first, 5] * 0.15)), lag_s)
        predicted[model] = rows
    return Trace("", t, recorded, predicted, ((4.0, 5.0), (9.0, 10.0), (17.0, 18.0)))


def lag_finding() -> EffectFinding:
    return EffectFinding(
        id="steering_lag",
        confidence=0.49,
        parameters={"time_constant": estimate(0.11, 0.0091, "s")},
        where=ErrorLocation(("yaw_rate", "vy"), "|steering rate| > 2.1 /s", 0.11, None, None),
        evidence=Evidence(
            0.413, 14.2, 0.63, {"yaw_rate": 0.92, "vy": 0.41, "yaw": 0.33, "x": 0.02, "y": 0.1, "vx": -0.01}
        ),
        sentence="",
        indistinguishable_from=("steering_delay",),
        separating_drive="steering_steps",
    )


def patch_finding() -> EffectFinding:
    parameters = {
        "x": estimate(1.31, 0.021, "m"),
        "y": estimate(-0.42, 0.034, "m"),
        "radius": estimate(0.62, 0.045, "m"),
        "loss": estimate(0.47, 0.052, "1"),
    }
    where = ErrorLocation(("vy",), "speed > 1.9 m/s", None, (3.5, 21.25), (1.31, -0.42, 0.62))
    evidence = Evidence(0.17, 6.4, 0.88, {"vy": 0.44, "yaw_rate": 0.21, "yaw": 0.12, "x": 0.01, "y": 0.05, "vx": 0.03})
    return EffectFinding("low_friction_patch", 0.97, parameters, where, evidence, "")


FLOOR = FitErrors(0.0051, 0.0082, 0.021, 0.019, 0.053, 1.0)
NOMINAL = FitErrors(0.193, 0.184, 0.118, 0.153, 0.72, 7.42)
REFIT = FitErrors(0.084, 0.091, 0.043, 0.081, 0.41, 3.86)
WITH = FitErrors(0.0091, 0.0122, 0.027, 0.024, 0.071, 1.37)
USES = (
    RecordingUse("drives/2024-06-07 morning.csv", "9f" * 32, "fit"),
    RecordingUse("drives/2024-06-07 noon.csv", "3c" * 32, "held out"),
)
PARAMETERS = {
    "motor.drive_gain": estimate(7.83, 0.092, "N"),
    "motor.damping": estimate(1.61, 0.033, "N s/m"),
    "tyre.front.mu": estimate(0.432, 0.0072, "1"),
    "vehicle.yaw_inertia": estimate(0.0612, 0.0021, "kg m2"),
    "steering.max_angle": estimate(0.583, 0.0063, "rad"),
}


def mismatch() -> Diagnosis:
    held = {"nominal": NOMINAL, "refit": REFIT, "with_effects": WITH, "noise_floor": FLOOR}
    faults = (DataFault("yaw_wrap_spikes", "yaw_rate", 21, "repaired from the pose"),)
    effects = (lag_finding(), patch_finding())
    return with_texts(Diagnosis("mismatch", "", effects, PARAMETERS, 1.0, held, None, faults, USES, 7, 41.3))


def changed(diagnosis: Diagnosis, **changes: Any) -> Diagnosis:
    """The diagnosis with other results, and with the sentences for these."""
    return with_texts(replace(diagnosis, advice="", **changes))


def figure_data() -> FigureData:
    lags = np.arange(12) / 30.0
    curve = 0.46 * np.exp(-((lags - 0.1) ** 2) / 0.006)
    speed, ay = np.linspace(0.4, 2.4, 6), np.linspace(0.1, 6.2, 6)
    return FigureData(
        traces=(trace(), replace(trace("recording 2"), marked=((7.0, 8.0),))),
        scores_by_step=(
            ("nominal", 7.42),
            ("refit", 3.86),
            ("+ steering_lag", 1.81),
            ("+ low_friction_patch", 1.37),
            ("noise floor", 1.0),
        ),
        regimes={
            "speed [m/s]": (speed, 1.1 + 1.5 * speed, 1.2 + 0.1 * speed),
            "|steering rate| [/s]": (ay, 1.3 + 0.9 * ay, 1.3 + 0.02 * ay),
            "lateral acceleration [m/s2]": (ay, 1.5 + 0.4 * ay, 1.25 + 0.03 * ay),
        },
        correlation={"steering_lag": (lags, curve, 0.14)},
        candidates=(("steering_lag", 14.2, 1.8), ("steering_delay", 13.6, 1.83), ("steering_rate_limit", 7.7, 2.9)),
    )


def parameters_only() -> Diagnosis:
    held = {"nominal": NOMINAL, "refit": replace(WITH, score=1.08), "noise_floor": FLOOR}
    return changed(mismatch(), verdict="parameters", effects=(), held_out=held, data_faults=())


def no_mismatch() -> Diagnosis:
    held = {"nominal": replace(WITH, score=1.03), "refit": replace(WITH, score=1.02), "noise_floor": FLOOR}
    return changed(parameters_only(), verdict="none", held_out=held)


def faulty_data() -> Diagnosis:
    fault = DataFault("stale_samples", "yaw_rate", 1834, "unusable: the column repeats itself for 61 s")
    return changed(no_mismatch(), verdict="data", held_out={}, parameters={}, data_faults=(fault,))


def unexplained_physics() -> Diagnosis:
    unexplained = Unexplained(
        0.83, ("vx", "x"), "speed > 1.8 m/s", "even in steering, grows with speed; acts on vx", "a_x = -0.31 |d| v"
    )
    return changed(no_mismatch(), verdict="unexplained", held_out=mismatch().held_out, unexplained=unexplained)


def inconclusive() -> Diagnosis:
    reason = "The car hardly moves in the recordings to fit; record a drive (carlab drive --policy figure_eight)."
    return Diagnosis("inconclusive", reason, (), {}, 1.0, {}, None, (), USES[:1], 0, 0.0, reason)


CASES = {
    d.verdict: d
    for d in (mismatch(), parameters_only(), no_mismatch(), faulty_data(), unexplained_physics(), inconclusive())
}


def model() -> SimulatorConfig:
    changes = {"motor.drive_gain": 7.83, "effects.steering_lag.time_constant": 0.11}
    return SimulatorConfig.from_preset().with_values(changes)
