"""A candidate is accepted, and an effect remains, exactly if the conditions of its recorded decision hold."""

from dataclasses import replace

import numpy as np
import pytest

from carlab.diagnosis.decisions import Decision, passes
from carlab.diagnosis.identification.block_jackknife import clustered_gain
from carlab.diagnosis.identification.error_scale import Scale
from carlab.diagnosis.identification.fit import Fit
from carlab.diagnosis.selection.candidates import acceptance, accepted, is_accepted
from carlab.diagnosis.selection.elimination import Deletion, EliminationResult, eliminate
from carlab.diagnosis.selection.problem import Candidate, Model, RunControl, SearchProblem
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


@pytest.mark.parametrize(
    ("best", "other", "confusable", "rise", "expected"),
    [
        pytest.param("longitudinal_slip", "motor_lag", True, 0.0, "motor_lag", id="equal loss"),
        pytest.param("longitudinal_slip", "motor_lag", True, 0.8, "motor_lag", id="slightly higher loss"),
        pytest.param("longitudinal_slip", "motor_lag", True, 1.2, "longitudinal_slip", id="higher loss"),
        pytest.param("longitudinal_slip", "motor_lag", False, 0.0, "longitudinal_slip", id="not confusable"),
        pytest.param("motor_lag", "longitudinal_slip", True, -0.5, "motor_lag", id="more numbers"),
        pytest.param("steering_rate_limit", "steering_lag", True, 0.0, "steering_rate_limit", id="as many numbers"),
    ],
)
def test_simpler_candidate_is_next_if_left_out_blocks_do_not_distinguish_it(
    problem: SearchProblem, strong: Candidate, best: str, other: str, confusable: bool, rise: float, expected: str
) -> None:
    """The loss of the other one is higher by ``rise`` standard errors."""
    problem = replace(problem, confusable={best: (other,)} if confusable else {})
    random = np.random.default_rng(1).normal(0.0, 1.0, len(problem.windows))
    random -= random.mean()
    _, error = clustered_gain(random, np.zeros_like(random), problem.windows)
    losses = strong.left_out_loss, strong.left_out_loss + random + rise * error / len(random)
    candidates = tuple(replace(strong, effect=e, left_out_loss=x) for e, x in zip((best, other), losses, strict=True))
    model = Model((), strong.fit, Scale(np.array([1]), np.ones((1, 6))))
    chosen = accepted(problem, model, candidates, RunControl())
    assert [c.effect for c in chosen] == [expected, other if expected == best else best]


@pytest.mark.parametrize("offset", [-1e-9, 0.0, 1e-9])
def test_effect_remains_exactly_if_its_recorded_condition_holds(
    problem: SearchProblem, strong: Candidate, monkeypatch: pytest.MonkeyPatch, offset: float
) -> None:
    rise = problem.settings.selection.keep_z_min + offset

    def delete_each(problem: SearchProblem, model: Model, control: RunControl) -> EliminationResult:
        return EliminationResult(model, {e: Deletion(replace(model, effects=(e,)), rise) for e in model.effects})

    monkeypatch.setattr("carlab.diagnosis.selection.elimination.delete_each", delete_each)
    named = ("aerodynamic_drag", "steering_lag")
    model = Model(named, strong.fit, Scale(np.array([1]), np.ones((1, 6))))
    decisions: list[Decision] = []
    both_remain = eliminate(problem, model, RunControl(record=decisions.append)).model.effects == named
    assert [decision.passed for decision in decisions] == [both_remain]
    assert [passes(decision.alternatives) for decision in decisions] == [both_remain]
