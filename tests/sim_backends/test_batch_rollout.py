"""Test batched rollouts against a reference loop, the single-car plant and finite differences."""

import functools
import math

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

from carlab.core.errors import ConfigError, DataError
from carlab.core.quantities import Action, CarState
from sim_backends.batch.rollout import rollout
from sim_backends.car_parameters import SimulatorConfig
from sim_backends.dynamics.plain_loop import rollout_one_by_one
from sim_backends.effects import EFFECTS
from sim_backends.plant import Plant
from tests.helpers.effect_inputs import ALL_EFFECTS, typical
from tests.helpers.measured_rollout import measured_rollout

LAGS = {
    "steering_lag": {"time_constant": 0.07},
    "motor_lag": {"time_constant": 0.2},
    "steering_delay": {"delay": 0.021},
}
KINDS = ("dynamic", "linear_tyre", "kinematic", "blend")


def some(cars, ticks, seed=0, dtype=torch.float64):
    rng = np.random.default_rng(seed)
    start = rng.uniform(-1, 1, (cars, 6)) * [2, 2, 3, 1, 0.3, 1] + [0, 0, 0, 1.5, 0, 0]
    commands = rng.uniform(-1, 1, (cars, ticks, 2))
    return torch.tensor(start, dtype=dtype), torch.tensor(commands, dtype=dtype)


def by_plant(config, start, commands, history=None, latency_s=None):
    """Run the same simulation with the single-car plant."""
    period_s = config.control_period_s
    plant = Plant(config)
    past = 0 if history is None else len(history)
    plant.reset(CarState(), -past * period_s - 5.0)
    if past:  # carry the actuators through the history, then put the body at the start
        plant.command(-past * period_s - 4.9, Action(*history[0]))  # older commands equal the first row
        for k in range(past):
            plant.command((k - past) * period_s, Action(*history[k]))
        plant.advance(0.0)
    plant._state = (*map(float, start),)
    plant._t_s = plant._start_s = 0.0
    plant._nodes.clear()
    plant._remember()
    states = [np.array(plant._state)]
    for k, command in enumerate(commands):
        plant.command(k * period_s, Action(*command))
        plant.advance((k + 1) * period_s)
        states.append(np.array(plant._state))
    return np.array(states)


def test_agrees_with_the_plain_numpy_loop():
    start, commands = some(5, 30)
    batched = rollout(SimulatorConfig(), start, commands).states
    assert batched.shape == (5, 31, 6)
    assert np.allclose(
        batched.numpy(), rollout_one_by_one(SimulatorConfig(), start.numpy(), commands.numpy()), atol=1e-12
    )


def test_float32_stays_close_to_float64():
    start, commands = some(64, 30)
    exact = rollout(SimulatorConfig(), start, commands).states
    single = rollout(SimulatorConfig(), start.float(), commands.float()).states
    assert single.dtype == torch.float32
    assert (single.double() - exact).abs().max() < 2e-4


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("effects", [{}, LAGS])
def test_agrees_with_the_single_car_path_with_history(kind, effects):
    config = SimulatorConfig(kind=kind, effects=effects)
    start, commands = some(3, 20, seed=4)
    history = torch.tensor(np.random.default_rng(9).uniform(-1, 1, (3, 6, 2)))
    batch = rollout(config, start, commands, history=history).states.numpy()
    for i in range(3):
        one = by_plant(config, start[i].numpy(), commands[i].numpy(), history[i].numpy())
        # Both are RK4 of at most 10 ms but cut their steps at different places.
        assert np.abs(batch[i] - one).max() < 5e-3
    fine = rollout(config, start, commands, history=history, max_step_s=0.0005).states.numpy()
    assert np.abs(fine - batch).max() < 5e-3


def test_batch_equals_single_rollouts_for_each_chunk_size(monkeypatch):
    config = SimulatorConfig(effects={"steering_lag": {"time_constant": 0.05}})
    start, commands = some(9, 12)
    together = rollout(config, start, commands).states
    for i in range(9):
        assert torch.allclose(rollout(config, start[i : i + 1], commands[i : i + 1]).states[0], together[i], atol=1e-13)
    monkeypatch.setattr("sim_backends.batch.rollout.CARS_AT_ONCE", 4)
    assert torch.allclose(rollout(config, start, commands).states, together, atol=1e-13)


def test_compiled_step_agrees_with_operators():
    config = SimulatorConfig(kind="blend", effects={name: typical(name) for name in EFFECTS})
    start, commands = some(7, 12)
    mu = torch.linspace(0.3, 0.5, 7, dtype=torch.float64)
    results = [
        rollout(config, start, commands, values={"tyre.front.mu": mu}, engine=engine).states
        for engine in ("fastest", "operators")
    ]
    assert torch.allclose(*results, atol=1e-11)


def test_per_car_parameters_equal_single_rollouts():
    start, commands = some(4, 15)
    values = {
        "tyre.rear.mu": torch.tensor([0.3, 0.4, 0.5, 0.6], dtype=torch.float64),
        "timing.command_delay": torch.tensor([0.0, 0.0333333333, 0.05, 0.081], dtype=torch.float64),
        "effects.steering_delay.delay": torch.tensor([0.0, 0.01, 0.02, 0.0], dtype=torch.float64),
        "vehicle.mass": 1.8,
    }
    together = rollout(SimulatorConfig(), start, commands, values=values, max_step_s=0.001).states
    for i in range(4):
        car_values = {k: float(v[i]) if isinstance(v, torch.Tensor) else v for k, v in values.items()}
        single = rollout(
            SimulatorConfig().with_values(car_values), start[i : i + 1], commands[i : i + 1], max_step_s=0.001
        )
        assert torch.allclose(single.states[0], together[i], atol=1e-6)


@pytest.mark.parametrize("delay_s", [0.0, 0.005, 1 / 30, 0.05, 0.08, 0.1])
def test_delay_is_exact_between_ticks(delay_s):
    """A straight line with linear dynamics: the step response is that without delay, shifted by the delay."""
    config = SimulatorConfig(command_delay_s=delay_s)
    start = torch.zeros(1, 6, dtype=torch.float64)
    commands = torch.zeros(1, 30, 2, dtype=torch.float64)
    commands[:, 3:, 1] = 0.5
    speed = rollout(config, start, commands).states[0, :, 3].numpy()
    p, period_s = config.parameters, config.control_period_s
    since = np.maximum(np.arange(31) * period_s - 3 * period_s - delay_s, 0.0)
    expected = p.drive_gain_n * 0.5 / p.damping_nspm * (1 - np.exp(-p.damping_nspm / p.mass_kg * since))
    assert np.abs(speed - expected).max() < 1e-8


def test_longer_delay_shifts_the_response_by_the_difference():
    start = torch.zeros(2, 6, dtype=torch.float64)
    commands = torch.zeros(2, 40, 2, dtype=torch.float64)
    commands[:, 2:, 0], commands[:, 2:, 1] = 0.5, 0.3
    delays = torch.tensor([0.05, 0.0573], dtype=torch.float64)
    config = SimulatorConfig(control_period_s=0.0073)
    states = rollout(config, start, commands, values={"timing.command_delay": delays}, max_step_s=0.001).states
    assert torch.allclose(states[1, 1:], states[0, :-1], atol=1e-8)


def test_history_carries_delays_and_lags_over_the_start():
    config = SimulatorConfig(effects={"motor_lag": {"time_constant": 0.1}})
    start, commands = torch.zeros(1, 6, dtype=torch.float64), torch.full((1, 20, 2), 0.3, dtype=torch.float64)
    full = rollout(config, start, commands, max_step_s=0.001).states
    past = torch.cat([torch.zeros(1, 1, 2), commands[:, :10]], dim=1)  # before the first command it was neutral
    second = rollout(config, full[:, 10], commands[:, 10:], history=past, max_step_s=0.001).states
    assert torch.allclose(second, full[:, 10:], atol=1e-10)
    assert not torch.allclose(rollout(config, full[:, 10], commands[:, 10:]).states[:, -1], full[:, -1], atol=1e-3)


def test_no_autograd_graph_without_a_required_gradient():
    start, commands = some(3, 5)
    assert rollout(SimulatorConfig(), start, commands).states.grad_fn is None
    commands.requires_grad_()
    assert rollout(SimulatorConfig(), start, commands).states.grad_fn is not None
    with torch.no_grad():
        assert rollout(SimulatorConfig(), start, commands).states.grad_fn is None


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_gradients_equal_finite_differences_for_each_number(kind):
    config = SimulatorConfig(kind=kind, effects=ALL_EFFECTS)
    start, commands = some(2, 4, seed=7)
    history = torch.tensor(np.random.default_rng(2).uniform(-1, 1, (2, 4, 2)))
    names = [n for n in config.values() if n != "timing.control_period" and not n.startswith("mocap.")]
    numbers = {n: torch.full((2,), config.values()[n], dtype=torch.float64) for n in names}
    inputs = [start, commands, history, *numbers.values()]

    def losses(*tensors):
        states = rollout(
            config,
            tensors[0],
            tensors[1],
            history=tensors[2],
            values=dict(zip(names, tensors[3:], strict=True)),
            max_step_s=0.005,
        ).states
        weights = torch.linspace(0.5, 1.5, 5 * 6, dtype=torch.float64).reshape(5, 6)
        return (states * weights).sum(dim=(1, 2))

    leaves = [t.clone().requires_grad_() for t in inputs]
    losses(*leaves).sum().backward()
    # Each pair of cars in the batch has one entry of one input increased or decreased.
    rng, step = np.random.default_rng(1), 1e-7  # the wheel inertia is 1e-3, so 1e-6 is too coarse
    perturbed = [t[:1].repeat(2 * len(inputs), *[1] * (t.ndim - 1)) for t in inputs]
    places = [int(rng.integers(t[0].numel())) for t in inputs]
    for index, place in enumerate(places):
        perturbed[index][2 * index].view(-1)[place] += step
        perturbed[index][2 * index + 1].view(-1)[place] -= step
    found = losses(*perturbed)
    for index, (leaf, place) in enumerate(zip(leaves, places, strict=True)):
        label = (["start", "commands", "history", *names])[index]
        difference = float(found[2 * index] - found[2 * index + 1]) / (2 * step)
        gradient = 0.0 if leaf.grad is None else float(leaf.grad[0].view(-1)[place])  # a kinematic car has no tyres
        assert gradient == pytest.approx(difference, rel=2e-4, abs=2e-5), label


def test_gradient_by_a_shared_number_is_the_sum_over_cars():
    start, commands = some(3, 8)
    shared = torch.tensor(8.2, dtype=torch.float64, requires_grad=True)
    each = torch.full((3,), 8.2, dtype=torch.float64, requires_grad=True)
    for value in (shared, each):
        rollout(SimulatorConfig(), start, commands, values={"motor.drive_gain": value}).states[:, -1].sum().backward()
    assert float(shared.grad) == pytest.approx(float(each.grad.sum()), rel=1e-12)


@functools.cache
def without_effects(kind):
    """Return the rollout of a car without effects."""
    return measured_rollout(SimulatorConfig(kind=kind), *some(5, 12))


@pytest.mark.parametrize("name", sorted(set(EFFECTS) - {"tyre_saturation"}))  # these kinds have Pacejka tyres already
@pytest.mark.parametrize("kind", ["dynamic", "blend"])
def test_each_effect_of_typical_size_changes_the_measured_states(name, kind):
    """An effect at its identity changes nothing: ``test_effects_everywhere``."""
    (start, commands), plain = some(5, 12), without_effects(kind)
    strong = measured_rollout(SimulatorConfig(kind=kind, effects={name: typical(name)}), start, commands)
    assert (plain.measured - strong.measured).abs().max() > 1e-4
    if EFFECTS[name].kind == "observation":
        assert torch.equal(plain.states, strong.states)


def test_marker_offset_changes_position_and_velocity_consistently():
    """On any path the body velocity of the shifted point is the derivative of its position."""
    config = SimulatorConfig(
        control_period_s=0.001,
        effects={"marker_offset": {"ahead": 0.2, "left": -0.1}, "mocap_latency": {"latency": 0.0}},
    )
    start, _ = some(1, 1)
    commands = torch.full((1, 400, 2), 0.4, dtype=torch.float64)
    measured_states = measured_rollout(config, start, commands).measured[0].numpy()
    world = (measured_states[2:, :2] - measured_states[:-2, :2]) / 0.002
    yaw = measured_states[1:-1, 2]
    vx = np.cos(yaw) * world[:, 0] + np.sin(yaw) * world[:, 1]
    vy = -np.sin(yaw) * world[:, 0] + np.cos(yaw) * world[:, 1]
    assert np.abs(vx - measured_states[1:-1, 3]).max() < 2e-3
    assert np.abs(vy - measured_states[1:-1, 4]).max() < 2e-3


def test_velocity_filter_is_a_first_order_lag_on_velocities_only():
    tau, config = (
        0.05,
        SimulatorConfig(effects={"mocap_latency": {"latency": 0.0}, "velocity_filter_lag": {"time_constant": 0.05}}),
    )
    start = torch.tensor([[0, 0, 0, 2.0, 0, 0]], dtype=torch.float64)
    out = measured_rollout(config, start, torch.zeros(1, 30, 2, dtype=torch.float64))
    t = np.arange(31) * config.control_period_s
    rate = config.parameters.damping_nspm / config.parameters.mass_kg
    # Response of a lag at v(0) = 2 to v = 2 exp(-rate t).
    expected = 2 * (np.exp(-rate * t) - tau * rate * np.exp(-t / tau)) / (1 - tau * rate)
    assert np.abs(out.measured[0, :, 3].numpy() - expected).max() < 1e-4
    assert torch.equal(out.measured[..., :3], out.states[..., :3])


def test_steering_lag_is_the_exponential():
    config = SimulatorConfig(kind="kinematic", command_delay_s=0.0, effects={"steering_lag": {"time_constant": 0.1}})
    chain_start = torch.tensor([[0, 0, 0, 1.0, 0, 0]], dtype=torch.float64)
    commands = torch.zeros(1, 20, 2, dtype=torch.float64)
    commands[..., 0] = 0.5
    commands[..., 1] = 1.56 / 8.2
    yaw_rate = rollout(config, chain_start, commands, max_step_s=0.002).states[0, :, 5].numpy()

    def rates(t, r):
        angle = 0.3 * (1 - math.exp(-t / 0.1))
        return (math.tan(angle) / 0.3 - r) / 0.05

    t = np.arange(21) * config.control_period_s
    assert np.abs(yaw_rate - solve_ivp(rates, (0, t[-1]), [0.0], t_eval=t, rtol=1e-9, atol=1e-12).y[0]).max() < 1e-6


def test_invalid_input_is_refused():
    start, commands = some(3, 5)
    with pytest.raises(DataError, match="must be \\(cars, 6\\)"):
        rollout(SimulatorConfig(), start[:, :5], commands)
    with pytest.raises(DataError, match="start has shape"):
        rollout(SimulatorConfig(), torch.zeros(()), torch.zeros((1, 2, 2)))
    with pytest.raises(DataError, match="commands has shape"):
        rollout(SimulatorConfig(), start, commands[:2])
    with pytest.raises(DataError, match="must be \\(\\) or \\(3,\\)"):
        rollout(SimulatorConfig(), start, commands, values={"vehicle.mass": torch.ones(2)})
    with pytest.raises(ConfigError, match=r"vehicle\.mass"):
        rollout(SimulatorConfig(), start, commands, values={"vehicle.mas": 1.0})
    with pytest.raises(ConfigError, match="less than 0"):
        rollout(SimulatorConfig(), start, commands, values={"effects.command_delay.extra_delay": -0.2})
    with pytest.raises(ConfigError, match="control_period"):
        rollout(SimulatorConfig(), start, commands, values={"timing.control_period": 0.1})


def test_empty_commands_and_commands_of_another_dtype_are_accepted():
    start, commands = some(3, 5)
    empty = rollout(SimulatorConfig(), start, commands[:, :0]).states
    assert torch.equal(empty, start[:, None])
    mixed = rollout(SimulatorConfig(), start, commands.float(), history=commands.float()).states
    assert mixed.dtype == torch.float64


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_cuda_agrees_with_the_cpu():
    start, commands = some(16, 20)
    config = SimulatorConfig(effects=ALL_EFFECTS)
    cpu = rollout(config, start, commands).states
    gpu = rollout(config, start.cuda(), commands.cuda()).states
    assert gpu.device.type == "cuda"
    assert torch.allclose(gpu.cpu(), cpu, atol=1e-9)
