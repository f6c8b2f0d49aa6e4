"""What a report says about the residual, and about model.toml, agrees with its errors."""

import html
from dataclasses import replace
from types import SimpleNamespace

import pytest

from carlab.diagnosis.final_models import measured_curves
from carlab.diagnosis.findings import CurveTrial, Diagnosis, FigureData, FitErrors, SearchExtent, Unexplained
from carlab.diagnosis.report.curves import curves_advice
from carlab.diagnosis.report.html_page import render_page
from carlab.diagnosis.report.next_drive import next_drive
from carlab.diagnosis.report.sentences import verdict_sentence
from carlab.diagnosis.report.write import completed
from carlab.diagnosis.selection.problem import RunControl
from carlab.diagnosis.settings import DEFAULT
from tests.diagnosis.report_material import lag_finding

REST = Unexplained(1.0, ("vx",), "speed > 1 m/s", "odd in speed", "coast_brake: coefficient 1 N s/m")


def diagnosis(verdict: str, refit: float, **models: float) -> Diagnosis:
    """A diagnosis with the scores of its models [noise floors], and the residual ``REST``."""
    scores = {"nominal": refit, "refit": refit, "with_effects": refit, **models, "noise_floor": 1.0}
    held_out = {name: FitErrors(0.002 * s, 0.01 * s, 0.01, 0.01, 0.05, s) for name, s in scores.items()}
    effects = (replace(lag_finding(), indistinguishable_from=()),) if verdict == "mismatch" else ()
    return Diagnosis(verdict, "", effects, {}, 1.0, held_out, REST, (), (), 0, 1.0)


def page(case: Diagnosis) -> str:
    """The page of a complete report, without escapes."""
    return html.unescape(render_page(completed(case), FigureData()))


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
def test_residual_of_a_partial_search_is_searched_before_it_is_driven_or_measured(
    search: SearchExtent, remedy: str
) -> None:
    partial = replace(diagnosis("mismatch", 12.5, with_effects=9.7), search=search)
    assert next_drive(partial) == ("", f"Diagnose these recordings again {remedy}, before another drive.")
    assert curves_advice(partial) == ""


def test_small_share_of_a_large_excess_is_stated_as_an_error_above_the_noise() -> None:
    small = replace(REST, share=0.015)
    far = replace(diagnosis("mismatch", 49.4, with_effects=6.12), unexplained=small)
    assert verdict_sentence(far).endswith("the simulator lacks physics that the diagnosis does not find.")
    near = replace(diagnosis("mismatch", 49.4, with_effects=1.1), unexplained=None)
    assert "above the noise" not in verdict_sentence(near)


def test_page_states_the_next_command_once() -> None:
    assert page(diagnosis("unexplained", 13.2)).count("carlab drive --policy coast_down") == 1
