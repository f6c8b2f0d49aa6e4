"""Test the loss with free initial states, and confusable effects that only this loss distinguishes."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import least_squares

import carlab
from carlab.benchmark.cases.case import make_case
from carlab.diagnosis.explained import explained_loss_share
from carlab.diagnosis.identification.error_scale import Scale, huber
from carlab.diagnosis.identification.fit import Fit
from carlab.diagnosis.identification.free_initial_states import loss_of_free_initial_states
from carlab.diagnosis.identification.held_out_errors import HeldOut
from carlab.diagnosis.identification.measurement_noise import Noise
from carlab.diagnosis.selection.problem import SearchProblem, SearchResult
from carlab.diagnosis.settings import IDENTIFICATION
from carlab.prediction.errors import prediction_errors
from carlab.prediction.predict import simulate_windows
from carlab.prediction.windows import PredictionWindows, cut_windows, segments_of
from sim_backends.car_parameters import SimulatorConfig
from tests.helpers.case_files import car_in, episodes_in, write_case

STD = np.array([1e-3, 1e-3, 2e-3, 0.01, 0.01, 0.03])


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> tuple[SimulatorConfig, PredictionWindows]:
    """Return a car, and 60 windows of its motion with white noise, their initial states wrong by three deviations."""
    folder = write_case(make_case("null", 5, fit_s=40, hold_s=30), tmp_path_factory.mktemp("drive"))
    car = car_in(folder)
    windows = cut_windows(segments_of(episodes_in(folder / "fit.csv")), 0.8, 0.5).thinned(60)
    rng = np.random.default_rng(0)
    motion = simulate_windows(windows, car)[0]
    wrong = windows.initial_states + 3.0 * STD * rng.standard_normal((len(windows), 6))
    return car, replace(windows, measured=motion + STD * rng.standard_normal(motion.shape), initial_states=wrong)


def test_loss_of_the_true_car_follows_the_chi_square_law(
    simulated: tuple[SimulatorConfig, PredictionWindows],
) -> None:
    """Each window has 6 K errors and 6 free numbers. With fixed initial states the loss is many times larger."""
    car, windows = simulated
    loss = loss_of_free_initial_states(windows, car, (), np.zeros((len(windows), 0)), STD, max_error=1e4)
    freedom = len(windows) * (6 * windows.steps - 6)
    assert 2.0 * loss.sum() == pytest.approx(freedom, abs=4.0 * np.sqrt(2.0 * freedom))
    fixed = prediction_errors(simulate_windows(windows, car), windows)[0, :, 1:] / STD
    assert huber(fixed).sum() > 10.0 * loss.sum()


def test_loss_is_the_minimum_over_initial_states(simulated: tuple[SimulatorConfig, PredictionWindows]) -> None:
    """The reference is a minimisation of the simulated loss by scipy, for a car with a wrong drive gain."""
    car, windows = simulated
    wrong = car.with_values({"motor.drive_gain": 0.8 * car.parameters.drive_gain_n})
    for k in (3, 30):
        window = windows.take(np.array([k]))

        def errors_at(shift: np.ndarray, window: PredictionWindows = window) -> np.ndarray:
            moved = replace(window, initial_states=window.initial_states + shift * STD)
            return (prediction_errors(simulate_windows(moved, wrong), window)[0, 0, 1:] / STD).ravel()

        def slopes_at(shift: np.ndarray) -> np.ndarray:
            return np.stack([(errors_at(shift + step) - errors_at(shift)) / 0.1 for step in 0.1 * np.eye(6)], axis=1)

        loss = loss_of_free_initial_states(window, wrong, (), np.zeros((1, 0)), STD, max_error=1e4)[0]
        delta = IDENTIFICATION.huber_delta
        best = least_squares(errors_at, np.zeros(6), slopes_at, loss="huber", f_scale=delta, ftol=1e-6)
        assert best.cost < 0.5 * huber(errors_at(np.zeros(6))).sum()
        assert loss == pytest.approx(best.cost, rel=0.02)


def test_explained_share_is_the_excess_that_the_effects_remove(
    simulated: tuple[SimulatorConfig, PredictionWindows],
) -> None:
    """The refit has a wrong drive gain. Half-way between both gains a quarter of the squared error is left."""
    car, windows = simulated
    held_out = HeldOut(windows, STD, Noise(STD, STD))
    problem = SearchProblem(car, windows, STD, STD, {})

    def fitted(share: float) -> Fit:
        gain = (1.0 - 0.04 * share) * car.parameters.drive_gain_n
        return Fit(car.with_values({"motor.drive_gain": gain}), (), np.zeros(0), 0.0, np.zeros(0))

    for share, expected in ((1.0, 0.0), (0.5, 0.75), (0.0, 1.0)):
        found = SearchResult(fitted(1.0), fitted(share), ("motor_lag",), {}, {}, (), (), Scale(np.ones(1), STD[None]))
        assert explained_loss_share(problem, found, held_out) == pytest.approx(expected, abs=0.03)


@pytest.mark.slow
def test_delay_of_the_throttle_is_no_lag_of_the_motor(tmp_path: Path) -> None:
    """With fixed initial states, a bias of these in hard braking makes a lag as likely as the concealed delay."""
    write_case(make_case("single", 10, effects=("throttle_delay",), excess=3.0, fit_s=60, hold_s=30), tmp_path)
    report = carlab.diagnose(
        tmp_path / "fit.csv",
        tmp_path / "car.toml",
        held_out=tmp_path / "hold.csv",
        effects=("throttle_delay", "motor_lag"),
    )
    found = report.diagnosis.effects[0]
    assert (found.id, found.indistinguishable_from) == ("throttle_delay", ())
