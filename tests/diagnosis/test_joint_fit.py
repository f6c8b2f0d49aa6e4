"""Joint fit of parameters and initial states, against scipy and against true parameters."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares

from carlab.core.quantities import FloatArray
from carlab.diagnosis.identification.error_scale import Scale
from carlab.diagnosis.identification.fit import Fit, Fitter
from carlab.diagnosis.identification.fit_parameters import base_parameters, effect_parameters, with_effect
from carlab.diagnosis.identification.joint_fit import joint_fit
from carlab.diagnosis.settings import IDENTIFICATION
from carlab.prediction.errors import prediction_errors
from carlab.prediction.predict import simulate_windows
from carlab.prediction.windows import PredictionWindows, cut_windows, segments_of
from sim_backends import SimulatorConfig
from sim_backends.car_parameters import MocapParameters
from tests.helpers.recorded_drives import PERIOD_S, drive

CAR = SimulatorConfig(control_period_s=PERIOD_S, mocap=MocapParameters(latency_s=0.0))
LAG = "steering_lag"
TRUE = replace(CAR, effects={LAG: {"time_constant": 0.05}})
STD = 3e-4 * np.array([1.0, 1.0, 2.0, 20.0, 20.0, 40.0])
SCALE = Scale(np.array([8, 16, 24]), np.tile(10.0 * STD, (3, 1)))


def fitted(windows: PredictionWindows, config: SimulatorConfig = CAR) -> tuple[Fitter, Fit]:
    """A fit of the steering lag with estimated initial states."""
    fitter = Fitter(windows, SCALE)
    return fitter, fitter.fit(with_effect(config, LAG), effect_parameters(LAG, config))


def by_scipy(windows: PredictionWindows, fit: Fit) -> float:
    """Coordinate of the least-squares fit of the lag and all initial states by scipy, from the same start."""
    units = np.tile(STD, len(windows))

    def errors(point: FloatArray) -> FloatArray:
        states = windows.initial_states + (units * point[1:]).reshape(-1, 6)
        values = {f.name: np.atleast_1d(f.value(point[:1])) for f in fit.free}
        predicted = simulate_windows(replace(windows, initial_states=states), fit.config, values)
        return np.asarray((prediction_errors(predicted, windows)[0, :, 1:] / STD).ravel())

    def jacobian(point: FloatArray) -> FloatArray:
        at, steps = errors(point), 1e-2 * np.eye(len(point))
        return np.stack([(errors(point + step) - at) / 1e-2 for step in steps], axis=1)

    start = np.concatenate([fit.z, np.zeros(6 * len(windows))])
    return float(least_squares(errors, start, jac=jacobian, method="lm", xtol=1e-10).x[0])


def change_settings(monkeypatch: pytest.MonkeyPatch, **values: float) -> None:
    for module in ("error_scale", "joint_fit"):
        monkeypatch.setattr(
            f"carlab.diagnosis.identification.{module}.IDENTIFICATION", replace(IDENTIFICATION, **values)
        )


def test_joint_fit_is_the_least_squares_fit_of_scipy(monkeypatch: pytest.MonkeyPatch) -> None:
    windows = cut_windows(segments_of([drive(TRUE, 8.0, 3)]), 0.8, 2.0)
    fitter, start = fitted(windows)
    start = replace(start, z=start.z - 0.1)
    change_settings(monkeypatch, huber_delta=1e6, joint_max_noise_ratio=9.0)
    found = joint_fit(fitter, start, STD)
    assert found is not None
    assert found.covariance is not None
    std = math.sqrt(found.covariance[0, 0])
    expected = by_scipy(windows, start)
    assert abs(found.z[0] - expected) < 0.1 * std
    assert abs(start.z[0] - expected) > 5.0 * std


def test_joint_fit_holds_a_parameter_at_its_bound(monkeypatch: pytest.MonkeyPatch) -> None:
    """The true lag is 0.05 s, and a car file that states 0.2 s allows at least 0.1 s."""
    windows = cut_windows(segments_of([drive(TRUE, 8.0, 3)]), 0.8, 2.0)
    fitter, start = fitted(windows)
    lag = replace(start.free[0], low=0.1)
    others = tuple(f for f in base_parameters(CAR) if f.name.startswith("motor."))
    start = fitter.fit(start.config, (lag, *others), np.array([lag.coordinate(0.15), 0.0, 0.0]))
    change_settings(monkeypatch, joint_max_noise_ratio=math.inf)
    found = joint_fit(fitter, replace(start, z=start.z + np.array([0.5, 0.0, 0.0])), STD)
    assert found is not None
    assert found.covariance is not None
    assert found.z[0] == lag.coordinate(0.1)
    assert not found.covariance[0, 1:].any()
    assert found.covariance[0, 0] > 0.0


@pytest.fixture(scope="module")
def estimates() -> list[tuple[Fit, Fit]]:
    """Fits with estimated and with free initial states, of eight drives of one car."""
    found = []
    for seed in range(8):
        fitter, start = fitted(cut_windows(segments_of([drive(TRUE, 20.0, 10 + seed)]), 0.8, 0.5))
        joint = joint_fit(fitter, start, STD)
        assert joint is not None
        found.append((fitter.with_covariance(start), joint))
    return found


def test_free_initial_states_remove_most_of_the_error_of_a_lag(estimates: list[tuple[Fit, Fit]]) -> None:
    name = f"effects.{LAG}.time_constant"
    errors = np.array([[fit.values()[name] - 0.05 for fit in pair] for pair in estimates])
    before, after = np.sqrt(np.mean(errors**2, axis=0))
    assert after < 0.4 * before
    assert after < 5e-4


def test_standard_errors_are_those_of_repeated_drives(estimates: list[tuple[Fit, Fit]]) -> None:
    """The mean square of eight standardised errors is between the 0.1 % quantiles of a chi-square, widened by 1.5."""
    [parameter] = effect_parameters(LAG, CAR)
    true = parameter.coordinate(0.05)
    standardised = []
    for _, fit in estimates:
        assert fit.covariance is not None
        standardised.append((fit.z[0] - true) / math.sqrt(fit.covariance[0, 0]))
    assert 0.86 / 8 / 1.5 < np.mean(np.square(standardised)) < 1.5 * 26.1 / 8


def test_simulator_that_lacks_physics_is_not_refined() -> None:
    """Free initial states would hide a part of the error of a simulator without the drag of the true car."""
    true = replace(TRUE, effects={**TRUE.effects, "aerodynamic_drag": {"coefficient": 0.6}})
    fitter, start = fitted(cut_windows(segments_of([drive(true, 20.0, 3)]), 0.8, 0.5))
    assert joint_fit(fitter, start, STD) is None
