"""Sizes at which candidates are screened."""

import numpy as np
import pytest

from carlab.diagnosis.identification.error_scale import Scale
from carlab.diagnosis.identification.fit import Fitter
from carlab.diagnosis.identification.fit_parameters import effect_parameters, with_effect
from carlab.diagnosis.selection.screening import Screen, size_of_change
from carlab.diagnosis.settings import SCREENING
from carlab.prediction.windows import cut_windows, segments_of
from sim_backends import SimulatorConfig
from tests.helpers.recorded_drives import PERIOD_S, drive

WANTED = SCREENING.error_rms_changes
EXPONENTS = SCREENING.probe_exponents


@pytest.mark.parametrize("exponent", [0.5, 1.0, 2.0])
def test_size_of_a_power_law_is_exact(exponent: float) -> None:
    sizes, wanted = np.array([0.03, 0.3, 3.0]), np.array([1e-4, 0.2, 40.0])
    found = size_of_change(wanted, sizes, 0.7 * sizes**exponent, EXPONENTS)
    assert found == pytest.approx((wanted / 0.7) ** (1.0 / exponent))


def test_size_of_a_threshold_lies_above_the_sizes_without_a_change() -> None:
    [found] = size_of_change(np.array([0.5]), np.array([0.03, 0.3, 3.0]), np.array([0.0, 0.0, 2.0]), EXPONENTS)
    assert 0.3 < found < 3.0


def test_size_is_finite_for_effects_without_a_change_and_for_equal_sizes_at_a_bound() -> None:
    for sizes, changes in (([0.03, 0.3, 3.0], [0.0, 0.0, 0.0]), ([0.03, 0.3, 0.3], [0.02, 0.2, 0.2])):
        found = size_of_change(np.array(WANTED), np.array(sizes), np.array(changes), EXPONENTS)
        assert np.isfinite(found).all()
        assert (np.diff(found) >= 0.0).all()


def test_size_of_falling_changes_is_that_of_the_first_larger_change() -> None:
    """A simulation that diverges is clipped, so a larger size may change the errors less."""
    [found] = size_of_change(np.array([0.2]), np.array([0.03, 0.3, 3.0]), np.array([0.02, 0.2, 0.1]), EXPONENTS)
    assert found == pytest.approx(0.3)


@pytest.fixture(scope="module")
def screen() -> Screen:
    car = SimulatorConfig(control_period_s=PERIOD_S)
    windows = cut_windows(segments_of([drive(car, 30.0, 5)]), 0.8, 0.5)
    fitter = Fitter(windows, Scale(np.array([8, 16, 24]), np.full((3, 6), 0.004)))
    return Screen(fitter, car, fitter.fit(car, ()))


@pytest.mark.parametrize("effect", ["friction_ellipse", "aerodynamic_drag", "load_transfer", "steering_offset"])
def test_points_change_the_errors_as_wanted(screen: Screen, effect: str) -> None:
    """The ellipse changes the errors with the square of its size, the others in proportion to it."""
    free = effect_parameters(effect, screen.config)
    points = screen.points(effect, free)
    white = screen.fitter.white(with_effect(screen.config, effect), free, points)
    limit = SCREENING.max_whitened_change
    change = np.sqrt(np.mean((white - screen.white.reshape(white.shape[1:])).clip(-limit, limit) ** 2, axis=(1, 2, 3)))
    expected = np.resize(WANTED, len(points))
    assert np.abs(np.log(change / expected)).max() < np.log(2.5)
