"""Test the measurement model on floats, arrays and tensors: inverse, filter, window, latency, delays."""

import math

import numpy as np
import pytest
import torch

from sim_backends.array_ops import ARRAYS, FLOATS
from sim_backends.car_parameters import MocapParameters, SimulatorConfig
from sim_backends.dynamics.torch_ops import torch_ops
from sim_backends.effects import EFFECTS, ObservationEffect
from sim_backends.measurement import (
    MeasurementModel,
    delay_as_recorded_s,
    filter_velocities,
    filters_velocities,
    is_measurement_parameter,
)

OBSERVATIONS = [e.id for e in EFFECTS.values() if e.kind == "observation"]
STATE = (0.4, -1.2, 2.0, 1.5, -0.2, 0.9)
ALL = {name: {p.name: p.typical for p in EFFECTS[name].parameters} for name in OBSERVATIONS}


def model_of(config, ops=FLOATS, convert=float):
    return MeasurementModel(ops, {k: convert(v) for k, v in config.values().items()}, config.effects)


@pytest.mark.parametrize("name", OBSERVATIONS)
def test_inverse_of_each_observation_effect_recovers_the_state(name):
    for size in (-3.0, 0.0, 1.0, 10.0):
        low, high = EFFECTS[name].parameters[0].low, EFFECTS[name].parameters[0].high
        values = {p.name: min(max(size * p.typical, low), high) for p in EFFECTS[name].parameters}
        model = model_of(SimulatorConfig(effects={name: values}))
        assert model.invert(model.observe(STATE)) == pytest.approx(STATE, rel=1e-12)


@pytest.mark.parametrize("name", OBSERVATIONS)
def test_newtons_inverse_equals_the_closed_form(name):
    effect, values = EFFECTS[name], ALL[name]
    closed = effect.invert(FLOATS, STATE, values)
    assert ObservationEffect.invert(effect, FLOATS, STATE, values) == pytest.approx(closed, rel=1e-11)


def test_newtons_inverse_of_a_rotation_by_90_degrees():
    """The first pivot of the Jacobian is zero."""
    effect = EFFECTS["mocap_yaw_misalignment"]
    measured = effect.observe(FLOATS, STATE, {"angle": math.pi / 2})
    assert ObservationEffect.invert(effect, FLOATS, measured, {"angle": math.pi / 2}) == pytest.approx(STATE, rel=1e-11)


def test_floats_arrays_and_tensors_give_equal_measurements():
    config = SimulatorConfig(effects=ALL)
    trajectory = [tuple(v + 0.1 * k * (i + 1) for i, v in enumerate(STATE)) for k in range(6)]
    settings = {"window_s2": 3e-4, "velocities_before": [(1.0, 0.0, 0.5), (1.2, 0.1, 0.6)]}
    expected = model_of(config).measure(trajectory, 0.03, **settings)

    def batch(states, of):
        return [tuple(of([[v, v]] * 3) for v in state) for state in states]

    tensor = torch.tensor([[0.0] * 2] * 3, dtype=torch.float64)
    for ops, of in (
        (ARRAYS, np.array),
        (torch_ops(tensor), lambda v: torch.tensor(v, dtype=torch.float64)),
    ):
        model = MeasurementModel(ops, {k: of([[v]] * 3) for k, v in config.values().items()}, config.effects)
        before = batch(settings["velocities_before"], of)
        found = model.measure(batch(trajectory, of), 0.03, window_s2=3e-4, velocities_before=before)
        inverted = model.invert(found[0])
        for expected_state, state in zip(expected, found, strict=True):
            for value, row in zip(expected_state, state, strict=True):
                assert np.allclose(np.asarray(row), value, rtol=1e-13)
        assert np.allclose(np.asarray(inverted[0]), model_of(config).invert(expected[0])[0], rtol=1e-12)


@pytest.mark.parametrize("effects", [{}, ALL])
def test_measurements_at_some_ticks_are_those_of_all_ticks(effects):
    model = model_of(SimulatorConfig(effects=effects))
    trajectory = [tuple(v + 0.1 * k**2 * (i + 1) for i, v in enumerate(STATE)) for k in range(6)]
    settings = {"window_s2": 3e-4, "velocities_before": [(1.0, 0.0, 0.5), (1.2, 0.1, 0.6)]}
    every = model.measure(trajectory, 0.03, **settings)
    assert model.measure(trajectory, 0.03, ticks=[0, 2, 5], **settings) == [every[k] for k in (0, 2, 5)]
    assert every[2] != model.observe(trajectory[2])


def test_filter_solves_its_differential_equation():
    """The ramp response is ``t - T (1 - exp(-t / T))``; a time constant of 0 changes nothing."""
    period, lag = 0.02, 0.07
    inputs = [(k * period,) * 3 for k in range(20)]
    for k, output in enumerate(filter_velocities(FLOATS, inputs, period, lag)):
        assert output[0] == pytest.approx(k * period - lag * (1.0 - math.exp(-k * period / lag)), abs=1e-14)
    assert filter_velocities(FLOATS, inputs, period, 0.0) == inputs
    assert filter_velocities(FLOATS, inputs[:1], period, lag, (5.0,) * 3) == [(5.0,) * 3]


def test_window_is_the_mean_of_world_velocities_over_a_box():
    """The reference is the central difference of poses over two ticks, a box window."""
    period = 0.01
    half = period
    t = period * np.arange(-4, 5)

    def pose(t):
        return np.stack([np.sin(2.0 * t), 0.3 * np.cos(1.5 * t), 0.8 * t + 0.2 * np.sin(t)])

    def world(t):
        return np.stack([2.0 * np.cos(2.0 * t), -0.45 * np.sin(1.5 * t), 0.8 + 0.2 * np.cos(t)])

    def body(velocity, yaw):
        c, s = np.cos(yaw), np.sin(yaw)
        return c * velocity[0] + s * velocity[1], c * velocity[1] - s * velocity[0], velocity[2]

    yaw = pose(t)[2]
    mean = (pose(t + half) - pose(t - half)) / (2.0 * half)
    states = [tuple(row) for row in np.column_stack([*pose(t), *body(world(t), yaw)])]
    found = model_of(SimulatorConfig()).measure(states, period, window_s2=(2.0 * half) ** 2 / 12.0)
    expected = np.column_stack(body(mean, yaw))
    assert np.allclose([s[3:] for s in found[1:-1]], expected[1:-1], atol=2e-8)
    assert np.abs(expected - [s[3:] for s in states]).max() > 5e-5
    for end in (0, -1):  # with d2v/dt2 of the neighbour, one tick away
        assert found[end][:3] == states[end][:3]
        error, without = (np.abs(np.array(s[end][3:]) - expected[end]).max() for s in (found, states))
        assert error < 0.2 * without


def test_latency_is_that_of_the_car_file_or_of_an_effect():
    config = SimulatorConfig(mocap=MocapParameters(latency_s=0.01))
    assert model_of(config).latency_s == 0.01
    late = SimulatorConfig(mocap=MocapParameters(latency_s=0.01), effects={"mocap_latency": {"latency": 0.04}})
    assert model_of(late).latency_s == 0.04
    assert model_of(config).velocity_time_constant_s is None


def test_command_delay_relative_to_a_recording_includes_the_latency_and_is_not_negative():
    config = SimulatorConfig(command_delay_s=0.05, effects={"command_delay": {}, "steering_delay": {}})
    values = config.values()
    assert delay_as_recorded_s(FLOATS, values, config.effects, 0.02) == pytest.approx(0.07)
    early = {**values, "effects.command_delay.extra_delay": -0.2}
    assert delay_as_recorded_s(FLOATS, early, config.effects, 0.02) == pytest.approx(0.2)
    several = {**values, "effects.command_delay.extra_delay": np.array([-0.2, 0.0])}
    assert np.allclose(delay_as_recorded_s(ARRAYS, several, config.effects, 0.02), [0.2, 0.07])


def test_measurement_parameters_are_distinguished_from_dynamics_parameters():
    assert is_measurement_parameter("mocap.latency")
    assert is_measurement_parameter("effects.marker_offset.ahead")
    assert not is_measurement_parameter("effects.steering_lag.time_constant")
    assert not is_measurement_parameter("timing.command_delay")


def test_one_effect_of_the_catalogue_filters_velocities():
    assert [name for name in EFFECTS if filters_velocities(name)] == ["velocity_filter_lag"]
