"""A measured throttle curve as a rival of named throttle effects, on drives of a car with a known throttle map."""

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
from sim_backends.effects import ActuatorEffect, EffectParameter, confusable_effects
from tests.helpers.recorded_drives import PERIOD_S, drive

CAR = SimulatorConfig(control_period_s=PERIOD_S)
CANDIDATES = ("throttle_nonlinearity", "throttle_asymmetry")
DRIVEN = np.array([-0.3, 0.1, 0.3, 0.5, 0.8])
"""Throttle commands of the drives."""
NOISE = np.array([2e-3, 2e-3, 4e-3, 2e-2, 2e-2, 5e-2])


def wavy(throttle: FloatArray) -> FloatArray:
    """A throttle map with three bends on each side, which no effect of the catalogue has."""
    return np.asarray(throttle + 0.06 * np.sin(2.0 * np.pi * throttle / 0.25))


class WavyThrottle(ActuatorEffect):
    """``u = u_t + size sin(2 pi u_t / 0.25)``."""

    id = "wavy_throttle"
    catalogued = False
    command = "throttle"
    summary = "The throttle at the motor is a wave over its command."
    class_statement = "a wave"
    parameters = (EffectParameter("size", "1", 0.0, -1.0, 1.0, 0.06),)

    def apply(self, ops: Ops, command: Value, values: Mapping[str, Value]) -> Value:
        return command + values["size"] * ops.sin(command * (2.0 * np.pi / 0.25))


def rival_of(true: SimulatorConfig) -> tuple[tuple[str, ...], RivalPhysics | None, list[Decision]]:
    """Effects found on a drive of the ``true`` car, the curve that replaces them, and the decisions about it."""
    windows = cut_windows(segments_of([drive(true, 60.0, 1)]), 1.0, 0.5)
    problem = SearchProblem(CAR, windows, NOISE, NOISE, confusable_effects(), CANDIDATES, DEFAULT)
    decisions: list[Decision] = []
    found = search(problem, RunControl())
    rival = replacing_curve(problem, found, RunControl(record=decisions.append))
    return found.effects, rival, decisions


def test_throttle_curve_replaces_effects_that_resemble_another_map() -> None:
    with registered(WavyThrottle()):
        names, rival, decisions = rival_of(replace(CAR, effects={"wavy_throttle": {"size": 0.06}}))
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


@pytest.mark.parametrize(
    ("effect", "values"),
    [("throttle_nonlinearity", {"exponent": 1.4}), ("throttle_asymmetry", {"gain_ratio": 0.6})],
)
def test_throttle_curve_does_not_replace_a_true_effect(effect: str, values: dict[str, float]) -> None:
    names, rival, decisions = rival_of(replace(CAR, effects={effect: values}))
    assert names == (effect,)
    assert rival is None
    assert [(d.effect, d.passed) for d in decisions] == [(effect, True)]
