"""Test the one-step simulator model with effects against the tick-by-tick simulator."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.stats import cauchy, norm

from carlab.core.episode_data import EpisodeData
from carlab.core.errors import ConfigError
from carlab.core.quantities import Action, CarState
from learning.priors.domain_models import draw_parameters
from learning.priors.simulator_model import CarModel, known_ranges
from learning.transitions import transitions_of, velocity_delay_s
from sim_backends.car_parameters import MocapParameters, SimulatorConfig
from sim_backends.effects import EFFECTS
from sim_backends.plant import Plant
from tests.helpers.measured_rollout import measured_rollout

QUIET = MocapParameters(latency_s=0.0)
HISTORY = 8
TICKS = 90
OBSERVATIONS = ("marker_offset", "mocap_yaw_misalignment", "velocity_filter_lag", "mocap_latency")
POSE_DEPENDENT = {e.id for e in EFFECTS.values() if e.depends_on & {"place", "heading"}}
MASS = {"vehicle.mass": (2.0, 2.0)}


def commands(seed=0):
    rng = np.random.default_rng(seed)
    sent = np.repeat(rng.uniform(-1, 1, size=(TICKS // 6, 2)), 6, axis=0)
    sent[:, 1] = 0.2 + 0.5 * np.abs(sent[:, 1])
    return sent


def true_states(config, sent, substeps=1):
    """Return states (T * substeps + 1, 6) of a drive of the single-car simulator."""
    plant, period = Plant(config), config.control_period_s
    plant.reset(CarState(0.0, 0.0, 0.0, 1.0, 0.0, 0.0), 0.0)
    states = [[0.0, 0.0, 0.0, 1.0, 0.0, 0.0]]
    for tick, (steering, throttle) in enumerate(sent):
        plant.command(tick * period, Action(steering, throttle))
        for k in range(substeps):
            s = plant.advance((tick + (k + 1) / substeps) * period)
            states.append([s.x_m, s.y_m, s.yaw_rad, s.vx_mps, s.vy_mps, s.yaw_rate_radps])
    found = np.array(states)
    found[:, 2] = np.unwrap(found[:, 2])
    return found


def rows_of(states, sent, config, history=HISTORY):
    times = np.arange(len(sent) + 1) * config.control_period_s
    return transitions_of([EpisodeData(times, states, sent, sent, np.zeros(len(sent)))], history)


def typical_parameters(name):
    return {p.name: p.typical for p in EFFECTS[name].parameters if not p.choices and p.name not in ("x", "y")}


def predicted(config, rows, at_s=0.0):
    model = CarModel(config, rows.history, MASS, at_s)
    mass = torch.tensor([[config.values()["vehicle.mass"]]], dtype=torch.float64)
    return model(torch.from_numpy(rows.inputs), mass)[0].numpy()


def error(found, rows, first=3):
    return float(np.sqrt(np.mean((found - rows.targets)[:, first:] ** 2)))


@pytest.mark.parametrize("name", sorted(set(EFFECTS) - set(OBSERVATIONS) - POSE_DEPENDENT))
def test_model_with_an_effect_predicts_rows_of_the_car_with_the_effect(name):
    """The error is much smaller than without the effect, and zero for effects without hidden states."""
    plain = SimulatorConfig(mocap=QUIET)
    config = replace(plain, effects={name: typical_parameters(name)})
    sent = commands()
    states = true_states(config, sent)
    rows = rows_of(states, sent, config)
    late = rows.take(rows.tick > TICKS // 2)
    at_s = float(late.tick.mean()) * config.control_period_s
    right, without = error(predicted(config, late, at_s), late), error(predicted(plain, late), late)
    drifts = name in ("battery_sag", "friction_drift")
    # A row does not hold the earlier motion, on which lagging side forces depend.
    assert right < (0.55 if name == "tyre_relaxation" else 0.35) * without or without < 1e-6
    has_memory = bool(getattr(EFFECTS[name], "states", ())) or getattr(EFFECTS[name], "has_state", False)
    if not has_memory and not drifts:
        assert np.allclose(predicted(config, rows), rows.targets, atol=2e-5)


def test_pose_dependent_effects_are_ignored():
    """The declared pose-dependent effects are exactly those whose measured step depends on position or heading."""
    start = torch.tensor([[0.0, 0.0, 0.0, 1.5, 0.1, 0.4], [0.7, -0.4, 1.1, 1.5, 0.1, 0.4]], dtype=torch.float64)
    sent = torch.tensor([[[0.4, 0.5]]], dtype=torch.float64).expand(2, 1, 2)
    found = set()
    for name in EFFECTS:
        config = SimulatorConfig(mocap=QUIET, effects={name: typical_parameters(name)})
        velocities = measured_rollout(config, start, sent).measured[:, -1, 3:]
        if not torch.allclose(velocities[0], velocities[1], atol=1e-9):
            found.add(name)
    assert found == POSE_DEPENDENT
    sloping = SimulatorConfig(mocap=QUIET, effects={"road_slope": {"angle": 0.05}})
    rows = rows_of(true_states(SimulatorConfig(mocap=QUIET), commands()), commands(), sloping)
    assert np.array_equal(predicted(sloping, rows), predicted(replace(sloping, effects={}), rows))


def motion_capture_measurement(states, ahead, left, angle):
    """Apply marker offset and yaw misalignment to true states by their definitions."""
    x, y, yaw, vx, vy, rate = states.T
    along, across = vx - left * rate, vy + ahead * rate
    px = x + np.cos(yaw) * ahead - np.sin(yaw) * left
    py = y + np.sin(yaw) * ahead + np.cos(yaw) * left
    rotated = [np.cos(angle) * along + np.sin(angle) * across, np.cos(angle) * across - np.sin(angle) * along]
    return np.stack([px, py, yaw + angle, *rotated, rate], axis=1)


def test_model_inverts_and_reapplies_motion_capture_effects():
    offset, angle = {"ahead": 0.06, "left": -0.03}, 0.11
    effects = {"marker_offset": offset, "mocap_yaw_misalignment": {"angle": angle}}
    sent, plain = commands(), SimulatorConfig(mocap=QUIET)
    rows = rows_of(motion_capture_measurement(true_states(plain, sent), **offset, angle=angle), sent, plain)
    config = replace(plain, effects=effects)
    assert np.allclose(predicted(config, rows), rows.targets, atol=2e-5)
    assert error(predicted(plain, rows), rows, 0) > 0.01


def test_batched_observation_draws_equal_single_models():
    """Each draw has its own misalignment, marker offset and filter."""
    effects = {"marker_offset": {}, "mocap_yaw_misalignment": {}, "velocity_filter_lag": {"time_constant": 0.03}}
    ranges = {
        "effects.marker_offset.ahead": (-0.1, 0.1),
        "effects.mocap_yaw_misalignment.angle": (-0.2, 0.2),
        "effects.velocity_filter_lag.time_constant": (0.0, 0.08),
    }
    config = SimulatorConfig(mocap=QUIET, effects=effects)
    rows = rows_of(true_states(replace(config, effects={}), commands()), commands(), config)
    model = CarModel(config, HISTORY, ranges)
    draws = draw_parameters(model, 3, torch.Generator().manual_seed(1)).double()
    together = model(torch.from_numpy(rows.inputs), draws).numpy()
    for k in range(3):
        single = config.with_values(dict(zip(ranges, draws[k].tolist(), strict=True)))
        assert np.allclose(together[k], predicted(single, rows), atol=1e-9)
    assert not np.allclose(together[0], together[1], atol=1e-4)


@pytest.mark.parametrize("as_effect", [True, False])
def test_latency_delays_the_commands_in_the_model(as_effect):
    """A latency of 1.5 periods, from the car file or as an effect, is predicted exactly."""
    plain, sent = SimulatorConfig(mocap=QUIET), commands()
    latency = 1.5 * plain.control_period_s
    states = true_states(plain, sent, substeps=2)
    delayed = np.concatenate([np.repeat(states[:1], 3, axis=0), states])[: len(states)]
    rows = rows_of(delayed[::2], sent, plain)
    late = rows.take(rows.tick > HISTORY + 4)
    effect = {"mocap_latency": {"latency": latency}}
    config = replace(plain, effects=effect) if as_effect else replace(plain, mocap=replace(QUIET, latency_s=latency))
    assert np.allclose(predicted(config, late), late.targets, atol=2e-5)
    assert error(predicted(plain, late), late) > 0.05


def test_model_predicts_filtered_velocities():
    """The reference integrates the first-order velocity filter on a fine grid."""
    plain, sent, lag_s, substeps = SimulatorConfig(mocap=QUIET), commands(), 0.04, 40
    states = true_states(plain, sent, substeps)
    step, filtered = plain.control_period_s / substeps, states.copy()
    for k in range(1, len(states)):
        decay = np.exp(-step / lag_s)
        filtered[k, 3:] = decay * filtered[k - 1, 3:] + (1 - decay) * 0.5 * (states[k - 1, 3:] + states[k, 3:])
    rows = rows_of(filtered[::substeps], sent, plain)
    config = replace(plain, effects={"velocity_filter_lag": {"time_constant": lag_s}})
    assert error(predicted(config, rows), rows) < 0.35 * error(predicted(plain, rows), rows)
    assert error(predicted(config, rows), rows, 0) < 0.35 * error(predicted(plain, rows), rows, 0)


def test_backward_difference_velocities_have_a_delay_of_half_a_period():
    plain, sent = SimulatorConfig(mocap=QUIET), commands()
    states = true_states(plain, sent)
    rate = np.diff(states[:, :3], axis=0) / plain.control_period_s
    sin, cos = np.sin(states[1:, 2]), np.cos(states[1:, 2])
    states[1:, 3:] = np.stack([cos * rate[:, 0] + sin * rate[:, 1], cos * rate[:, 1] - sin * rate[:, 0], rate[:, 2]], 1)
    rows = rows_of(states, sent, plain)
    assert velocity_delay_s(rows, plain.control_period_s) == pytest.approx(plain.control_period_s / 2, rel=0.1)
    exact = rows_of(true_states(plain, sent), sent, plain)
    assert velocity_delay_s(exact, plain.control_period_s) == pytest.approx(0.0, abs=1e-3)
    late = CarModel(plain, HISTORY, MASS, velocity_delay_s=plain.control_period_s / 2)
    mass = torch.tensor([[plain.values()["vehicle.mass"]]], dtype=torch.float64)
    found = late(torch.from_numpy(rows.inputs), mass)[0].numpy()
    assert error(found, rows, 0) < 0.7 * error(predicted(plain, rows), rows, 0)
    along = np.abs(found - rows.targets)[:, 0].mean(), np.abs(predicted(plain, rows) - rows.targets)[:, 0].mean()
    assert along[0] < 0.4 * along[1]


def test_negative_total_delay_is_zero():
    ranges = {"effects.command_delay.extra_delay": (-0.2, -0.1)}
    config = SimulatorConfig(mocap=QUIET, effects={"command_delay": {"extra_delay": -0.05}})
    rows = rows_of(true_states(replace(config, command_delay_s=0.0, effects={}), commands()), commands(), config)
    model = CarModel(config, HISTORY, ranges)
    found = model(torch.from_numpy(rows.inputs), torch.tensor([[-0.15]], dtype=torch.float64))[0].numpy()
    assert np.allclose(found, rows.targets, atol=2e-5)


def test_diagnosed_parameter_has_a_truncated_cauchy_prior():
    """The reference is scipy's Cauchy distribution truncated to the range; without a std the prior is uniform."""
    config = SimulatorConfig(
        effects={"motor_lag": {"time_constant": 0.06}},
        priors={"motor.drive_gain": (6.0, 9.0), "motor.damping": (1.0, 2.0)},
        parameter_std={"motor.drive_gain": 0.3, "effects.motor_lag.time_constant": 0.01, "vehicle.yaw_inertia": 1e-9},
    )
    model = CarModel(config, HISTORY, known_ranges(config))
    shares = np.linspace(0.01, 0.99, 99)
    normal = torch.from_numpy(norm.ppf(shares))[:, None].expand(-1, model.size)
    drawn = dict(zip(model.names, model.parameters(normal).numpy().T, strict=True))
    assert set(drawn) == set(config.parameter_std) | set(config.priors)
    assert np.allclose(drawn["motor.damping"], 1.0 + shares)
    spread = {"motor.drive_gain": (8.2, 0.6, 6.0, 9.0), "effects.motor_lag.time_constant": (0.06, 0.02, 0.0, 0.26)}
    for name, (median, scale, low, high) in spread.items():
        ends = cauchy.cdf([low, high], median, scale)
        assert np.allclose(drawn[name], cauchy.ppf(ends[0] + (ends[1] - ends[0]) * shares, median, scale), rtol=1e-6)
    assert np.ptp(drawn["vehicle.yaw_inertia"]) > 0.02 * 0.06, "no prior is narrower than some percent"


def test_range_of_a_choice_parameter_is_refused():
    config = SimulatorConfig(effects={"traction_limit": {}})
    with pytest.raises(ConfigError, match=r"'effects\.traction_limit\.axle' is one of rear, .*; remove its range"):
        CarModel(config, 3, {"effects.traction_limit.axle": (0.0, 1.0)})
