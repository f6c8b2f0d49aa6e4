"""Lags of both commands that resemble one delay."""

from dataclasses import replace

import numpy as np
import pytest

from carlab.diagnosis.decisions import Decision
from carlab.diagnosis.selection.elimination import delete_each
from carlab.diagnosis.selection.pairwise_tests import compare_pairs
from carlab.diagnosis.selection.problem import Model, RunControl, SearchProblem
from carlab.diagnosis.selection.refit import fit_base, fit_with_scale
from carlab.diagnosis.selection.shared_delays import confusable_shared_delays, replace_shared_delays
from carlab.prediction.windows import cut_windows, segments_of
from sim_backends import SimulatorConfig
from sim_backends.car_parameters import MocapParameters
from sim_backends.effects import EFFECTS
from tests.helpers.recorded_drives import PERIOD_S, drive

CAR = SimulatorConfig(control_period_s=PERIOD_S, mocap=MocapParameters(latency_s=0.0))
DELAY = "command_delay"
FLOOR = np.array([1e-3, 1e-3, 2e-3, 1e-2, 1e-2, 2e-2])
NOISE = 3e-4 * np.array([1.0, 1.0, 2.0, 20.0, 20.0, 40.0])


def fitted(true: dict[str, float], accepted: tuple[str, ...]) -> tuple[SearchProblem, Model]:
    """A drive of a car with true delays and lags [s], and a simulator with the accepted ones."""
    effects = {effect: {EFFECTS[effect].lag_parameter: lag} for effect, lag in true.items()}
    windows = cut_windows(segments_of([drive(replace(CAR, effects=effects), 40.0, 1)]), 0.8, 0.6)
    problem = SearchProblem(CAR, windows, FLOOR, NOISE, {})
    base = fit_base(problem)
    free = problem.free_parameters(accepted)
    start = np.concatenate([base.fit.z, [f.coordinate(0.03) for f in free[len(base.fit.z) :]]])
    return problem, fit_with_scale(problem, accepted, start)


@pytest.mark.parametrize(
    ("true", "accepted", "expected"),
    [
        ({"steering_lag": 0.04, "motor_lag": 0.04}, (DELAY,), {"steering_lag", "motor_lag"}),
        ({"steering_delay": 0.04, "throttle_delay": 0.04}, (DELAY,), {DELAY}),
        pytest.param(
            *({DELAY: 0.02, "steering_lag": 0.05}, ("motor_lag", "steering_lag"), {DELAY, "steering_lag"}),
            marks=pytest.mark.slow,
        ),
    ],
    ids=["two lags are no delay", "two equal delays are one", "delay and lag are not two lags"],
)
def test_delays_and_lags_are_exchanged(true: dict[str, float], accepted: tuple[str, ...], expected: set[str]) -> None:
    """Equal delays of both commands are one delay of both, with fewer parameters."""
    problem, model = fitted(true, accepted)
    decisions: list[Decision] = []
    control = RunControl(record=decisions.append)
    outcome = replace_shared_delays(problem, delete_each(problem, model, control), control).model
    assert set(outcome.effects) == expected
    passed = {decision.effect for decision in decisions if decision.stage == "replace" and decision.passed}
    assert passed >= expected or expected == set(accepted)
    found = {f.name: float(f.value(z)) for f, z in zip(outcome.fit.free, outcome.fit.z, strict=True)}
    for effect in expected:
        lag = found[f"effects.{effect}.{EFFECTS[effect].lag_parameter}"]
        assert lag == pytest.approx(true.get(effect, 0.04), abs=0.003)


@pytest.mark.slow
def test_shared_delay_is_compared_with_the_shorter_of_two_lags() -> None:
    """A delay of both commands of 4 ms beside a lag of the steering is a lag of the motor and a longer steering lag."""
    problem, model = fitted({DELAY: 0.004, "steering_lag": 0.05}, ("steering_lag", "motor_lag"))
    assert ("motor_lag", DELAY) in confusable_shared_delays(model)
    control = RunControl()
    pairs = compare_pairs(problem, delete_each(problem, model, control), control)
    assert DELAY in pairs.indistinguishable["motor_lag"]
    assert DELAY not in pairs.indistinguishable["steering_lag"]
    with_delay = fitted({DELAY: 0.004, "steering_lag": 0.05}, (DELAY, "steering_lag"))[1]
    assert confusable_shared_delays(with_delay) == []
