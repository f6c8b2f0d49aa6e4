"""Local error model: the Gaussian process against its closed form, and errors that depend on the state."""

from dataclasses import replace

import numpy as np
import pytest

from carlab.prediction.adaptation import adapt, choose_noise
from carlab.prediction.adaptation_settings import ADAPTATION
from carlab.prediction.errors import final_errors
from carlab.prediction.local_error_model import _weights
from carlab.prediction.predict import SimulatorModel
from carlab.prediction.windows import cut_windows, segments_of
from sim_backends import SimulatorConfig
from tests.helpers.recorded_drives import PERIOD_S, drive

CONFIG = SimulatorConfig(control_period_s=PERIOD_S)


def test_weights_give_the_posterior_mean_of_known_windows():
    """With at most ``local_neighbours`` known windows the local process is the whole one."""
    rng = np.random.default_rng(0)
    states, past = rng.normal(size=(5, 7)), rng.normal(size=(25, 7))
    known = rng.uniform(size=(5, 25)) < 0.6
    errors = rng.normal(size=25)

    def kernel(a, b):
        return np.exp(-0.5 * ((a[:, None] - b[None]) ** 2).sum(axis=-1) / ADAPTATION.local_length**2)

    found = _weights(states, past, known) @ errors
    for k in range(5):
        own = past[known[k]]
        total = kernel(own, own) + ADAPTATION.local_noise * np.eye(len(own))
        assert found[k] == pytest.approx(kernel(states[k : k + 1], own)[0] @ np.linalg.solve(total, errors[known[k]]))


def test_no_past_and_distant_states_give_no_correction():
    past = np.zeros((40, 7))
    assert np.all(_weights(np.zeros((1, 7)), past, np.zeros((1, 40), dtype=bool)) == 0.0)
    assert np.all(np.abs(_weights(np.full((1, 7), 20.0), past, np.ones((1, 40), dtype=bool))) < 1e-12)


@pytest.mark.parametrize("with_fitted", [False, True])
def test_errors_that_depend_on_the_state_are_predicted_from_similar_states(with_fitted):
    """The motor saturates and drag grows with speed; the simulator has neither."""
    car = replace(CONFIG, effects={"motor_saturation": {"force": 3.0}, "aerodynamic_drag": {"coefficient": 0.3}})
    fitted, segments = segments_of([drive(car, 60.0, 1)]), segments_of([drive(car, 60.0, 2)])
    model = adapt(CONFIG, segments, choose_noise(CONFIG, fitted), fitted=fitted if with_fitted else ())
    windows = cut_windows(segments, 1.0, 0.25)
    late = windows.take(windows.t0_s > 20.0)
    plain, adapted = (
        float(np.sqrt(np.mean(final_errors(m, late)[:, :2] ** 2))) for m in (SimulatorModel(CONFIG), model)
    )
    assert adapted < (0.5 if with_fitted else 0.65) * plain
