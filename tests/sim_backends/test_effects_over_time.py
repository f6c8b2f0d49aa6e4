"""Test effects over time: hidden states, the time since the first row, order of effects, measured states."""

import numpy as np
import pytest
import torch

from carlab.core.errors import DataError
from sim_backends.batch.rollout import rollout
from sim_backends.car_parameters import SimulatorConfig
from sim_backends.effects import EFFECTS
from sim_backends.plant import Plant
from tests.helpers.effect_inputs import NAMES, past, some, typical
from tests.helpers.measured_rollout import measured_rollout


@pytest.mark.parametrize("name", NAMES)
def test_rollout_with_history_continues_a_longer_rollout(name):
    """The history determines the hidden states, ``t0_s`` the time."""
    config = SimulatorConfig(effects={name: typical(name)})
    generator = np.random.default_rng(8)
    start = torch.tensor([[0, 0, 0, 2.0, 0, 0], [1, 0, 1, 1.5, 0, 0]], dtype=torch.float64)
    commands = torch.tensor(generator.uniform([-0.6, 0.1], [0.6, 0.6], (2, 45, 2)))
    full = rollout(config, start, commands).states
    half = rollout(
        config,
        full[:, 30],
        commands[:, 30:],
        history=commands[:, :30],
        history_states=full[:, :30],
        t0_s=30 * config.control_period_s,
    ).states
    assert torch.allclose(half, full[:, 30:], rtol=0, atol=2e-3)
    if not {"states", "has_state"} & {k for k in dir(EFFECTS[name]) if getattr(EFFECTS[name], k)}:
        assert torch.allclose(half, full[:, 30:], rtol=0, atol=1e-9)


def test_hidden_states_without_history_are_steady_for_the_initial_velocities():
    """On a steady circle the steady-state hidden states are exact, so a restarted rollout is unchanged."""
    effects = {n: typical(n) for n in ("tyre_relaxation", "roll_dynamics", "longitudinal_slip", "steering_lag")}
    config = SimulatorConfig(effects=effects)
    start = torch.tensor([[0, 0, 0, 1.2, 0, 0]], dtype=torch.float64)
    commands = torch.tensor([0.25, 0.3], dtype=torch.float64).expand(1, 400, 2)
    full = rollout(config, start, commands).states
    restarted = rollout(config, full[:, 360], commands[:, 360:], history=commands[:, :20]).states
    assert torch.allclose(restarted, full[:, 360:], rtol=0, atol=1e-4)


def test_time_dependent_effects_use_the_time_since_the_first_row():
    start, commands = some(cars=1)
    for name, rate in (("battery_sag", 0.01), ("friction_drift", -0.01)):
        config = SimulatorConfig(effects={name: {"rate": rate}})
        late = rollout(config, start, commands, t0_s=30.0).states
        scale = (
            {"motor.drive_gain": 8.2 * 0.7}
            if name == "battery_sag"
            else {"tyre.front.mu": 0.43 * 0.7, "tyre.rear.mu": 0.42 * 0.7}
        )
        about = rollout(SimulatorConfig().with_values(scale), start, commands).states
        early = rollout(config, start, commands).states
        assert (late - about).abs().max() < 0.1 * (early - about).abs().max()
    shifted = rollout(config, start, commands, t0_s=torch.tensor(30.0, dtype=torch.float64)).states
    assert torch.equal(shifted, late)
    with pytest.raises(DataError, match="t0_s"):
        rollout(config, start, commands, t0_s=torch.zeros(3))
    with pytest.raises(DataError, match="history_states"):
        rollout(config, start, commands, history=past(1), history_states=torch.zeros(1, 3, 6))


def test_result_does_not_depend_on_the_listed_order_of_effects():
    """All effects together give finite states from standstill and in reverse."""
    all_effects = {n: typical(n) for n in NAMES}
    backwards = dict(reversed(all_effects.items()))
    start, commands = some()
    start[0], start[1, 3] = 0.0, -1.5
    one, other = (measured_rollout(SimulatorConfig(effects=e), start, commands) for e in (all_effects, backwards))
    assert torch.allclose(one.states, other.states, rtol=0, atol=1e-9)
    assert torch.allclose(one.measured, other.measured, rtol=0, atol=1e-9)
    assert torch.isfinite(one.measured).all()


def test_yaw_misalignment_changes_only_measured_states():
    angle = 0.05
    start, commands = some()
    config = SimulatorConfig(
        effects={"mocap_latency": {"latency": 0.0}, "mocap_yaw_misalignment": {"angle": angle}, "marker_offset": {}}
    )
    out = measured_rollout(config, start, commands)
    true, measured = out.states, out.measured
    assert torch.allclose(measured[..., 2], true[..., 2] + angle)
    assert torch.allclose(measured[..., :2], true[..., :2])
    # The velocity in the world frame is unchanged.
    for states in (true, measured):
        states_vx = states[..., 3] * torch.cos(states[..., 2]) - states[..., 4] * torch.sin(states[..., 2])
        assert torch.allclose(
            states_vx, true[..., 3] * torch.cos(true[..., 2]) - true[..., 4] * torch.sin(true[..., 2])
        )
    small = torch.stack([true[..., 3] + angle * true[..., 4], true[..., 4] - angle * true[..., 3]], dim=-1)
    assert (measured[..., 3:5] - small).abs().max() < angle**2 * 3
    plant = Plant(SimulatorConfig(effects={"mocap_yaw_misalignment": {"angle": angle}}))
    assert plant.measured_pose(0.0).yaw_rad == pytest.approx(angle)
