"""Drift of a simulated car between fitted and held-out recordings, and errors that are no drift."""

from dataclasses import replace

import numpy as np
import pytest

from carlab.diagnosis.diagnose import diagnose
from carlab.diagnosis.drift import adapt_to_held_out
from carlab.diagnosis.identification.held_out_errors import HeldOut
from carlab.diagnosis.identification.measurement_noise import estimate_noise
from carlab.diagnosis.report.drift import drift_sentence
from carlab.diagnosis.report.html_page import render_page
from carlab.prediction.windows import cut_windows, segments_of
from sim_backends import SimulatorConfig
from tests.helpers.changing_drives import changing_drive
from tests.helpers.recorded_drives import PERIOD_S, drive

CONFIG = SimulatorConfig(control_period_s=PERIOD_S)
SECONDS = 40.0


def drift_of(fit, held_out, config=CONFIG):
    """Drift of each held-out episode."""
    fit_segments, segments = segments_of(fit), segments_of(held_out)
    windows = cut_windows(segments, 1.0, 0.25)
    noise = estimate_noise(fit_segments, windows.curvature_bias)
    return adapt_to_held_out(config, fit_segments, segments, HeldOut.of(windows, noise, config)).drift


@pytest.fixture(scope="module")
def fitted():
    return drive(CONFIG, SECONDS, 1)


def test_changed_drive_force_and_trim_are_found_with_their_sizes_and_an_unchanged_drive_has_no_drift(fitted):
    changed = changing_drive(CONFIG, SECONDS, 2, lambda t: 0.75, lambda t: 0.04)
    first, second = drift_of([fitted], [changed, drive(CONFIG, SECONDS, 3)])
    assert first.is_drift
    found = {c.quantity: c for c in first.changes}
    assert set(found) == {"drive force", "steering trim"}
    assert found["drive force"].value == pytest.approx(-0.25, abs=0.03)
    assert found["steering trim"].value == pytest.approx(0.04, abs=0.006)
    assert first.time_constant_s >= 100.0
    assert first.adapted_m < 0.3 * first.model_m
    assert min(first.similar_share, second.similar_share) > 0.5
    assert not second.is_drift
    assert second.changes == ()


@pytest.mark.slow
def test_fading_drive_force_has_its_change_along_the_recording(fitted):
    (found,) = drift_of([fitted], [changing_drive(CONFIG, SECONDS, 4, lambda t: 1.0 - 0.009 * t, lambda t: 0.0)])
    assert found.is_drift
    (change,) = found.changes
    assert change.quantity == "drive force"
    assert change.first == pytest.approx(-0.009 * 0.125 * SECONDS, abs=0.04)
    assert change.last == pytest.approx(-0.009 * 0.875 * SECONDS, abs=0.04)


def test_physics_that_the_simulator_lacks_in_all_recordings_is_no_drift():
    """The motor saturates and drag grows with speed, in the fitted and in the held-out recordings."""
    car = replace(CONFIG, effects={"motor_saturation": {"force": 3.0}, "aerodynamic_drag": {"coefficient": 0.3}})
    found = drift_of([drive(car, SECONDS, 5)], [drive(car, SECONDS, 6), drive(car, SECONDS, 7)])
    assert [d.is_drift for d in found] == [False, False]


@pytest.mark.slow
def test_drift_in_states_that_were_not_fitted_may_be_an_error_of_the_model(fitted):
    """A car with three times the drive gain is faster than it ever was in the fitted recording."""
    fast = CONFIG.with_values({"motor.drive_gain": 3.0 * CONFIG.parameters.drive_gain_n})
    (found,) = drift_of([fitted], [drive(fast, 30.0, 9)])
    assert found.is_drift
    assert found.similar_share < 0.5
    sentence = drift_sentence(found, 1.0)
    assert "the car differs from the model" in sentence
    assert "so this is a change of the car or an error of the model in these states" in sentence
    assert "the car differs from the fitted recordings" in drift_sentence(replace(found, similar_share=0.9), 1.0)


def test_diagnosis_states_the_drift_in_its_report(fitted):
    held_out = changing_drive(CONFIG, SECONDS, 8, lambda t: 0.7, lambda t: 0.0)
    outcome = diagnose([fitted], [held_out], CONFIG, effects=(), adapt=True)
    errors = outcome.diagnosis.held_out
    assert errors["adapted"].position_m < 0.4 * errors["refit"].position_m
    assert outcome.figure_data.noise.adaptation is not None
    report = outcome.diagnosis
    assert "In held-out recording 1 the car differs from the fitted recordings. The drive force is" in report.sentence
    (table,) = report.to_dict()["drift"]
    assert table["changes"][0]["value"] == pytest.approx(-0.3, abs=0.04)
    assert len(table["t_s"]) == len(table["mean"]) == len(table["std"])
    page = render_page(outcome.diagnosis, outcome.figure_data)
    assert "Change of the car since the fitted recordings" in page
    without = diagnose([fitted], [held_out], CONFIG, effects=())
    assert without.diagnosis.drift == ()
    assert "adapted" not in without.diagnosis.held_out
    assert np.isclose(without.diagnosis.held_out["refit"].score, errors["refit"].score)
