"""Measured curves as rivals of named effects, on drives with a known map, force or error of the heading."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest

from carlab.core.quantities import FloatArray
from carlab.diagnosis.curves.curve_rival import replacing_curve
from carlab.diagnosis.decisions import Decision
from carlab.diagnosis.selection.problem import RunControl, SearchProblem
from carlab.diagnosis.selection.rival_physics import RivalPhysics
from carlab.diagnosis.selection.search import search
from carlab.diagnosis.settings import DEFAULT
from carlab.prediction.windows import cut_windows, segments_of
from sim_backends import EFFECTS, SimulatorConfig, registered
from sim_backends.array_ops import ARRAYS, Ops, Value
from sim_backends.effects import (
    ActuatorEffect,
    DynamicsEffect,
    EffectParameter,
    Forces,
    MeasuredCurve,
    ObservationEffect,
    confusable_effects,
)
from tests.helpers.recorded_drives import PERIOD_S, drive

CAR = SimulatorConfig(control_period_s=PERIOD_S)
THROTTLE_EFFECTS = ("throttle_nonlinearity", "throttle_asymmetry")
SIDE_EFFECTS = ("lateral_bias", "torque_steer", "steering_offset", "mocap_yaw_misalignment")
SPEEDS_MPS = np.array([0.5, 1.0, 1.5, 2.0])
DRIVEN = np.array([-0.3, 0.1, 0.3, 0.5, 0.8])
"""Throttle commands of the drives."""
NOISE = np.array([2e-3, 2e-3, 4e-3, 2e-2, 2e-2, 5e-2])


def wavy(throttle: FloatArray) -> FloatArray:
    """A throttle map with three bends on each side, which no effect of the catalogue has."""
    return np.asarray(throttle + 0.06 * np.sin(2.0 * np.pi * throttle / 0.25))


class Wave:
    """Texts of physics outside the catalogue."""

    catalogued = False
    summary = "A wave."
    class_statement = "a wave"


class WavyThrottle(Wave, ActuatorEffect):
    """``u = u_t + size sin(2 pi u_t / 0.25)``."""

    id = "wavy_throttle"
    command = "throttle"
    parameters = (EffectParameter("size", "1", 0.0, -1.0, 1.0, 0.06),)

    def apply(self, ops: Ops, command: Value, values: Mapping[str, Value]) -> Value:
        return command + values["size"] * ops.sin(command * (2.0 * np.pi / 0.25))


class WavyMoment(Wave, DynamicsEffect):
    """``M += size sin(2 pi vx / 4 m/s)``."""

    id = "wavy_moment"
    parameters = (EffectParameter("size", "N m", 0.0, -1.0, 1.0, 0.1),)

    def on_body(self, ops: Ops, forces: Forces, values: Mapping[str, Value]) -> None:
        forces.moment = forces.moment + values["size"] * ops.sin(forces.vx * (0.5 * np.pi))


class WavyForce(Wave, DynamicsEffect):
    """``F_y += size cos(pi slip / 0.4 rad)``, slip being that of the front wheels."""

    id = "wavy_force"
    parameters = (EffectParameter("size", "N", 0.0, -5.0, 5.0, 0.5),)

    def on_body(self, ops: Ops, forces: Forces, values: Mapping[str, Value]) -> None:
        slip = ops.atan((forces.vy + forces.front_axle * forces.yaw_rate) / ops.at_least(forces.vx, 0.3))
        wave = ops.cos((slip - forces.wheel_angle) * (np.pi / 0.4))
        forces.force_y = forces.force_y + values["size"] * wave


class WavyHeading(Wave, ObservationEffect):
    """``yaw_meas = yaw + size (1 + sin(2 yaw + 1))``, with velocities in the measured axes."""

    id = "wavy_heading"
    parameters = (EffectParameter("size", "rad", 0.0, -0.3, 0.3, 0.02),)

    def observe(self, ops: Ops, state: tuple[Value, ...], values: Mapping[str, Value]) -> tuple[Value, ...]:
        x, y, yaw, vx, vy, yaw_rate = state
        error = values["size"] * (1.0 + ops.sin(2.0 * yaw + 1.0))
        sin, cos = ops.sin(error), ops.cos(error)
        rate = yaw_rate * (1.0 + 2.0 * values["size"] * ops.cos(2.0 * yaw + 1.0))
        return x, y, yaw + error, cos * vx + sin * vy, cos * vy - sin * vx, rate


def rival_of(
    true: SimulatorConfig, candidates: tuple[str, ...]
) -> tuple[tuple[str, ...], RivalPhysics | None, list[Decision]]:
    """Effects found on a drive of the ``true`` car, the curve that replaces them, and the decisions about it."""
    windows = cut_windows(segments_of([drive(true, 60.0, 1)]), 1.0, 0.5)
    problem = SearchProblem(CAR, windows, NOISE, NOISE, confusable_effects(), candidates, DEFAULT)
    decisions: list[Decision] = []
    found = search(problem, RunControl())
    rival = replacing_curve(problem, found, RunControl(record=decisions.append))
    return found.effects, rival, decisions


def test_throttle_curve_replaces_effects_that_resemble_another_map() -> None:
    with registered(WavyThrottle()):
        names, rival, decisions = rival_of(replace(CAR, effects={"wavy_throttle": {"size": 0.06}}), THROTTLE_EFFECTS)
    assert names
    assert rival is not None
    assert (rival.effect, rival.names) == ("throttle_curve", ())
    assert {(d.effect, d.passed) for d in decisions} == {(name, False) for name in names}
    values = rival.fit.config.values()
    curve = EFFECTS["throttle_curve"]
    assert isinstance(curve, ActuatorEffect)
    gain = values["motor.drive_gain"] / CAR.values()["motor.drive_gain"]
    measured = gain * np.asarray(curve.apply(ARRAYS, DRIVEN, curve.numbers(values)))
    assert np.abs(measured - wavy(DRIVEN)).max() < 0.2 * np.abs(DRIVEN - wavy(DRIVEN)).max()


def test_forces_over_speed_replace_effects_that_turn_the_car_to_one_side() -> None:
    with registered(WavyMoment()):
        names, rival, _ = rival_of(replace(CAR, effects={"wavy_moment": {"size": 0.15}}), SIDE_EFFECTS)
    assert names
    assert rival is not None
    assert (rival.effect, rival.additional, rival.names) == ("side_force_over_speed", ("yaw_moment_over_speed",), ())
    formula = rival.formula()
    assert formula.startswith("side_force_over_speed: at -3 m/s ")
    assert "yaw_moment_over_speed: at -3 m/s " in formula
    curve = EFFECTS["yaw_moment_over_speed"]
    assert isinstance(curve, MeasuredCurve)
    mass_kg = CAR.parameters.mass_kg
    measured = mass_kg * curve.deviation(ARRAYS, (SPEEDS_MPS,), curve.numbers(rival.fit.values()))
    assert measured == pytest.approx(0.15 * np.sin(0.5 * np.pi * SPEEDS_MPS), abs=0.03)


def test_forces_over_slip_replace_effects_that_turn_the_car_to_one_side() -> None:
    with registered(WavyForce()):
        names, rival, _ = rival_of(replace(CAR, effects={"wavy_force": {"size": 1.0}}), SIDE_EFFECTS)
    assert names
    assert rival is not None
    assert (rival.effect, rival.additional, rival.names) == ("side_force_over_slip", ("yaw_moment_over_slip",), ())


def test_error_over_the_heading_replaces_a_yaw_misalignment() -> None:
    with registered(WavyHeading()):
        names, rival, _ = rival_of(replace(CAR, effects={"wavy_heading": {"size": 0.03}}), ("mocap_yaw_misalignment",))
    assert names == ("mocap_yaw_misalignment",)
    assert rival is not None
    assert (rival.effect, rival.names) == ("heading_error", ())
    fitted = {
        name: rival.fit.values()[f"effects.heading_error.{name}"] for name in ("sin_2", "cos_2", "sin_1", "cos_1")
    }
    true = {"sin_2": 0.03 * np.cos(1.0), "cos_2": 0.03 * np.sin(1.0), "sin_1": 0.0, "cos_1": 0.0}
    assert fitted == pytest.approx(true, abs=0.003)


@pytest.mark.parametrize(
    ("effect", "values", "candidates"),
    [
        ("throttle_nonlinearity", {"exponent": 1.4}, THROTTLE_EFFECTS),
        ("throttle_asymmetry", {"gain_ratio": 0.6}, THROTTLE_EFFECTS),
        ("torque_steer", {"coefficient": 0.1}, SIDE_EFFECTS),
        ("lateral_bias", {"force": 1.0}, SIDE_EFFECTS),
        ("steering_offset", {"angle": 0.03}, SIDE_EFFECTS),
        ("mocap_yaw_misalignment", {"angle": 0.05}, SIDE_EFFECTS),
    ],
)
def test_curve_does_not_replace_a_true_effect(
    effect: str, values: dict[str, float], candidates: tuple[str, ...]
) -> None:
    names, rival, decisions = rival_of(replace(CAR, effects={effect: values}), candidates)
    assert names == (effect,)
    assert rival is None
    assert {(d.effect, d.passed) for d in decisions} == {(effect, True)}
