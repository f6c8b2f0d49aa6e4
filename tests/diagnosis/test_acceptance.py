"""A candidate is accepted exactly if the conditions hold that its decision records."""

from dataclasses import replace

import numpy as np
import pytest

from carlab.diagnosis.identification.fit import Fit
from carlab.diagnosis.selection.candidates import acceptance, is_accepted
from carlab.diagnosis.selection.problem import Candidate, SearchProblem
from carlab.prediction.windows import cut_windows, segments_of
from sim_backends import SimulatorConfig
from tests.helpers.recorded_drives import PERIOD_S, drive

CAR = SimulatorConfig(control_period_s=PERIOD_S)


@pytest.fixture(scope="module")
def problem() -> SearchProblem:
    windows = cut_windows(segments_of([drive(CAR, 15.0, 3)]), 0.8, 0.5)
    return SearchProblem(CAR, windows, np.full(6, 1e-2), np.full(6, 1e-2), {}, ())


@pytest.fixture
def strong(problem: SearchProblem) -> Candidate:
    """A candidate far above each threshold."""
    gain = 10.0 * problem.perfect_loss()
    fit = Fit(CAR, (), np.zeros(0), 0.0, np.zeros(len(problem.windows)))
    loss = np.zeros(len(problem.windows))
    return Candidate("aerodynamic_drag", fit, gain, 2.0 * gain, 0.9 * gain, 0.01 * gain, loss)


def test_strong_candidate_is_accepted(problem: SearchProblem, strong: Candidate) -> None:
    assert is_accepted(problem, strong)
    assert all(condition.holds for condition in acceptance(problem, strong)[0])


@pytest.mark.parametrize(
    "changed",
    [
        pytest.param({"gain": -1.0}, id="fitted windows get worse"),
        pytest.param({"left_out_gain": -1.0}, id="other blocks get worse"),
        pytest.param({"left_out_gain": 1e-9}, id="other blocks hardly change"),
        pytest.param({"chi2": 0.0, "left_out_gain_error": 1e9}, id="not significant"),
    ],
)
def test_rejected_candidate_meets_no_set_of_conditions(
    problem: SearchProblem, strong: Candidate, changed: dict[str, float]
) -> None:
    candidate = replace(strong, **changed)
    assert not is_accepted(problem, candidate)
    assert not any(all(c.holds for c in conditions) for conditions in acceptance(problem, candidate))
