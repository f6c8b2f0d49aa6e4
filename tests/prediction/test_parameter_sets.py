"""Simulations of several parameter sets on the same windows."""

from dataclasses import replace

import numpy as np
import pytest

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


def test_sets_with_equal_delays_keep_their_other_parameters():
    windows = cut_windows(segments_of([drive(SimulatorConfig(), 10.0, 3)]), 1.0, 0.5)
    values = {
        "timing.command_delay": np.array([0.03, 0.08, 0.03, 0.08, 0.03]),
        "motor.drive_gain": np.array([7.0, 7.5, 8.0, 8.5, 9.0]),
        "effects.tyre_relaxation.length": np.array([0.2, 0.1, 0.0, 0.1, 0.2]),
        "effects.mocap_yaw_misalignment.angle": np.array([0.0, 0.1, 0.0, -0.1, 0.05]),
    }
    together = simulate_windows(windows, SimulatorConfig(), values, max_step_s=0.01)
    alone = [
        simulate_windows(windows, SimulatorConfig(), {n: v[k] for n, v in values.items()}, max_step_s=0.01)[0]
        for k in range(5)
    ]
    assert np.array_equal(together, alone)


@pytest.mark.parametrize("window_s2", [0.0, 4e-4])
@pytest.mark.parametrize("effects", [{}, {"velocity_filter_lag": {"time_constant": 0.05}}])
def test_predictions_at_some_ticks_are_those_of_all_ticks(window_s2, effects):
    windows = cut_windows(segments_of([drive(SimulatorConfig(), 10.0, 3)]), 1.0, 0.5)
    windows = replace(windows, velocity_window_s2=window_s2)
    config = SimulatorConfig(effects=effects)
    values = {"motor.drive_gain": np.array([7.0, 8.0])}
    every = simulate_windows(windows, config, values)
    for ticks in ([0, 1], [7], [5, 13, windows.steps]):
        assert np.array_equal(simulate_windows(windows, config, values, ticks=np.array(ticks)), every[:, :, ticks])


@pytest.mark.parametrize(
    ("effects", "tolerance"),
    [({}, 2e-6), ({"low_friction_patch": {"x": 0.0, "y": 0.0, "radius": 1.0, "loss": 0.5}}, 2e-4)],
)
def test_predictions_far_from_the_origin_are_those_near_it_moved(effects, tolerance):
    """14 turns and 90 m away, in 32 bits; the patch of low friction moves with the car."""
    near = cut_windows(segments_of([drive(SimulatorConfig(), 10.0, 3)]), 1.0, 0.5)
    shift = np.array([90.0, -80.0, 28.0 * np.pi, 0.0, 0.0, 0.0])
    far = replace(near, initial_states=near.initial_states + shift, past_states=near.past_states + shift)
    moved = {name: {**own, "x": shift[0], "y": shift[1]} for name, own in effects.items()}
    expected = simulate_windows(near, SimulatorConfig(effects=effects), in_double=True) + shift
    found = simulate_windows(far, SimulatorConfig(effects=moved))
    assert np.abs(found - expected).max() < tolerance
