"""What a report says about the residual, the parameters and model.toml agrees with its numbers."""

import html
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from carlab.diagnosis.final_models import measured_curves
from carlab.diagnosis.findings import CurveTrial, Diagnosis, Estimate, FigureData, FitErrors, SearchExtent, Unexplained
from carlab.diagnosis.identification.fit import Fit
from carlab.diagnosis.report.curves import ceiling_sentence, curves_advice
from carlab.diagnosis.report.figure_data import figure_data_of
from carlab.diagnosis.report.html_page import render_page
from carlab.diagnosis.report.model_file import model_toml
from carlab.diagnosis.report.next_drive import next_drive, with_texts
from carlab.diagnosis.report.residual import shown_errors
from carlab.diagnosis.report.sentences import regime_clause, verdict_sentence, verdict_title
from carlab.diagnosis.selection.problem import Candidate, RunControl
from carlab.diagnosis.settings import DEFAULT
from sim_backends import SimulatorConfig
from tests.diagnosis.report_material import inconclusive, lag_finding

REST = Unexplained(1.0, ("vx",), "speed > 1 m/s", "odd in speed", "coast_brake: coefficient 1 N s/m")


def diagnosis(verdict: str, refit: float, **models: float) -> Diagnosis:
    """A diagnosis with the scores of its models [noise floors], and the residual ``REST``."""
    scores = {"nominal": refit, "refit": refit, "with_effects": refit, **models, "noise_floor": 1.0}
    held_out = {name: FitErrors(0.002 * s, 0.01 * s, 0.01, 0.01, 0.05, s) for name, s in scores.items()}
    effects = (replace(lag_finding(), indistinguishable_from=()),) if verdict == "mismatch" else ()
    return Diagnosis(verdict, "", effects, {}, 1.0, held_out, REST, (), (), 0, 1.0)


def page(case: Diagnosis) -> str:
    """The page of a complete report, without escapes."""
    return html.unescape(render_page(with_texts(case), FigureData()))


def test_physics_that_model_toml_contains_is_no_residual_to_excite_or_measure() -> None:
    described = diagnosis("unexplained", 13.2, with_uncatalogued_physics=0.85)
    assert "all channels: 0.85 noise floors). model.toml contains it." in verdict_sentence(described)
    assert curves_advice(described) == ""
    assert next_drive(described)[0] == "figure_eight"
    partly = diagnosis("unexplained", 13.2, with_uncatalogued_physics=9.0)
    assert "--curves" in curves_advice(partly)
    assert next_drive(partly)[0] == "coast_down"
    with_curves = replace(diagnosis("unexplained", 13.2, with_uncatalogued_physics=9.0, with_curves=5.0), curves=(1,))
    assert "model.toml contains it" not in verdict_sentence(with_curves)


def test_curves_are_not_fitted_where_uncatalogued_physics_explains_the_residual() -> None:
    request = SimpleNamespace(curves=True, settings=DEFAULT)
    held_out = SimpleNamespace(final_error=lambda config: config, score=lambda error: error)
    scored = SimpleNamespace(
        scores=lambda: {"refit": 13.2, "with_effects": 13.2},
        held_out=held_out,
        problem=SimpleNamespace(settings=DEFAULT),
    )
    described = SimpleNamespace(config=0.85)
    found = measured_curves(scored, described, None, request, RunControl())  # type: ignore[arg-type]
    assert found == (None, CurveTrial(is_fitted=False))


def test_refit_near_the_noise_leaves_no_missing_physics() -> None:
    """All of an excess of 0.04 noise floors is unexplained, and says nothing about the car."""
    near = diagnosis("parameters", 1.04)
    assert "Unexplained residual" not in page(near)
    assert next_drive(near)[0] == ""
    assert "Unexplained residual" in page(diagnosis("parameters", 1.7))


@pytest.mark.parametrize(
    ("search", "remedy"),
    [
        (SearchExtent(effects=("aerodynamic_drag",)), "without --effects"),
        (SearchExtent(False, "budget", 15.0), "with a longer time limit"),
        (SearchExtent(False, "user"), "without a stop"),
    ],
)
def test_residual_of_a_partial_search_is_searched_before_it_is_driven(search: SearchExtent, remedy: str) -> None:
    partial = replace(diagnosis("mismatch", 12.5, with_effects=9.7), search=search)
    assert next_drive(partial) == ("", f"Diagnose these recordings again {remedy}, before another drive.")
    assert bool(curves_advice(partial)) == (partial.search.stopped_by == "budget")


def test_small_share_of_a_large_excess_is_stated_as_an_error_above_the_noise() -> None:
    small = replace(REST, share=0.015)
    far = replace(diagnosis("mismatch", 49.4, with_effects=6.12), unexplained=small)
    assert verdict_sentence(far).endswith("the simulator lacks physics that the diagnosis does not find.")
    near = replace(diagnosis("mismatch", 49.4, with_effects=1.1), unexplained=None)
    assert "above the noise" not in verdict_sentence(near)


def test_confidence_of_a_name_is_a_probability_below_one() -> None:
    certain = replace(lag_finding(), indistinguishable_from=(), confidence=0.9999975)
    shown = page(replace(diagnosis("mismatch", 8.0, with_effects=1.1), effects=(certain,)))
    assert "almost certain (probability of the name: more than 99 %)" in shown


def test_page_explains_the_symbols_of_a_formula() -> None:
    formula = replace(REST, formula="F_rear/m += -0.785 w")
    shown = page(replace(diagnosis("unexplained", 13.2), unexplained=formula))
    assert "SI units. w: lateral velocity vy; F_rear/m: side force of the rear axle over the mass." in shown
    assert "SI units. " not in page(diagnosis("unexplained", 13.2))


def test_page_states_the_next_command_once() -> None:
    assert page(diagnosis("unexplained", 13.2)).count("carlab drive --policy coast_down") == 1


def test_scores_below_the_noise_floor_are_not_denied() -> None:
    """The noise floor is an estimate: a simulator without an error can have a score of 0.7."""
    good = replace(diagnosis("none", 0.74), unexplained=None)
    assert "the best score is 1" not in page(good)
    assert "0.74 noise floors (a noise floor is the estimated error of measurement noise)" in verdict_sentence(good)


def test_model_without_named_effects_has_no_row_of_its_own() -> None:
    assert "with_effects" not in shown_errors(diagnosis("none", 1.0))
    assert "with_effects" in shown_errors(diagnosis("mismatch", 4.0))
    assert "<td>with effects</td>" not in page(diagnosis("none", 1.0))


def test_verdict_names_the_parameters_that_are_most_wrong_and_those_at_a_limit() -> None:
    fitted = {
        "vehicle.mass": Estimate(1.65, 0.006, 1.64, 1.66, "kg"),
        "vehicle.yaw_inertia": Estimate(0.0722, 0.0004, 0.0716, 0.0728, "kg m2"),
        "motor.drive_gain": Estimate(6.82, 0.02, 6.79, 6.86, "N"),
        "motor.damping": Estimate(1.57, 0.005, 1.565, 1.575, "N s/m"),
        "tyre.front.B": Estimate(2.9, 0.01, 2.88, 2.92, "1/rad"),
        "tyre.rear.mu": Estimate(0.45, 0.001, 0.449, 0.45, "1", at_limit=True),
    }
    stated = {
        "vehicle.mass": 1.65, "vehicle.yaw_inertia": 0.06, "motor.drive_gain": 8.2, "motor.damping": 1.56,
        "tyre.front.B": 2.75, "tyre.rear.mu": 0.42,
    }  # fmt: skip
    case = replace(diagnosis("parameters", 1.0), parameters=fitted, car_file_parameters=stated)
    sentence = verdict_sentence(case)
    assert (
        "Parameters of the car file are wrong: motor.drive_gain is 6.82 N (car file: 8.2 N), vehicle.yaw_inertia is "
        "0.0722 kg m² (car file: 0.06 kg m²), tyre.front.B is 2.9 1/rad (car file: 2.75 1/rad) and 1 more differs."
        in sentence
    )
    assert "tyre.rear.mu ends at the limit of the range in the car file; widen it and diagnose again." in sentence
    assert case.to_dict()["parameters"]["motor.drive_gain"]["car_file"] == 8.2
    assert '<th class="n">car file</th>' in page(case)


def test_candidate_without_a_test_has_no_gain(monkeypatch: pytest.MonkeyPatch) -> None:
    """The page has no row for it; a gain of 0 would rank before candidates that were tested and failed."""
    for name, value in (("_traces", ()), ("_regimes", {}), ("scores_by_step", ())):
        monkeypatch.setattr(f"carlab.diagnosis.report.figure_data.{name}", lambda *arguments, value=value: value)
    fit = Fit(SimulatorConfig(), (), np.zeros(0), 0.0, np.zeros(3))
    untested = Candidate("motor_lag", fit, 5.0)
    failed = replace(untested, effect="road_slope", left_out_gain=-2.0, left_out_gain_error=1.0, left_out_loss=fit.loss)
    found = SimpleNamespace(effects=(), first_candidates=(untested, failed))
    scored = SimpleNamespace(found=found, problem=SimpleNamespace(settings=DEFAULT))
    figure_data = figure_data_of(scored, None)  # type: ignore[arg-type]
    assert np.isnan(figure_data.candidates[0][1])
    assert figure_data.candidates[1][1] == -2.0
    shown = html.unescape(render_page(diagnosis("none", 1.0), figure_data))
    assert "road_slope" in shown
    assert "motor_lag" not in shown


def test_unit_of_a_regime_has_superscripts_as_elsewhere() -> None:
    assert regime_clause("lateral acceleration > 2 m/s2") == "mostly where lateral acceleration > 2 m/s²"
    assert regime_clause("|steering rate| > 2.5 /s") == "mostly where |steering rate| > 2.5 /s"
    assert regime_clause("|steering rate| > 0 /s") == "mostly while the steering changes"


def test_car_that_changed_before_the_held_out_recordings_is_not_missing_physics() -> None:
    changed = replace(diagnosis("unexplained", 12.9), fitted_score=0.8)
    sentence = verdict_sentence(changed)
    assert sentence.startswith(
        "The refitted simulator agrees with the fitted recordings (0.8 noise floors) but not with the held-out ones "
        "(12.9 noise floors, 0.0258 m after 1 s)."
    )
    assert "changed between them (carlab compare names the change), or" in sentence
    assert verdict_title(changed) == "The held-out recordings differ from the fitted ones"
    assert "carlab compare" in next_drive(changed)[1]
    assert curves_advice(changed) == ""
    shown = page(changed)
    assert "odd in speed" not in shown
    similar = verdict_sentence(replace(diagnosis("unexplained", 1.23), fitted_score=1.14))
    assert "its error on the held-out ones is little above the noise (1.23 noise floors," in similar
    assert "changed" not in similar
    lacking = replace(changed, fitted_score=9.0)
    assert verdict_sentence(lacking).startswith("The simulator lacks physics")
    assert verdict_title(lacking) == "Physics outside the catalogue is missing"


def test_physics_of_the_fitted_recordings_alone_is_not_denied() -> None:
    mixed = replace(diagnosis("none", 0.8), unexplained=None, fitted_score=12.6)
    assert "On the fitted recordings, the error of the refit is 12.6 noise floors" in verdict_sentence(mixed)
    assert "On the fitted recordings" not in verdict_sentence(replace(mixed, fitted_score=1.1))
    assert "On the fitted recordings" in verdict_sentence(replace(mixed, verdict="parameters"))


@pytest.mark.parametrize("residual", [None, REST])
def test_effects_that_explain_the_fitted_recordings_lack_no_physics_there(residual: Unexplained | None) -> None:
    """For example, play in the steering has errors in the first windows of a held-out drive, which have no history."""
    found = replace(diagnosis("mismatch", 12.9, with_effects=2.1), unexplained=residual, fitted_score=0.9)
    sentence = verdict_sentence(found)
    assert "On the fitted recordings, this error is 0.9 noise floors: the held-out recordings have" in sentence
    assert "the diagnosis does not find" not in sentence
    lacking = verdict_sentence(replace(found, fitted_score=1.9))
    assert "On the fitted recordings" not in lacking
    assert ("the diagnosis does not find" in lacking) is (residual is None)


def test_ceiling_without_an_excess_has_a_sentence() -> None:
    without = diagnosis("none", 0.8, black_box=16.0)
    assert ceiling_sentence(without) == "The refit has no error above the noise floor, so nothing is left to predict."
    assert ceiling_sentence(diagnosis("none", 0.8)) == ""


def test_report_without_a_fit_advises_a_drive_and_names_the_car_file_as_given() -> None:
    short = "The recordings to fit contain 2 s of driving."
    undecided = replace(inconclusive(), sentence=short, advice=short)
    assert next_drive(undecided) == ("excitation", "Diagnose this drive together with these recordings.")
    assert "the car file as given" in page(undecided)
    text = model_toml(undecided, SimulatorConfig(), None)
    assert "# Not fitted: the car file as given." in text
    assert "# Fitted to" not in text
