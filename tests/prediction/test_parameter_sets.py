"""Simulations of several parameter sets on the same windows."""

import numpy as np

from carlab.prediction.predict import simulate_windows
from carlab.prediction.windows import cut_windows, segments_of
from sim_backends import SimulatorConfig
from tests.helpers.recorded_drives import drive


def test_prediction_of_a_set_does_not_depend_on_the_other_sets():
    windows = cut_windows(segments_of([drive(SimulatorConfig(), 10.0, 3)]), 1.0, 0.5)
    values = {
        "timing.command_delay": np.array([0.03, 0.047, 0.08]),
        "effects.throttle_delay.delay": np.array([0.0, 0.021, 0.01]),
        "effects.steering_lag.time_constant": np.array([0.05, 0.0, 0.1]),
        "effects.tyre_relaxation.length": np.array([0.2, 0.1, 0.0]),
    }
    together = simulate_windows(windows, SimulatorConfig(), values, max_step_s=0.01)
    for k in range(3):
        alone = simulate_windows(windows, SimulatorConfig(), {n: v[k] for n, v in values.items()}, max_step_s=0.01)
        assert np.array_equal(alone[0], together[k])
        by_windows = {name: np.full((1, len(windows)), value[k]) for name, value in values.items()}
        repeated = simulate_windows(windows, SimulatorConfig(), by_windows, max_step_s=0.01)
        assert np.allclose(repeated[0], together[k], atol=2e-5)
