"""Test the texts of effects, confusable effects and verdicts."""

import math
import re
from dataclasses import replace

import pytest

from carlab.core.manoeuvres import MANOEUVRES
from carlab.diagnosis.findings import (
    Ceiling,
    DataFault,
    Estimate,
    SearchExtent,
    Skill,
    Unexplained,
)
from carlab.diagnosis.report.curves import ceiling_sentence, curves_advice
from carlab.diagnosis.report.next_drive import drive_command, next_drive
from carlab.diagnosis.report.numbers import number, percent, unit_text
from carlab.diagnosis.report.residual import explained_share, formula_symbols
from carlab.diagnosis.report.sentences import (
    confidence_text,
    effect_sentence,
    refutation_sentence,
    separating_drive,
    separating_reason,
    verdict_sentence,
    verdict_title,
)
from carlab.diagnosis.unexplained.description import ChosenTerm, ResidualModel
from carlab.diagnosis.unexplained.residual_terms import TERMS
from sim_backends.effects import CATALOGUE, confusable_effects
from tests.helpers.report_diagnoses import around, diagnosis, finding

CONFUSABLE = confusable_effects()

PAIRS = [(a, b) for a in CONFUSABLE for b in CONFUSABLE[a]]
INSEPARABLE_PAIR = {"command_delay", "mocap_latency"}


@pytest.mark.parametrize("effect_id", CATALOGUE)
def test_sentence_of_an_effect_contains_each_parameter_with_its_unit(effect_id: str) -> None:
    parameters = {p.name: around(p.typical, p.unit) for p in CATALOGUE[effect_id].parameters}
    sentence = effect_sentence(effect_id, parameters)
    assert sentence.startswith("Left out: ")
    assert sentence.endswith(".")
    assert sentence.count(" at 90 %") == 1
    assert not re.search(r"[{}_]|nan|unknown|  ", sentence)
    hidden = {"B_front", "C_front", "B_rear", "C_rear"}  # shape factors are not in the sentence
    for p in CATALOGUE[effect_id].parameters:
        if p.choices:
            assert p.choices[0] in sentence
        if p.choices or p.name in hidden:
            continue
        shown = {number(abs(p.typical)), number(100 * abs(p.typical)), number(6000 * abs(p.typical))}
        assert any(re.search(rf"(?<![\d.]){re.escape(n)} ", sentence) for n in shown), (p.name, sentence)
        unit = unit_text(p.unit)
        assert unit in sentence or "%" in sentence


@pytest.mark.parametrize("effect_id", CATALOGUE)
def test_each_effect_has_a_refutation(effect_id: str) -> None:
    assert re.fullmatch(r"This would be wrong if .{20,}\.", refutation_sentence(effect_id))


@pytest.mark.parametrize("effect_id", CATALOGUE)
def test_sentence_allows_missing_and_infinite_numbers(effect_id: str) -> None:
    assert effect_sentence(effect_id, {}).startswith("Left out: ")
    nonfinite = {
        p.name: Estimate(math.inf, math.nan, math.nan, math.inf, p.unit) for p in CATALOGUE[effect_id].parameters
    }
    assert "inf" not in effect_sentence(effect_id, nonfinite).replace("infl", "")


def test_sentence_of_the_servo_lag() -> None:
    lag = Estimate(0.11, 0.0091, 0.095, 0.125, "s")
    expected = "Left out: the steering servo lags by 0.11 s (0.095 to 0.125 at 90 %)."
    assert effect_sentence("steering_lag", {"time_constant": lag}) == expected
    bounded = effect_sentence("steering_lag", {"time_constant": replace(lag, at_limit=True)})
    assert bounded == expected.replace("90 %", "90 %; at the limit of its range")


@pytest.mark.parametrize(("angle", "side"), [(0.05, "left"), (-0.05, "right")])
def test_sign_becomes_a_side_and_the_interval_is_mirrored(angle: float, side: str) -> None:
    sentence = effect_sentence("steering_offset", {"angle": around(angle, "rad")})
    assert f"0.05 rad (0.04 to 0.06 at 90 %) to the {side}" in sentence


def test_interval_across_zero_states_that_the_sign_is_not_certain() -> None:
    sentence = effect_sentence("lateral_bias", {"force": Estimate(-0.2, 0.3, -0.7, 0.3, "N")})
    assert "0.2 N (−0.3 to 0.7 at 90 %; its sign is not certain) pushes the car to the right." in sentence


def test_coordinates_of_a_place_have_no_uncertain_sign() -> None:
    place = {"x": around(3.0, "m"), "y": Estimate(0.0018, 0.006, -0.0081, 0.0117, "m")}
    sentence = effect_sentence("low_friction_patch", finding("low_friction_patch").parameters | place)
    assert sentence.endswith("y = 0.0018 m (−0.0081 to 0.0117).")


def test_effect_outside_the_catalogue_is_named_by_its_id() -> None:
    assert "wind gust" in effect_sentence("wind_gust", {"force": around(1.0, "N")})
    assert refutation_sentence("wind_gust").startswith("This would be wrong if")


def test_confusable_effects_are_symmetric() -> None:
    assert set(CONFUSABLE) == set(CATALOGUE)
    assert all(a in CONFUSABLE[b] for a, b in PAIRS)
    assert set(CONFUSABLE["steering_lag"]) == {
        *("steering_delay", "steering_rate_limit", "tyre_relaxation", "velocity_filter_lag"),
    }
    assert set(CONFUSABLE["rolling_resistance"]) == {"throttle_deadband", "drag_brake"}
    assert CONFUSABLE["low_friction_patch"] == ()


@pytest.mark.parametrize(("one", "other"), PAIRS)
def test_each_confusable_pair_has_a_separating_drive_or_states_that_none_exists(one: str, other: str) -> None:
    drive = separating_drive(one, (other,))
    assert drive == separating_drive(other, (one,))
    assert len(separating_reason(one, (other,))) > 20
    if {one, other} == INSEPARABLE_PAIR:
        assert drive == ""
        assert "No manoeuvre separates" in separating_reason(one, (other,))
    else:
        assert drive in MANOEUVRES


def test_drive_that_separates_most_pairs_of_a_set_is_chosen() -> None:
    assert separating_drive("throttle_nonlinearity", ("motor_saturation", "throttle_deadband")) == "throttle_ramp"
    assert separating_drive("motor_saturation", ("aerodynamic_drag", "throttle_nonlinearity")) in MANOEUVRES
    assert separating_drive("yaw_damping", ()) == ""


def test_mismatch_names_its_effects_and_its_sets() -> None:
    text = verdict_sentence(diagnosis("mismatch", finding("motor_lag", ("throttle_delay",)), finding("yaw_damping")))
    assert (
        "leaves out two effects: a lag of the motor "
        "(or a delay of the throttle; these recordings do not distinguish them)" in text
    )
    assert "and a yaw damping moment" in text
    assert "from 4 to 2.5 noise floors), which explains 65 % of the refit's squared excess over the noise floor" in text
    assert "distinguish" not in verdict_sentence(diagnosis("mismatch", finding("motor_lag")))


def test_explained_share_of_the_squared_excess() -> None:
    assert explained_share(diagnosis("mismatch", refit=4.0, with_effects=1.0)) == pytest.approx(1.0)
    assert math.isnan(explained_share(diagnosis("none", refit=1.0, with_effects=1.0)))
    text = verdict_sentence(diagnosis("mismatch", finding("motor_lag"), refit=4.0, with_effects=0.97))
    assert "explains 100 % of the refit's squared excess over the noise floor" in text


def test_first_sentence_states_where_constant_velocity_is_better_and_why() -> None:
    fitted = diagnosis("mismatch", finding("motor_lag"), refit=60.0, with_effects=47.8)
    better = Skill(1, "all", 40, 0.1, 0.5, 2.0, 6.0)
    worse = Skill(2, "low speed", 20, 0.15, 0.06, 1.0, -4.0)
    not_significant = Skill(2, "high speed", 20, 0.15, 0.14, 1.0, -1.0)
    assert verdict_sentence(replace(fitted, skill=(better, not_significant))) == verdict_sentence(fitted)
    expected = (
        "This model predicts held-out recording 2 at low speed worse than constant velocity (0.15 m against 0.06 m "
        "after 1 s). Velocities hardly change there, so this drive does not separate the possible causes. "
        "The simulator leaves out"
    )
    assert verdict_sentence(replace(fitted, skill=(better, worse))).startswith(expected)
    wrong = replace(worse, constant_velocity_m=0.12)
    assert "The model is wrong there." in verdict_sentence(replace(fitted, skill=(wrong,)))
    larger_rms = replace(worse, constant_velocity_m=0.2)  # a smaller mean error, with a few large ones
    assert verdict_sentence(replace(fitted, skill=(larger_rms,))) == verdict_sentence(fitted)


@pytest.mark.parametrize("verdict", ["mismatch", "parameters", "none", "data", "unexplained", "inconclusive"])
def test_each_verdict_has_a_sentence_without_scores(verdict: str) -> None:
    without_scores = replace(diagnosis(verdict), held_out={})
    assert verdict_sentence(without_scores)[0].isupper()
    assert verdict_sentence(without_scores).endswith(".")
    assert not re.search(r"nan|None|  ", verdict_sentence(without_scores))
    assert len(verdict_title(without_scores)) > 10
    drive, why = next_drive(without_scores)
    assert drive in ("", "excitation", *MANOEUVRES)
    assert why


def test_verdicts_state_faults_residuals_and_reasons() -> None:
    fault = DataFault("wrong_unit", "yaw", 3, "unusable")
    assert "(wrong unit)" in verdict_sentence(replace(diagnosis("data"), data_faults=(fault,)))
    unexplained = Unexplained(0.7, ("vx",), "speed > 1 m/s", "even in steering", "a_x = -1 |d|")
    unexplained_diagnosis = replace(diagnosis("unexplained"), unexplained=unexplained)
    assert (
        "longitudinal velocity, mostly where speed > 1 m/s. Class of the missing physics: even in steering."
        in verdict_sentence(unexplained_diagnosis)
    )
    assert next_drive(unexplained_diagnosis)[0] == "coast_down"
    why = "Too short; drive throttle_ramp."
    inconclusive = replace(diagnosis("inconclusive"), sentence=why, advice=why)
    assert verdict_sentence(inconclusive) == f"No verdict. {why}"
    assert next_drive(inconclusive)[0] == "throttle_ramp"


@pytest.mark.parametrize(("verdict", "which"), [("none", "nominal"), ("parameters", "refit")])
def test_error_above_the_noise_is_stated(verdict: str, which: str) -> None:
    far, near = diagnosis(verdict), diagnosis(verdict)
    near = replace(near, held_out={k: replace(v, score=1.02) for k, v in near.held_out.items()})
    assert far.held_out[which].score > 3.0
    assert "the simulator lacks physics that the diagnosis does not find" in verdict_sentence(far)
    assert "Only" not in verdict_title(far)
    assert "lacks physics" not in verdict_sentence(near)


@pytest.mark.parametrize(("verdict", "share", "is_advised"), [
    ("mismatch", 0.37, True),
    ("unexplained", 0.7, True),
    ("mismatch", 0.05, False),
    ("inconclusive", 0.7, False),
])  # fmt: skip
def test_curves_are_advised_for_a_relevant_residual(verdict: str, share: float, is_advised: bool) -> None:
    unexplained = Unexplained(share, ("vx",), "everywhere alike", "", "")
    assert ("--curves" in curves_advice(replace(diagnosis(verdict), unexplained=unexplained))) == is_advised
    assert curves_advice(diagnosis(verdict)) == ""
    stopped = replace(diagnosis(verdict), unexplained=unexplained, search=SearchExtent(False, "user"))
    assert curves_advice(stopped) == "", "a complete search comes first"


def test_next_drive_separates_the_strongest_set() -> None:
    drive, why = next_drive(diagnosis("mismatch", finding("yaw_damping"), finding("motor_lag", ("throttle_delay",))))
    assert drive == "throttle_steps"
    assert "a lag of the motor from a delay of the throttle" in why
    assert drive_command(drive) == "carlab drive --policy throttle_steps --no-place"
    drive, why = next_drive(diagnosis("mismatch", finding("command_delay", ("mocap_latency",))))
    assert drive == ""
    assert "No manoeuvre separates" in why


def test_confidence_words_match_the_probability() -> None:
    assert confidence_text(0.99) == "almost certain"
    assert confidence_text(0.6) == "more likely than not"
    assert confidence_text(0.4).startswith("uncertain")
    assert confidence_text(0.49, 1) == "one of 2 indistinguishable effects"


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        (0.0, "0"),
        (0.11, "0.11"),
        (-0.4761, "−0.476"),
        (123.4, "123"),
        (98765.4, "98765"),
        (0.00008, "0.00008"),
        (1.0, "1"),
        (math.inf, "no limit"),
        (math.nan, "unknown"),
    ],
)
def test_numbers_have_three_significant_digits(value: float, expected: str) -> None:
    assert number(value) == expected


@pytest.mark.parametrize(
    ("share", "expected"),
    [(0.31, "31 %"), (0.021, "2.1 %"), (0.0, "0 %"), (0.0002, "0.02 %"), (0.998, "more than 99 %"), (1.0, "100 %")],
)
def test_shares_are_not_rounded_to_0_or_100_per_cent(share: float, expected: str) -> None:
    assert percent(share) == expected


@pytest.mark.parametrize(("stopped_by", "remedy"), [("budget", "--budget inf"), ("user", "Diagnose again")])
def test_remedy_of_a_search_that_was_cut_short_fits_its_cause(stopped_by: str, remedy: str) -> None:
    cut = replace(diagnosis("none"), search=SearchExtent(False, stopped_by, 300.0))
    sentence = verdict_sentence(cut)
    assert remedy in sentence
    assert ("--budget" in sentence) == (stopped_by == "budget")


def test_search_that_was_cut_short_has_not_excluded_the_catalogue() -> None:
    unexplained = Unexplained(0.7, ("vx",), "speed > 1 m/s", "even in steering", "a_x = -1 |d|")
    cut = replace(diagnosis("unexplained"), unexplained=unexplained, search=SearchExtent(False, "budget", 20.0))
    sentence = verdict_sentence(cut)
    assert sentence.startswith("The search for effects did not finish")
    assert "no effect of the catalogue" not in sentence
    assert "even in steering" not in sentence
    assert next_drive(cut) == ("", "Diagnose these recordings again with a longer time limit, before another drive.")


def test_restricted_search_has_not_excluded_the_catalogue() -> None:
    """A car with a lag of the servo, diagnosed with --effects aerodynamic_drag, lacks physics of the catalogue."""
    unexplained = Unexplained(0.7, ("yaw",), "speed > 1 m/s", "even in steering", "a_x = -1 |d|")
    whole = replace(diagnosis("unexplained"), unexplained=unexplained)
    restricted = replace(whole, search=SearchExtent(effects=("aerodynamic_drag", "motor_lag")))
    sentence = verdict_sentence(restricted)
    assert "no effect of the catalogue" not in sentence
    assert "The search was restricted to these effects: aerodynamic_drag and motor_lag." in sentence
    assert verdict_title(restricted) != verdict_title(whole) == "Physics outside the catalogue is missing"
    assert verdict_title(replace(whole, search=SearchExtent(False, "user"))) == verdict_title(restricted)
    assert next_drive(restricted) == ("", "Diagnose these recordings again without --effects, before another drive.")


def test_delays_of_both_commands_do_not_contradict_each_other() -> None:
    """Each is additional to the delay of the car file; neither command is later than the other by its number."""
    for effect_id in ("steering_delay", "throttle_delay"):
        sentence = effect_sentence(effect_id, {"delay": around(0.06, "s")})
        assert "has an additional delay of 0.06 s" in sentence
        assert "later than" not in sentence


@pytest.mark.parametrize(("seconds", "at_limit", "is_late"), [(-0.06, True, True), (-0.06, False, False)])
def test_a_delay_of_zero_is_a_log_with_late_commands(seconds: float, at_limit: bool, is_late: bool) -> None:
    delay = replace(around(seconds, "s"), at_limit=at_limit)
    sentence = effect_sentence("command_delay", {"extra_delay": delay})
    assert ("the log may have the commands later than they act" in sentence) is is_late


@pytest.mark.parametrize(("seconds", "is_late"), [(-0.005, True), (0.005, False)])
def test_a_delay_below_the_car_file_may_be_that_of_commands_in_rows_of_poses(seconds: float, is_late: bool) -> None:
    sentence = effect_sentence("command_delay", {"extra_delay": around(seconds, "s")})
    assert ("a command is half a row old on average" in sentence) is is_late


def test_number_at_a_limit_without_information_has_no_interval() -> None:
    at_limit = Estimate(0.0, 0.0, 0.0, 0.0, "s", at_limit=True)
    sentence = effect_sentence("mocap_latency", {"latency": at_limit})
    assert sentence.endswith("latency of 0 s (at the limit of its range; interval unknown).")
    known = replace(at_limit, high90=0.001)
    assert "(0 to 0.001 at 90 %; at the limit of its range)" in effect_sentence("mocap_latency", {"latency": known})


def test_ceiling_without_a_predictable_part_states_no_share_of_it() -> None:
    nothing, half = Ceiling(0.0, 0.0, 1.0), Ceiling(0.3, 0.3, 0.4)
    assert ceiling_sentence(replace(diagnosis("mismatch"), ceiling=nothing)).endswith("predicts the other 100 %.")
    assert ceiling_sentence(replace(diagnosis("mismatch"), ceiling=half)).endswith("50 % of the predictable part.")


def test_verdict_none_does_not_deny_that_the_refit_has_a_smaller_error() -> None:
    """The score of the refit may be smaller by an amount that the fitted recordings do not confirm."""
    sentence = verdict_sentence(diagnosis("none", refit=5.0))
    assert "improves the prediction significantly" in sentence


def test_stages_that_the_user_ended_are_named() -> None:
    ended = replace(diagnosis("none"), search=SearchExtent(omitted=("measured curves", "black box")))
    assert verdict_sentence(ended).endswith("so this report has no measured curves and no black box.")
    assert "The user" not in verdict_sentence(diagnosis("none"))


def test_each_sentence_about_the_residual_begins_with_a_capital_letter() -> None:
    """A share of 99.8 % is "more than 99 %", which does not begin with a number."""
    rest = Unexplained(0.998, ("yaw",), "everywhere alike", "", "")
    sentence = verdict_sentence(replace(diagnosis("mismatch", finding("yaw_damping")), unexplained=rest))
    assert "more than 99 %" in sentence
    assert not re.search(r"\. [a-z]", sentence)


def test_terms_of_a_class_are_numbered() -> None:
    terms = [ChosenTerm(term, channel, 1.0, 1.0) for term, channel in zip(TERMS[:2], (0, 1), strict=True)]
    one, two = (f"{c.term.statement}; acts on {name}" for c, name in zip(terms, ("vx", "vy"), strict=True))
    assert ResidualModel((terms[0],)).class_statement() == one
    assert ResidualModel(tuple(terms)).class_statement() == f"(1) {one}; (2) {two}"


def test_each_symbol_of_a_formula_has_its_meaning() -> None:
    """All terms of the library on all channels; functions, pi, yaw, dt and the unit m need no explanation."""
    plain = {"sin", "cos", "sign", "pi", "yaw", "m", "dt", "dvx", "dvy"}
    for term in TERMS:
        for channel in range(5):
            formula = ResidualModel((ChosenTerm(term, channel, 1.0, 1.0),)).formula()
            symbols = " ".join(entry.split(": ")[0] for entry in formula_symbols(formula).split("; "))
            words = set(re.findall(r"F_\w+/m|[a-z]+", formula)) - plain
            assert {{"dr": "r", "du": "u", "dd": "d"}.get(word, word) for word in words} == set(symbols.split())
    assert formula_symbols("dvx/dt += -0.3 du/dt") == "u: throttle in [-1, 1] after the delays of the car file"
    assert formula_symbols("wind: speed 2 m/s") == ""
