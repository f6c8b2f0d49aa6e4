"""Compare the speed of four implementations of a Runge-Kutta step of N cars (decision 0001).

Run it on an idle machine: ``pytest -m slow -s tests/sim_backends/test_step_comparison.py``.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pytest
import torch

from sim_backends.array_ops import FloatOps
from sim_backends.car_parameters import SimulatorConfig
from sim_backends.compiled.advance import (
    Key,
    address,
    advance_rows,
    advance_tensors,
    compile_advance,
    segment_table,
    trace_step,
)
from sim_backends.compiled.machine_code import addresses
from sim_backends.dynamics.integrate import rk4_step
from sim_backends.dynamics.single_track import SingleTrack
from sim_backends.dynamics.torch_ops import torch_ops

STEP_S = 1.0 / 120.0
MAX_ANGLE_RAD = SimulatorConfig().values()["steering.max_angle"]
SIZES = (64, 1024, 3072)
Rows = list[torch.Tensor]
Step = Callable[[Rows], tuple[torch.Tensor, ...]]


class CasadiOps:
    """Elementary functions on CasADi symbols."""

    fma, fms = staticmethod(FloatOps.fma), staticmethod(FloatOps.fms)

    def __init__(self, casadi: Any) -> None:
        for name in ("sin", "cos", "atan", "atan2", "tanh", "exp", "sqrt", "hypot", "fabs", "sign"):
            setattr(self, name, getattr(casadi, name))
        self.slope_angle, self.abs, self.at_least = casadi.atan2, casadi.fabs, casadi.fmax
        self.pow, self.where = casadi.power, casadi.if_else


def rows_of(cars: int, dtype: torch.dtype) -> Rows:
    """Return states (6 rows), steering command and throttle of ``cars`` cars."""
    rng = np.random.default_rng(0)
    state = rng.normal(0.0, 1.0, (6, cars)) * 0.3 + np.array([0, 0, 0, 2.0, 0, 0])[:, None]
    rows = [*state, rng.uniform(-1.0, 1.0, cars), rng.uniform(0.0, 0.5, cars)]
    return [torch.tensor(row, dtype=dtype, requires_grad=True) for row in rows]


def by_operators(rows: Rows) -> Step:
    ops = torch_ops(rows[0].detach())
    values = {name: torch.tensor(v, dtype=rows[0].dtype) for name, v in SimulatorConfig().values().items()}
    model = SingleTrack(ops, "dynamic", values, ())

    def step(rows: Rows) -> tuple[torch.Tensor, ...]:
        actuation = model.actuation(MAX_ANGLE_RAD * rows[6], rows[7])
        return tuple(rk4_step(model, 0.0, tuple(rows[:6]), STEP_S, actuation, actuation, actuation))

    return step


def by_compiled_step(rows: Rows) -> Step:
    key = Key("dynamic", ())
    values = {name: torch.full_like(rows[0].detach(), v) for name, v in SimulatorConfig().values().items()}
    parameters = [values[name] for name in trace_step(key).parameters]

    def step(rows: Rows) -> tuple[torch.Tensor, ...]:
        if torch.is_grad_enabled():
            return advance_tensors(key, 1, *parameters, STEP_S, *rows[6:], 0.0, *rows[:6])
        given = [row.detach().numpy() for row in rows]
        step_row, ends = np.full_like(given[0], STEP_S), np.empty((6, len(given[0])), given[0].dtype)
        commands = address(given[6]), address(given[7])
        table = segment_table(np.array([address(ends)]), 1, address(step_row), address(step_row), commands)
        advance_rows(key, addresses([*(p.numpy() for p in parameters), *given[:6]]), given[0], table)
        return tuple(map(torch.as_tensor, ends))

    return step


def torch_seconds(step: Step, rows: Rows, *, gradient: bool) -> float:
    def run() -> None:
        if gradient:
            torch.autograd.grad(torch.stack(step(rows)).sum(), rows, allow_unused=True)
        else:
            with torch.no_grad():
                step(rows)

    return fastest(run)


def casadi_seconds(casadi: Any, rows: Rows, *, gradient: bool) -> float:
    symbols = [casadi.SX.sym(f"v{i}") for i in range(8)]
    model = SingleTrack(CasadiOps(casadi), "dynamic", SimulatorConfig().values(), ())  # type: ignore[arg-type]
    actuation = model.actuation(MAX_ANGLE_RAD * symbols[6], symbols[7])
    after = rk4_step(model, 0.0, tuple(symbols[:6]), STEP_S, actuation, actuation, actuation)
    given, result = casadi.vertcat(*symbols), casadi.vertcat(*after)
    outputs = [casadi.gradient(casadi.sum1(result), given)] if gradient else [result]
    function = casadi.Function("step", [given], outputs).map(len(rows[0]))
    numbers = torch.stack(rows).detach().double().numpy()
    return fastest(lambda: function(numbers))


def fastest(run: Callable[[], object], rounds: int = 60) -> float:
    """Return the shortest time of a call [s] after a warm-up."""
    return min(seconds(run) for _ in range(rounds))


def seconds(run: Callable[[], object]) -> float:
    """Return the time of one call [s]."""
    start_s = time.perf_counter()
    run()
    return time.perf_counter() - start_s


def test_all_engines_give_the_same_step_and_gradient() -> None:
    rows = rows_of(64, torch.float64)
    results = [step(rows) for step in (by_operators(rows), by_compiled_step(rows))]
    gradients = [torch.autograd.grad(torch.stack(result).sum(), rows, allow_unused=True) for result in results]
    for one, other in zip(*results, strict=True):
        assert other.detach().numpy() == pytest.approx(one.detach().numpy(), abs=1e-12)
    for one, other in zip(*gradients, strict=True):
        zero = torch.zeros(64, dtype=torch.float64)
        expected, found = (zero if g is None else g for g in (one, other))
        assert found.numpy() == pytest.approx(expected.numpy(), abs=1e-11)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # warnings of torch's compiler
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=["float32", "float64"])
@pytest.mark.parametrize("gradient", [False, True], ids=["step", "gradient"])
def test_compiled_step_is_the_fastest(gradient: bool, dtype: torch.dtype) -> None:
    casadi = pytest.importorskip("casadi", reason="the comparison needs: pip install casadi")
    import torch._inductor.config as inductor

    inductor.compile_threads, inductor.force_disable_caches = 1, True
    torch.set_num_threads(1)
    for cars in SIZES:
        rows = rows_of(cars, dtype)
        operators = by_operators(rows)
        compiled = torch.compile(operators)
        if cars == SIZES[0]:
            trace_step.cache_clear()
            compile_advance.cache_clear()
            firsts = [f"{seconds(partial(step, rows)):.2f} s" for step in (by_compiled_step(rows), compiled)]
            print("\nFirst call of the compiled step and of torch.compile:", *firsts)
        found = {
            "compiled step": torch_seconds(by_compiled_step(rows), rows, gradient=gradient),
            "torch operators": torch_seconds(operators, rows, gradient=gradient),
            "torch.compile": torch_seconds(compiled, rows, gradient=gradient),
            "CasADi (float64)": casadi_seconds(casadi, rows, gradient=gradient),
        }
        print(f"\n{cars} cars, {dtype}, gradient {gradient}:", {k: f"{1e6 * v:.0f} us" for k, v in found.items()})
        assert found["compiled step"] < 1.2 * found["torch operators"]
