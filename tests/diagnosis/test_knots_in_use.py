"""Windows that a knot of a measured curve influences, against simulations of all pairs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from carlab.diagnosis.identification.error_scale import Scale
from carlab.diagnosis.identification.fit import Fitter
from carlab.diagnosis.identification.fit_parameters import difference_steps, values_at
from carlab.diagnosis.identification.knots_in_use import influencing_parameters
from carlab.diagnosis.selection.problem import SearchProblem
from carlab.prediction.windows import PredictionWindows, cut_windows, segments_of
from sim_backends import EFFECTS, SimulatorConfig
from sim_backends.array_ops import ARRAYS
from sim_backends.effects import CURVES
from sim_backends.effects.curves import DriveMap, free_knots, report_evaluations
from tests.helpers.recorded_drives import PERIOD_S, drive

CAR = SimulatorConfig(control_period_s=PERIOD_S)
NAMES = ("motor_lag", *(curve.id for curve in CURVES))
FLOOR = np.full(6, 1e-2)


@pytest.fixture(scope="module")
def windows() -> PredictionWindows:
    return cut_windows(segments_of([drive(CAR, 40.0, 3)]), 0.8, 1.0)


def test_jacobian_equals_differences_of_all_windows(windows: PredictionWindows) -> None:
    """Float32 predictions of 1e-6 over a scale of 0.05 and a step of 0.02 have derivatives with errors of 1e-3."""
    problem = SearchProblem(CAR, windows, FLOOR, FLOOR, {}, ())
    free, config = problem.free_parameters(NAMES), problem.config_with(NAMES)
    rng = np.random.default_rng(0)
    z = np.array([0.3 * rng.normal() if "value_" in f.name else 0.1 for f in free])
    last = windows.steps
    fitter = Fitter(windows, Scale(np.array([last // 2, last]), np.full((2, 6), 0.05)))
    white = fitter.white(config, free, z[None])[0]
    found = fitter.jacobian(config, free, z, white)
    steps = difference_steps(free)
    moved = fitter.white(config, free, z + np.diag(steps))
    expected = (moved - white) / steps[:, None, None, None]
    np.testing.assert_allclose(found, expected, atol=0.01)
    influences = influencing_parameters(windows, config, values_at(free, z))
    assert 0.1 < influences.mean() < 0.5
    assert not found[~influences].any()
    of_curves = np.array(["value_" in f.name for f in free])
    assert influences[~of_curves].all()
    assert (np.abs(found[influences & of_curves[:, None]]).max(axis=(1, 2)) > 0.02).mean() > 0.5


def test_coasting_car_uses_the_knots_beside_its_throttle_and_speed(windows: PredictionWindows) -> None:
    """Throttle -0.15 lies between two knots; the speed stays between 0.5 and 1 m/s."""
    some = windows.take(np.arange(3))
    states = np.zeros((3, 6))
    states[:, 3] = 0.9
    commands = np.tile([0.0, -0.15], (3, some.steps, 1))
    past = np.tile([0.0, -0.15], (3, some.past_commands.shape[1], 1))
    some = replace(some, initial_states=states, commands=commands, past_commands=past)
    light = CAR.with_values({"motor.drive_gain": 0.4, "motor.damping": 0.1})
    config = replace(light, effects={"drive_map": {}})
    curve = EFFECTS["drive_map"]
    values = {f"effects.drive_map.{p.name}": np.zeros(1) for p in curve.parameters}
    influences = influencing_parameters(some, config, values)
    throttle, speed = (axis.knots for axis in DriveMap.axes)
    used = {
        (throttle[j], speed[k]) for (j, k), row in zip(free_knots(DriveMap.axes), influences, strict=True) if row[0]
    }
    assert used == {(-0.2, 0.5), (-0.2, 1.0), (-0.1, 0.5), (-0.1, 1.0)}


def test_listener_receives_coordinates_inside_the_block_only() -> None:
    curve, seen = CURVES[1], []
    coefficients = curve.coefficients({p.name: 0.0 for p in curve.parameters})
    with report_evaluations(lambda which, coordinates: seen.append((which.id, *coordinates))):
        curve.deviation(ARRAYS, (0.1,), coefficients)
    curve.deviation(ARRAYS, (0.2,), coefficients)
    assert seen == [(curve.id, 0.1)]


def test_fit_without_free_parameters_has_an_empty_jacobian(windows: PredictionWindows) -> None:
    fitter = Fitter(windows, Scale(np.array([windows.steps]), np.ones((1, 6))))
    jacobian, white = fitter.linearised(fitter.fit(CAR, ()))
    assert jacobian.shape == (0, len(windows), 1, 6)
    assert white.shape == (len(windows), 1, 6)


def test_curve_of_the_car_file_that_is_not_fitted_leaves_the_knots_of_the_others(windows: PredictionWindows) -> None:
    some = windows.take(np.arange(3))
    steering = EFFECTS["steering_curve"]
    values = {f"effects.steering_curve.{p.name}": np.zeros(1) for p in steering.parameters}
    alone, both = (
        influencing_parameters(some, replace(CAR, effects=effects), values)
        for effects in ({"steering_curve": {}}, {"steering_curve": {}, "drive_map": {}})
    )
    assert alone.any()
    np.testing.assert_array_equal(both, alone)
