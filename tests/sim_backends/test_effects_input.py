"""Test input effects of the actuator chain by closed forms, explicit trajectories and scipy."""

import itertools
import math

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

from sim_backends.array_ops import FLOATS
from sim_backends.batch.rollout import rollout
from sim_backends.car_parameters import SimulatorConfig
from sim_backends.dynamics.actuators import ActuatorChain
from sim_backends.effects import EFFECTS
from sim_backends.effects.first_order import lag_weights

MAX_ANGLE = 0.6


def chain(effects):
    config = SimulatorConfig(effects=effects)
    return ActuatorChain(FLOATS, config.values(), config.effects)


def angles(effects, commands, step_s=0.01, start=0.0):
    """Return the wheel angle after each step of ``step_s`` with held steering."""
    one = chain(effects)
    memory, found = one.settled((start, 0.0)), []
    for command in commands:
        (signal, _), memory = one.step((command, 0.0), memory, step_s)
        found.append(signal[2])
    return found


def angle(effects, steering):
    return chain(effects).settled_output((steering, 0.0))[0]


def throttle(effects, command):
    return chain(effects).settled_output((0.0, command))[1]


def test_rate_limit_takes_the_time_of_its_ramp():
    for rate in (0.5, 3.0, 17.0):
        found = angles({"steering_rate_limit": {"rate": rate}}, [1.0] * 300, start=-1.0)
        expected = np.minimum(-MAX_ANGLE + rate * 0.01 * np.arange(1, 301), MAX_ANGLE)
        assert np.allclose(found, expected, atol=1e-12)


@pytest.mark.parametrize("name", ["steering_lag", "steering_rate_limit"])
@pytest.mark.parametrize("strength", [0.1, 0.5, 1.0, 3.0, 20.0, 1000.0])
def test_mean_over_a_step_is_accurate_for_each_servo_speed(name, strength):
    """Simpson's rule over start, middle and end, as in Runge-Kutta; ``strength`` is the rate per step."""
    step_s, jump = 0.01, 0.6
    effects = {
        "steering_lag": {"steering_lag": {"time_constant": step_s / strength}},
        "steering_rate_limit": {"steering_rate_limit": {"rate": strength * jump / step_s}},
    }[name]
    one = chain(effects)
    ((start, middle, end), _), _ = one.step((1.0, 0.0), one.settled((0.0, 0.0)), step_s)
    t = np.linspace(0.0, 1.0, 200_001)
    exact = 1 - np.exp(-strength * t) if name == "steering_lag" else np.minimum(strength * t, 1.0)
    mean = (start + 4 * middle + end) / 6 / jump
    assert mean == pytest.approx(np.trapezoid(exact, t), abs=1e-5 if name == "steering_lag" else 0.09)


def test_backlash_is_the_play_operator_written_out():
    play = 0.2
    commanded = [0.05, 0.3, 0.25, 0.15, 0.05, 0.0, 0.1, 0.2, 0.3, -0.4, -0.2, -0.2]
    # The wheel starts at 0 and moves when the command exceeds the play of 0.1.
    expected = [0.0, 0.2, 0.2, 0.2, 0.15, 0.1, 0.1, 0.1, 0.2, -0.3, -0.3, -0.3]
    found = angles({"steering_backlash": {"play": play}}, [c / MAX_ANGLE for c in commanded])
    assert found == pytest.approx(expected, abs=1e-12)


def test_backlash_is_rate_independent():
    """Backlash is rate independent: a slow sweep and jumps to the same turning points end equally."""
    effects = {"steering_backlash": {"play": 0.15}}
    turning = [0.0, 0.9, -0.3, 0.5, 0.45]
    slow = [v for a, b in itertools.pairwise(turning) for v in np.linspace(a, b, 40)[1:]]
    assert angles(effects, slow)[-1] == pytest.approx(angles(effects, turning[1:])[-1], abs=1e-12)


def test_static_steering_effects_have_their_closed_forms():
    for u in (-1.0, -0.3, -0.02, 0.0, 0.02, 0.3, 1.0):
        d = MAX_ANGLE * u
        assert angle({"steering_deadband": {"width": 0.1}}, u) == pytest.approx(d - max(min(d, 0.05), -0.05))
        assert angle({"steering_offset": {"angle": -0.03}}, u) == pytest.approx(d - 0.03)
        assert angle({"steering_trim": {"angle": 0.02}}, u) == pytest.approx(d + 0.02)
        assert angle({"steering_asymmetry": {"gain": 0.2}}, u) == pytest.approx(d * (1 + 0.2 * np.sign(d)))
        assert angle({"steering_nonlinearity": {"saturation": 0.4}}, u) == pytest.approx(0.4 * math.tanh(d / 0.4))


def test_static_throttle_effects_have_their_closed_forms():
    for u in (-1.0, -0.3, -0.02, 0.0, 0.02, 0.3, 1.0):
        size = abs(u)
        expected = np.sign(u) * max(size - 0.1, 0) / 0.9
        assert throttle({"throttle_deadband": {"width": 0.1}}, u) == pytest.approx(expected)
        expected = u if u > 0 else 0.6 * u
        assert throttle({"throttle_asymmetry": {"gain_ratio": 0.6}}, u) == pytest.approx(expected)
        for exponent in (0.5, 1.3, 2.0):
            found = throttle({"throttle_nonlinearity": {"exponent": exponent}}, u)
            assert found == pytest.approx(np.sign(u) * size**exponent)
        for exponent, share in ((0.5, 0.0), (1.0, 0.0), (2.2, 0.6), (3.0, 1.0), (4.5, 1.0)):
            found = throttle({"throttle_nonlinearity": {"exponent": exponent, "curve": "expo"}}, u)
            assert found == pytest.approx(np.polyval([share, 0.0, 1.0 - share, 0.0], u))


def test_effects_act_in_the_documented_order():
    """Steering: dead band, rate limit, lag, backlash, asymmetry, nonlinearity, offset."""
    numbers = {
        "steering_offset": {"angle": 0.04},
        "steering_nonlinearity": {"saturation": 0.5},
        "steering_asymmetry": {"gain": -0.2},
        "steering_deadband": {"width": 0.08},
    }
    d = 0.5 * MAX_ANGLE - 0.04
    assert angle(numbers, 0.5) == pytest.approx(0.5 * math.tanh(d * 0.8 / 0.5) + 0.04)
    # A limited ramp of 2 rad/s into a lag of 0.1 s and a play of 0.1 rad.
    with_memory = {
        "steering_backlash": {"play": 0.1},
        "steering_lag": {"time_constant": 0.1},
        "steering_rate_limit": {"rate": 2.0},
    }
    found = angles(with_memory, [1.0] * 60)
    t = 0.01 * np.arange(1, 61)
    servo = solve_ivp(
        lambda t, y: (min(2.0 * t, MAX_ANGLE) - y) / 0.1,
        (0, 0.6),
        [0.0],
        t_eval=t,
        rtol=1e-9,
        atol=1e-12,
        max_step=0.01,
    ).y[0]
    assert np.allclose(found, np.maximum(servo - 0.05, 0.0), atol=2e-3)


def test_static_throttle_effects_act_before_the_lag_of_the_motor():
    """Throttle: dead band, nonlinearity, asymmetry, lag."""
    numbers = {
        "motor_lag": {"time_constant": 0.1},
        "throttle_asymmetry": {"gain_ratio": 0.5},
        "throttle_nonlinearity": {"exponent": 2.0},
        "throttle_deadband": {"width": 0.2},
    }
    one = chain(numbers)
    memory = one.settled((0.0, 0.0))
    motor = 0.0
    for command, static in [(0.6, 0.25)] * 30 + [(-0.6, -0.125)] * 10:
        (_, signal), memory = one.step((0.0, command), memory, 0.01)
        motor = static + (motor - static) * math.exp(-0.1)  # closed form of the lag over 0.01 s
        assert signal[2] == pytest.approx(motor, abs=1e-12)


def test_throttle_delay_moves_the_drive_alone():
    """After a step of both commands the car steers at the same time and accelerates later by the delay."""
    period_s = 0.01
    start = torch.tensor([[0, 0, 0, 1.0, 0, 0]], dtype=torch.float64)
    commands = torch.zeros(1, 30, 2, dtype=torch.float64)
    commands[:, 5:, 1] = 0.5
    late = rollout(
        SimulatorConfig(control_period_s=period_s, effects={"throttle_delay": {"delay": 0.05}}), start, commands
    ).states[0, :, 3]
    p = SimulatorConfig().parameters
    rate = p.damping_nspm / p.mass_kg
    since = np.maximum(np.arange(31) * period_s - 0.05 - 0.08 - 0.05, 0.0)
    t = np.arange(31) * period_s
    expected = np.exp(-rate * t) + p.drive_gain_n * 0.5 / p.damping_nspm * (1 - np.exp(-rate * since))
    assert np.abs(late.numpy() - expected).max() < 1e-8


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_lag_weights_are_exact_from_no_lag_to_a_slow_one(dtype):
    from sim_backends.dynamics.torch_ops import torch_ops

    time_constant = torch.tensor([0.0, 1e-9, 1e-5, 1e-3, 5e-3, 0.02, 0.5, 30.0], dtype=dtype, requires_grad=True)
    weights = lag_weights(torch_ops(time_constant), time_constant, 0.01)
    exact = time_constant.detach().double().clamp_min(1e-300)
    half = 0.005 / exact
    tolerance = 1e-12 if dtype == torch.float64 else 1e-6
    assert torch.allclose(weights.decay.double(), torch.exp(-half), atol=tolerance, rtol=0)
    ramp = torch.where(half > 1e-3, 1 - (1 - torch.exp(-half)) / half, half / 2 - half**2 / 6)
    assert torch.allclose(weights.ramp.double(), ramp, atol=30 * tolerance, rtol=0)
    assert weights.start[-1] == 1.0
    assert (weights.ramp + weights.start).sum().backward() is None
    assert torch.isfinite(time_constant.grad).all()
    # At zero the derivative is that of a small lag: the output of a ramp is delayed by the time constant.
    assert float(time_constant.grad[0]) == pytest.approx(-2 / 0.01 + 6 / 0.01, rel=1e-5)


@pytest.mark.parametrize("name", sorted(n for n, e in EFFECTS.items() if e.kind == "input"))
def test_mirrored_commands_and_effects_give_mirrored_angles(name):
    mirrored = {"steering_offset": -1.0, "steering_asymmetry": -1.0, "steering_trim": -1.0}
    typical = {p.name: p.typical for p in EFFECTS[name].parameters}
    other = {k: v * mirrored.get(name, 1.0) for k, v in typical.items()}
    if name == "steering_curve":
        other = {k: -v for k, v in zip(other, reversed(other.values()), strict=True)}
    rng = np.random.default_rng(0)
    commands = rng.uniform(-1, 1, 60)
    right = angles({name: other}, -commands)
    assert angles({name: typical}, commands) == pytest.approx([-a for a in right], abs=1e-14)


def test_steps_of_many_lengths_in_turn_equal_those_of_a_new_chain():
    effects = {"steering_lag": {"time_constant": 0.05}, "motor_lag": {"time_constant": 0.2}}
    used = chain(effects)
    memory = used.settled((0.1, -0.2))
    for step_s in [0.001 * k for k in range(1, 13)] * 2:
        assert used.step((0.7, 0.4), memory, step_s) == chain(effects).step((0.7, 0.4), memory, step_s)
