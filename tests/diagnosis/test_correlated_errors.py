"""Test the check of accepted effects with decorrelated errors."""

from dataclasses import replace

import numpy as np
import pytest

from carlab.benchmark.cases.case import make_case
from carlab.core.quantities import FloatArray
from carlab.diagnosis.identification.error_scale import Scale
from carlab.diagnosis.selection.correlated_errors import decorrelating, without_unsupported_effects
from carlab.diagnosis.selection.problem import RunControl, SearchProblem, SearchResult
from carlab.diagnosis.selection.refit import fit_base, fit_with_scale
from carlab.diagnosis.settings import DEFAULT
from carlab.prediction.predict import simulate_windows
from carlab.prediction.windows import PredictionWindows, cut_windows, segments_of
from sim_backends.car_parameters import SimulatorConfig
from tests.helpers.case_files import car_in, episodes_in, write_case

EFFECT = "mocap_yaw_misalignment"
ANGLE, GAIN = f"effects.{EFFECT}.angle", "motor.drive_gain"
NOISE = np.array([0.001, 0.001, 0.002, 0.01, 0.01, 0.03])
"""Standard deviations of the added noise in SI units."""


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> tuple[PredictionWindows, SimulatorConfig]:
    """Windows of a simulated drive, and its true car with the effect at its identity value."""
    folder = write_case(make_case("null", 31, fit_s=60, hold_s=20), tmp_path_factory.mktemp("drive"))
    windows = cut_windows(segments_of(episodes_in(folder / "fit.csv")), DEFAULT.windows.fit_window_s, 0.5, 2.0)
    return windows, replace(car_in(folder), effects={EFFECT: {"angle": 0.0}})


def measured_by(
    drive: tuple[PredictionWindows, SimulatorConfig], angles_rad: FloatArray, gains_n: FloatArray
) -> PredictionWindows:
    """The windows as measured with an angle and a drive gain that are constant in each block of 2 s."""
    windows, car = drive
    block = np.unique(windows.block, return_inverse=True)[1]
    values = {ANGLE: angles_rad[block][None], GAIN: gains_n[block][None]}
    measured = simulate_windows(windows, car, values)[0]
    noise = NOISE * np.random.default_rng(1).standard_normal(measured.shape)
    return replace(windows, measured=measured + noise)


def result(windows: PredictionWindows, car: SimulatorConfig) -> tuple[SearchProblem, SearchResult]:
    """A search that has accepted the effect."""
    problem = SearchProblem(replace(car, effects={}), windows, NOISE, NOISE, {}, (EFFECT,))
    base = fit_base(problem)
    free = problem.free_parameters((EFFECT,))
    best = fit_with_scale(problem, (EFFECT,), np.zeros(len(free)))
    return problem, SearchResult(base.fit, best.fit, (EFFECT,), {}, {}, (), (), best.scale)


def test_an_effect_of_some_blocks_is_removed(drive: tuple[PredictionWindows, SimulatorConfig]) -> None:
    """The angle varies around a small mean, so it is no property of the car."""
    blocks, gain = len(np.unique(drive[0].block)), drive[1].values()[GAIN]
    angles = 0.01 + 0.06 * np.random.default_rng(2).standard_normal(blocks)
    problem, found = result(measured_by(drive, angles, np.full(blocks, gain)), drive[1])
    assert without_unsupported_effects(problem, found, RunControl()).effects == ()


def test_an_effect_of_all_blocks_stays_with_another_error(drive: tuple[PredictionWindows, SimulatorConfig]) -> None:
    """The drive gain varies between blocks: an error of the model, which the effect has not caused."""
    blocks, gain = len(np.unique(drive[0].block)), drive[1].values()[GAIN]
    gains = gain * (1.0 + 0.3 * np.random.default_rng(2).standard_normal(blocks))
    problem, found = result(measured_by(drive, np.full(blocks, 0.03), gains), drive[1])
    assert without_unsupported_effects(problem, found, RunControl()) is found


def test_errors_without_model_error_are_not_tested(drive: tuple[PredictionWindows, SimulatorConfig]) -> None:
    blocks, gain = len(np.unique(drive[0].block)), drive[1].values()[GAIN]
    problem, found = result(measured_by(drive, np.full(blocks, 0.0002), np.full(blocks, gain)), drive[1])
    assert without_unsupported_effects(problem, found, RunControl()) is found


def test_scale_decorrelates_the_errors_of_a_model(drive: tuple[PredictionWindows, SimulatorConfig]) -> None:
    blocks, gain = len(np.unique(drive[0].block)), drive[1].values()[GAIN]
    gains = gain * (1.0 + 0.3 * np.random.default_rng(2).standard_normal(blocks))
    problem, found = result(measured_by(drive, np.zeros(blocks), gains), drive[1])
    scale = decorrelating(problem, found.model)
    errors = problem.fitter(found.scale).linearised(found.best).white
    white = problem.fitter(scale).linearised(found.best).white
    correlation, remaining = (mean_correlation(e.reshape(len(e), -1)) for e in (errors, white))
    assert correlation > 0.2
    assert remaining < 0.5 * correlation


def test_root_is_applied_to_all_errors_of_a_window() -> None:
    rng = np.random.default_rng(0)
    steps, sigma, root = np.array([2, 5]), rng.uniform(0.5, 2.0, (2, 6)), rng.standard_normal((12, 12))
    error = rng.standard_normal((3, 7, 6))
    expected = [root.T @ (e[steps] / sigma).ravel() for e in error]
    np.testing.assert_allclose(Scale(steps, sigma, root).white(error).reshape(3, 12), expected)


def mean_correlation(errors: FloatArray) -> float:
    """Mean size of the correlation of two of the errors (S, D)."""
    size = errors.shape[1]
    return float(np.abs(np.corrcoef(errors.T)[~np.eye(size, dtype=bool)]).mean())
