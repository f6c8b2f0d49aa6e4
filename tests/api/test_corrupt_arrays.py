"""Episodes of arrays with numbers that no recording has."""

from dataclasses import replace

import numpy as np
import pytest

import carlab
from carlab.core.errors import DataError
from carlab.diagnosis.identification.measurement_noise import estimate_noise
from carlab.prediction.windows import segments_of
from sim_backends.car_parameters import SimulatorConfig
from tests.helpers.recorded_drives import drive


@pytest.mark.filterwarnings("error")
def test_rows_with_corrupt_states_are_left_out() -> None:
    clean = drive(SimulatorConfig(), 14.0, 1)
    states = clean.states.copy()
    states[100:130, 0], states[200, 3] = 1e200, -1e200
    found, reference = (carlab.predict(replace(clean, states=each)) for each in (states, clean.states))
    position_m = reference.summary["model"].position_m
    assert found.summary["model"].position_m == pytest.approx(position_m, rel=0.5)


def test_commands_in_degrees_are_refused_with_the_remedy() -> None:
    clean = drive(SimulatorConfig(), 14.0, 1)
    with pytest.raises(DataError, match=r"reach 25 where commands lie in \[-1, 1\]; divide them by the full command"):
        carlab.predict(replace(clean, sent=25.0 * clean.sent / np.abs(clean.sent).max()))


@pytest.mark.filterwarnings("error")
def test_noise_of_a_channel_that_is_constant_but_for_rounding_is_the_minimum() -> None:
    clean = drive(SimulatorConfig(), 14.0, 1)
    states = clean.states.copy()
    states[:, 1] = 1e-200 * np.random.default_rng(0).normal(size=len(states))
    noise = estimate_noise(segments_of([replace(clean, states=states)]), np.zeros((10, 6)))
    assert np.isfinite(noise.measured).all()
