"""Reasons of withdrawn effects in reports."""

import json
import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np

from carlab.benchmark.cases.case import make_case
from carlab.diagnosis.decisions import Condition, Decision, passes
from carlab.diagnosis.diagnose import diagnose
from carlab.diagnosis.findings import Withdrawal
from carlab.diagnosis.identification.error_scale import Scale
from carlab.diagnosis.identification.fit import Fit
from carlab.diagnosis.report.write import write_report
from carlab.diagnosis.selection.problem import SearchResult
from carlab.diagnosis.settings import DEFAULT
from carlab.diagnosis.weak_effects import held_out_conditions
from carlab.diagnosis.withdrawals import REASONS, withdrawn_effects
from sim_backends import SimulatorConfig
from tests.helpers.case_files import car_in, episodes_in, write_case

SMALL = Condition("selection.min_practical_size", 0.1, 0.2)
LARGE = Condition("selection.min_practical_size", 0.3, 0.2)
WORSE = Condition("selection.min_held_out_rise", -0.1, 0.0)
LESS_LIKELY = Condition("selection.min_held_out_z", -0.2, 0.0)


def stand(effect: str, *alternatives: Condition, passed: bool) -> Decision:
    return Decision("confirm", effect, tuple((condition,) for condition in alternatives), passed)


def test_reason_is_that_of_the_last_failed_test() -> None:
    decisions = [
        Decision("accept", "steering_lag", ((Condition("selection.accept_chi2_min", 9.0, 25.0),),), passed=False),
        stand("steering_lag", LARGE, passed=True),
        stand("motor_lag", SMALL, passed=False),
        stand("steering_lag", WORSE, LESS_LIKELY, passed=False),
    ]
    found = withdrawn_effects(decisions, ("steering_lag", "motor_lag", "marker_offset"), ("marker_offset",))
    assert [w.id for w in found] == ["steering_lag", "motor_lag"]
    assert [w.reason for w in found] == [
        "the error on held-out recordings does not fall",
        "it changes the predictions by a small part of the remaining error",
    ]


def test_effect_of_a_set_is_not_withdrawn() -> None:
    """A set states that the effect may be the cause; a reason why it is not would contradict this."""
    fit = Fit(SimulatorConfig(), (), np.zeros(0), 0.0, np.zeros(3))
    sets = {"all_wheel_drive": ("load_transfer",)}
    scale = Scale(np.array([1]), np.ones((1, 6)))
    found = SearchResult(fit, fit, ("all_wheel_drive",), {}, sets, (), (), scale)
    decisions = [stand(name, WORSE, passed=False) for name in ("load_transfer", "motor_lag")]
    accepted = ("load_transfer", "motor_lag", "all_wheel_drive")
    withdrawn = withdrawn_effects(decisions, accepted, found.possible_effects)
    assert [each.id for each in withdrawn] == ["motor_lag"]


class OneBlock:
    """Held-out windows of one block: the gain in log-likelihood has no standard error. The score rises."""

    def final_error(self, config: str) -> str:
        return config

    def score(self, error: str) -> float:
        return {"without": 2.0, "with": 2.1}[error]

    def gain(self, before: str, after: str) -> tuple[float, float]:
        return 5.0, math.inf


def test_sign_of_the_likelihood_counts_with_one_held_out_block() -> None:
    fits = (SimpleNamespace(config=name) for name in ("without", "with"))
    rise, likelihood = held_out_conditions(OneBlock(), *fits, DEFAULT.selection)  # type: ignore[arg-type]
    assert not passes((rise,))
    assert passes((likelihood,))


def test_effect_without_a_failed_test_was_replaced_by_physics_outside_the_catalogue() -> None:
    (found,) = withdrawn_effects([], ("marker_offset",), ())
    assert found == Withdrawal("marker_offset", "physics outside the catalogue explains more of the error in its place")


def test_report_lists_an_effect_that_a_later_test_withdrew(tmp_path: Path) -> None:
    """The search accepts the concealed lag; a test that no effect passes withdraws it."""
    case = make_case("single", 3, effects=("steering_lag",), excess=3.0, fit_s=40, hold_s=20)
    write_case(case, tmp_path)
    fit, hold = episodes_in(tmp_path / "fit.csv"), episodes_in(tmp_path / "hold.csv")
    strict = replace(DEFAULT, selection=replace(DEFAULT.selection, min_practical_size=1e6))
    outcome = diagnose(fit, hold, car_in(tmp_path), effects=("steering_lag",), settings=strict)
    assert outcome.diagnosis.withdrawn == ()  # a requested effect may be small
    strict = replace(DEFAULT, selection=replace(DEFAULT.selection, min_held_out_rise=1e6, min_held_out_z=1e6))
    outcome = diagnose(fit, hold, car_in(tmp_path), effects=("steering_lag",), settings=strict)
    reason = REASONS["selection.min_held_out_rise"]
    assert outcome.diagnosis.effects == ()
    assert outcome.diagnosis.withdrawn == (Withdrawal("steering_lag", reason),)
    write_report(outcome.diagnosis, outcome.figure_data, tmp_path, outcome.model)
    report = json.loads((tmp_path / "report.json").read_text(encoding="utf-8"))
    assert report["withdrawn"] == [{"id": "steering_lag", "reason": reason}]
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert f"Withdrawn: a lag of the steering servo, because {reason}." in page
