"""Derivatives of whitened errors, also by the deviations of measured curves at their knots."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from carlab.diagnosis.identification.error_scale import Scale
from carlab.diagnosis.identification.fit import Fitter
from carlab.diagnosis.identification.fit_parameters import difference_steps, effect_parameters, values_at
from carlab.diagnosis.selection.problem import SearchProblem
from carlab.prediction.predict import longest_step_s
from carlab.prediction.windows import PredictionWindows, cut_windows, segments_of
from sim_backends import SimulatorConfig
from sim_backends.effects import CURVES
from sim_backends.effects.curves import DriveMap, free_knots
from tests.helpers.operator_rollout import operator_rollout
from tests.helpers.recorded_drives import PERIOD_S, drive

CAR = SimulatorConfig(control_period_s=PERIOD_S)
NAMES = ("motor_lag", *(curve.id for curve in CURVES))
FLOOR = np.full(6, 1e-2)
TOLERANCE = 0.01
"""Float32 predictions of 1e-6 over a scale of 0.05 and a step of 0.02 have derivatives with errors of 1e-3."""


@pytest.fixture(scope="module")
def windows() -> PredictionWindows:
    return cut_windows(segments_of([drive(CAR, 40.0, 3)]), 0.4, 1.0)


def fitter_of(windows: PredictionWindows) -> Fitter:
    """Errors count in the middle and at the end of each window."""
    return Fitter(windows, Scale(np.array([windows.steps // 2, windows.steps]), np.full((2, 6), 0.05)))


def test_derivatives_equal_differences_by_torch_operators(
    windows: PredictionWindows, monkeypatch: pytest.MonkeyPatch
) -> None:
    problem = SearchProblem(CAR, windows, FLOOR, FLOOR, {}, ())
    free, config = problem.free_parameters(NAMES), problem.config_with(NAMES)
    of_curves = np.array(["value_" in f.name for f in free])
    z = np.where(of_curves, 0.3 * np.random.default_rng(0).normal(size=len(free)), 0.1)
    fitter, steps = fitter_of(windows), difference_steps(free)
    found = fitter.jacobian(config, free, z, fitter.white(config, free, z[None])[0])
    largest = np.abs(found).max(axis=(1, 2, 3))
    chosen = [*np.argsort(largest * of_curves)[-2:], int(np.argmax(largest * ~of_curves))]
    assert largest[chosen].min() > 100.0 * TOLERANCE

    monkeypatch.setattr("carlab.prediction.predict.array_rollout", operator_rollout)
    step_s = longest_step_s(windows, config, values_at(free, z))
    white, *moved = fitter.white(config, free, z + np.array([np.zeros(len(z)), *np.diag(steps)[chosen]]), step_s)
    expected = (np.array(moved) - white) / steps[chosen][:, None, None, None]
    np.testing.assert_allclose(found[chosen], expected, atol=TOLERANCE)


@pytest.mark.parametrize("other", [{}, {"steering_curve": {}}], ids=["alone", "with a curve that is not fitted"])
def test_coasting_car_has_derivatives_at_the_knots_beside_its_throttle_and_speed(
    windows: PredictionWindows, other: dict[str, dict[str, float]]
) -> None:
    """Throttle -0.15 lies between two knots; the speed stays between 0.5 and 1 m/s."""
    some = windows.take(np.arange(3))
    states = np.zeros((3, 6))
    states[:, 3] = 0.9
    commands = np.tile([0.0, -0.15], (3, some.steps, 1))
    past = np.tile([0.0, -0.15], (3, some.past_commands.shape[1], 1))
    some = replace(some, initial_states=states, commands=commands, past_commands=past)
    light = CAR.with_values({"motor.drive_gain": 0.4, "motor.damping": 0.1})
    config = replace(light, effects={"drive_map": {}, **other})
    free, fitter = effect_parameters("drive_map", config), fitter_of(some)
    z = np.zeros(len(free))
    derivatives = fitter.jacobian(config, free, z, fitter.white(config, free, z[None])[0])
    influences = np.abs(derivatives).max(axis=(1, 2, 3)) > TOLERANCE
    throttle, speed = (axis.knots for axis in DriveMap.axes)
    used = {(throttle[j], speed[k]) for (j, k), used in zip(free_knots(DriveMap.axes), influences, strict=True) if used}
    assert used == {(-0.2, 0.5), (-0.2, 1.0), (-0.1, 0.5), (-0.1, 1.0)}


def test_fit_without_free_parameters_has_an_empty_jacobian(windows: PredictionWindows) -> None:
    fitter = Fitter(windows, Scale(np.array([windows.steps]), np.ones((1, 6))))
    jacobian, white = fitter.linearised(fitter.fit(CAR, ()))
    assert jacobian.shape == (0, len(windows), 1, 6)
    assert white.shape == (len(windows), 1, 6)
