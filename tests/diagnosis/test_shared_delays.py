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
from tests.helpers.recorded_drives import PERIOD_S, drive

CAR = SimulatorConfig(control_period_s=PERIOD_S, mocap=MocapParameters(latency_s=0.0))
DELAY = "command_delay"
FLOOR = np.array([1e-3, 1e-3, 2e-3, 1e-2, 1e-2, 2e-2])
NOISE = 3e-4 * np.array([1.0, 1.0, 2.0, 20.0, 20.0, 40.0])


@pytest.mark.parametrize(
    ("true", "expected"),
    [
        ({"steering_lag": "time_constant", "motor_lag": "time_constant"}, {"steering_lag", "motor_lag"}),
        ({"steering_delay": "delay", "throttle_delay": "delay"}, {DELAY}),
    ],
)
def test_delay_is_split_unless_both_commands_have_equal_delays(true: dict[str, str], expected: set[str]) -> None:
    """All lags and delays are 0.04 s. Equal delays of both commands are one delay of both, with fewer parameters."""
    effects = {effect: {parameter: 0.04} for effect, parameter in true.items()}
    windows = cut_windows(tracks_of([drive(replace(CAR, effects=effects), 40.0, 1)]), 0.8, 0.6)
    problem = SearchProblem(CAR, windows, FLOOR, NOISE, {})
    base = fit_base(problem)
    free = problem.free_parameters((DELAY,))
    start = np.append(base.fit.z, next(f.coordinate(0.03) for f in free if DELAY in f.name))
    model = fit_with_scale(problem, (DELAY,), problem.config_with((DELAY,)), free, start)

    decisions: list[Decision] = []
    control = RunControl(record=decisions.append)
    outcome = replace_shared_delays(
        problem, EliminationResult(model, delete_each(problem, model, control)), control
    ).model
    assert set(outcome.effects) == expected
    passed = {decision.effect for decision in decisions if decision.stage == "replace" and decision.passed}
    assert passed >= expected - {DELAY}
    assert not passed or expected != {DELAY}
    found = {f.name: float(f.value(z)) for f, z in zip(outcome.fit.free, outcome.fit.z, strict=True)}
    delays = [value for name, value in found.items() if name.startswith("effects.")]
    assert delays == pytest.approx([0.04] * len(expected), abs=0.002)
