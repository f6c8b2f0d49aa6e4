"""Lags of both commands that resemble one delay."""

from dataclasses import replace

import numpy as np
import pytest

from carlab.diagnosis.decisions import Decision
from carlab.diagnosis.selection.elimination import EliminationResult, delete_each
from carlab.diagnosis.selection.problem import RunControl, SearchProblem
from carlab.diagnosis.selection.refit import fit_base, fit_with_scale
from carlab.diagnosis.selection.shared_delays import replace_shared_delays
from carlab.prediction.windows import cut_windows, tracks_of
from sim_backends import SimulatorConfig
from sim_backends.car_parameters import MocapParameters
from sim_backends.effects import EFFECTS
from tests.helpers.recorded_drives import PERIOD_S, drive

CAR = SimulatorConfig(control_period_s=PERIOD_S, mocap=MocapParameters(latency_s=0.0))
DELAY = "command_delay"
FLOOR = np.array([1e-3, 1e-3, 2e-3, 1e-2, 1e-2, 2e-2])
NOISE = 3e-4 * np.array([1.0, 1.0, 2.0, 20.0, 20.0, 40.0])


@pytest.mark.parametrize(
    ("true", "accepted", "expected"),
    [
        ({"steering_lag": 0.04, "motor_lag": 0.04}, (DELAY,), {"steering_lag", "motor_lag"}),
        ({"steering_delay": 0.04, "throttle_delay": 0.04}, (DELAY,), {DELAY}),
        ({DELAY: 0.02, "steering_lag": 0.05}, ("motor_lag", "steering_lag"), {DELAY, "steering_lag"}),
    ],
    ids=["two lags are no delay", "two equal delays are one", "delay and lag are not two lags"],
)
def test_delays_and_lags_are_exchanged(true: dict[str, float], accepted: tuple[str, ...], expected: set[str]) -> None:
    """Equal delays of both commands are one delay of both, with fewer parameters."""
    effects = {effect: {EFFECTS[effect].lag_parameter: lag} for effect, lag in true.items()}
    windows = cut_windows(tracks_of([drive(replace(CAR, effects=effects), 40.0, 1)]), 0.8, 0.6)
    problem = SearchProblem(CAR, windows, FLOOR, NOISE, {})
    base = fit_base(problem)
    free = problem.free_parameters(accepted)
    start = np.concatenate([base.fit.z, [f.coordinate(0.03) for f in free[len(base.fit.z) :]]])
    model = fit_with_scale(problem, accepted, problem.config_with(accepted), free, start)

    decisions: list[Decision] = []
    control = RunControl(record=decisions.append)
    eliminated = EliminationResult(model, delete_each(problem, model, control))
    outcome = replace_shared_delays(problem, eliminated, control).model
    assert set(outcome.effects) == expected
    passed = {decision.effect for decision in decisions if decision.stage == "replace" and decision.passed}
    assert passed >= expected or expected == set(accepted)
    found = {f.name: float(f.value(z)) for f, z in zip(outcome.fit.free, outcome.fit.z, strict=True)}
    for effect in expected:
        lag = found[f"effects.{effect}.{EFFECTS[effect].lag_parameter}"]
        assert lag == pytest.approx(true.get(effect, 0.04), abs=0.003)
