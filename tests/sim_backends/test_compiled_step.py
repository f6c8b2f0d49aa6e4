"""Test the compiled step against the torch operators it is traced from (values and derivatives)."""

import itertools
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch

from sim_backends.array_ops import FLOATS
from sim_backends.batch.rollout import rollout
from sim_backends.car_parameters import SimulatorConfig
from sim_backends.compiled.advance import Key
from sim_backends.compiled.tracing import Tracer, gradients
from tests.helpers.effect_inputs import ALL_EFFECTS


def some(cars, ticks):
    rng = np.random.default_rng(1)
    start = rng.uniform(-1, 1, (cars, 6)) * [2, 2, 3, 2, 0.3, 1]
    return torch.tensor(start), torch.tensor(rng.uniform(-1, 1, (cars, ticks, 2)))


@pytest.mark.parametrize(
    ("kind", "effects", "per_car_delay"),
    [
        *itertools.product(("dynamic", "linear_tyre", "kinematic", "blend"), ({},), (False, True)),
        ("dynamic", ALL_EFFECTS, True),
        ("linear_tyre", ALL_EFFECTS, False),
        ("kinematic", ALL_EFFECTS, True),
        ("blend", ALL_EFFECTS, False),
    ],
)
def test_values_and_gradients_equal_those_of_torch_operators(kind, effects, per_car_delay):
    config = SimulatorConfig(kind=kind, effects=effects)
    cars = 5
    results = []
    for engine in ("fastest", "operators"):
        start, commands = (v.requires_grad_() for v in some(cars, 4))  # one tick more than the longest delay
        delay = torch.linspace(0.02, 0.09, cars, dtype=torch.float64, requires_grad=True)
        mu = torch.linspace(0.3, 0.5, cars, dtype=torch.float64, requires_grad=True)
        values = {"tyre.front.mu": mu, **({"timing.command_delay": delay} if per_car_delay else {})}
        states = rollout(config, start, commands, values=values, max_step_s=0.02, engine=engine).states
        states.square().sum().backward()
        grads = [start.grad, commands.grad, *([mu.grad] if mu.grad is not None else [])]
        results.append([states.detach(), *grads, *([delay.grad] if per_car_delay else [])])
    for compiled, reference in zip(*results, strict=True):
        assert torch.allclose(compiled, reference, rtol=1e-9, atol=1e-10)


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 2e-4), (torch.float64, 1e-9)])
@pytest.mark.parametrize("cars", [1, 5, 37])
def test_hidden_states_before_the_start_equal_those_of_torch_operators(cars, dtype, tolerance):
    """Effects with hidden states of the body follow the recorded states of the history, with a delay for each car."""
    names = ("tyre_relaxation", "longitudinal_slip", "roll_dynamics", "motor_lag")
    config = SimulatorConfig(effects={name: ALL_EFFECTS[name] for name in names})
    start, commands = (v.to(dtype) for v in some(cars, 16))
    states = torch.tensor(np.random.default_rng(2).uniform(0.5, 2.0, (cars, 12, 6)), dtype=dtype)
    delay = torch.linspace(0.02, 0.09, cars, dtype=dtype)
    results = []
    for engine, needs_gradient in (("operators", True), ("fastest", True), ("fastest", False)):
        mu = torch.full((cars,), 0.5, dtype=dtype, requires_grad=needs_gradient)
        out = rollout(
            config, start, commands[:, 12:], history=commands[:, :12], history_states=states, max_step_s=0.02,
            values={"timing.command_delay": delay, "tyre.front.mu": mu}, engine=engine,
        )  # fmt: skip
        results.append(out.states.detach())
    assert not torch.allclose(results[0], rollout(config, start, commands[:, 12:]).states, rtol=1e-2)
    for found in results[1:]:
        assert torch.allclose(found, results[0], rtol=tolerance, atol=tolerance)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_car_has_the_same_states_and_gradients_in_a_batch_of_any_size(dtype):
    """The last vector of a batch overlaps the one before it; batches shorter than a vector are padded."""
    start, commands = (v.to(dtype) for v in some(37, 4))

    def simulated(cars):
        leaf = commands[:cars].clone().requires_grad_()
        states = rollout(SimulatorConfig(), start[:cars], leaf).states
        states.square().sum().backward()
        return states.detach(), leaf.grad, rollout(SimulatorConfig(), start[:cars], commands[:cars]).states

    whole = simulated(37)
    for cars in (1, 2, 7, 8, 9, 16, 31):
        for part, all_cars in zip(simulated(cars), whole, strict=True):
            assert torch.equal(part, all_cars[:cars])


@pytest.mark.parametrize("needs_gradient", [False, True])
def test_batch_without_cars_has_no_states(needs_gradient):
    start, commands = some(0, 3)
    assert rollout(SimulatorConfig(), start, commands.requires_grad_(needs_gradient)).states.shape == (0, 4, 6)


def test_batches_of_several_threads_do_not_disturb_each_other():
    start, commands = some(500, 10)
    expected = rollout(SimulatorConfig(), start, commands).states
    with ThreadPoolExecutor(4) as threads:
        for found in threads.map(lambda _: rollout(SimulatorConfig(), start, commands).states, range(16)):
            assert torch.equal(found, expected)


def test_second_derivatives_are_refused_unless_on_operators():
    start, commands = some(1, 6)
    commands.requires_grad_()
    loss = rollout(SimulatorConfig(), start, commands, engine="operators").states.square().sum()
    (first,) = torch.autograd.grad(loss, commands, create_graph=True)
    (second,) = torch.autograd.grad(first.sum(), commands)
    assert second.abs().max() > 0
    loss = rollout(SimulatorConfig(), start, commands).states.square().sum()
    with pytest.raises(NotImplementedError, match="operators"):
        torch.autograd.grad(loss, commands, create_graph=True)


def test_the_order_of_effects_and_delays_need_no_other_compiled_step():
    key = Key.of("dynamic", ("steering_lag", "tyre_relaxation"))
    assert Key.of("dynamic", ("tyre_relaxation", "command_delay", "steering_lag")) == key
    assert Key.of("dynamic", ("tyre_relaxation",)) != key


UNARY = {
    "sin": 0.7,
    "cos": 0.7,
    "atan": -1.3,
    "tanh": 0.4,
    "exp": 0.3,
    "log": 0.3,
    "sqrt": 2.0,
    "abs": -0.6,
    "sign": -0.6,
    "neg": 0.2,
}
BINARY = ("add", "sub", "mul", "div", "atan2", "hypot", "maximum", "minimum", "pow")


@pytest.mark.parametrize("operation", [*UNARY, *BINARY])
def test_each_operation_has_the_derivative_of_its_finite_difference(operation):
    tracer = Tracer()
    point = [UNARY[operation]] if operation in UNARY else [0.8, -1.7]
    inputs = [tracer.input(str(i)) for i in range(len(point))]
    output = tracer.make(operation, *inputs)
    seed = tracer.input("seed")
    symbolic = gradients([output], [seed], inputs)

    def value(node, at):
        if not hasattr(node, "operation"):
            return node
        if node is seed:
            return 1.0
        if node in inputs:
            return at[inputs.index(node)]
        return Tracer().make(node.operation, *(value(a, at) for a in node.arguments))

    for i, expression in enumerate(symbolic):
        up, down = ([p + (h if j == i else 0.0) for j, p in enumerate(point)] for h in (1e-6, -1e-6))
        difference = (value(output, up) - value(output, down)) / 2e-6
        assert value(expression, point) == pytest.approx(difference, rel=1e-6, abs=1e-9)


def test_where_and_clip_pass_the_gradient_to_the_branch_taken():
    tracer = Tracer()
    a, b, seed = (tracer.input(n) for n in "abs")
    chosen = tracer.where(a < b, a * 2.0, b * 3.0)
    results = gradients([chosen], [seed], [a, b])
    assert [r.operation for r in results] == ["mul", "mul"]
    clipped = tracer.clip(a, 0.0, 1.0)
    assert gradients([clipped], [seed], [b]) == [0.0]


def test_constants_fold_and_equal_operations_merge():
    tracer = Tracer()
    a = tracer.input("a")
    assert tracer.sin(0.5) == FLOATS.sin(0.5)
    assert (a + 0.0) is a
    assert (a * 1.0) is a
    assert a * 0.0 == 0.0
    before = len(tracer.nodes)
    assert (a * 2.0) is (2.0 * a)
    assert tracer.fma(a, 2.0, 1.0) is tracer.fma(2.0, a, 1.0)
    assert len(tracer.nodes) == before + 2
