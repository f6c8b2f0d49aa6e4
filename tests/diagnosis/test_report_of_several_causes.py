"""Test the statements about several effects, wrong parameters and late commands."""

from dataclasses import replace

from carlab.diagnosis.findings import Estimate, FitErrors, Unexplained
from carlab.diagnosis.report.effect_lines import effect_lines
from carlab.diagnosis.report.next_drive import with_texts
from carlab.diagnosis.report.sentences import effect_sentence, verdict_sentence
from tests.helpers.report_diagnoses import around, diagnosis, finding


def test_wrong_parameters_come_before_a_small_residual() -> None:
    """A car whose front tyres have less grip: the refit leaves little, and the cause is the number of the car file."""
    unexplained = Unexplained(1.0, ("yaw",), "everywhere alike", "odd in steering", "a_x = -1 |d|")
    whole = replace(
        diagnosis("unexplained", refit=1.4),
        unexplained=unexplained,
        parameters={"tyre.front.mu": around(0.42, "1")},
        car_file_parameters={"tyre.front.mu": 0.62},
    )
    assert verdict_sentence(whole).startswith(
        "Parameters of the car file are wrong: tyre.front.mu is 0.42 (car file: 0.62). With fitted parameters, the "
        "position error on held-out recordings after 1 s goes from 0.1 m to 0.1 m (all channels: from 6 to 1.4 noise "
        "floors). The simulator also lacks physics that no effect of the catalogue explains."
    )
    refit = FitErrors(0.1, 0.1, 0.1, 0.1, 0.1, 2.5)
    partly = verdict_sentence(replace(whole, held_out={**whole.held_out, "refit": refit}))
    assert "tyre.front.mu is 0.42 (car file: 0.62) (these values may compensate for missing physics)." in partly
    refit = FitErrors(0.1, 0.1, 0.1, 0.1, 0.1, 5.0)
    little = replace(whole, held_out={**whole.held_out, "refit": refit})
    assert verdict_sentence(little).startswith("The simulator lacks physics that no effect of the catalogue explains.")


def test_latency_is_stated_with_that_of_the_car_file() -> None:
    found = diagnosis("mismatch", finding("mocap_latency"))  # of 0.03 s
    (effect,) = with_texts(replace(found, car_file_parameters={"mocap.latency": 0.012})).effects
    assert effect.sentence.endswith("at 90 %). The car file states 0.012 s.")
    (effect,) = with_texts(replace(found, car_file_parameters={"mocap.latency": 0.04})).effects
    assert effect.sentence.endswith(
        "The car file states 0.04 s. The log may have the commands late: if its rows are poses with the newest "
        "command, a command is half a row old on average."
    )


def test_lines_of_several_effects_state_how_much_each_one_matters() -> None:
    lag, drag = finding("steering_lag"), finding("cornering_drag")
    drag = replace(drag, evidence=replace(drag.evidence, held_out_error_reduction=0.021))
    lines = effect_lines(with_texts(diagnosis("mismatch", lag, drag)))
    ends = [line.partition(" Added last, ")[2] for line in lines]
    assert ends == [f"the effect lowers the error on held-out recordings by {share} %." for share in ("30", "2.1")]
    assert effect_lines(with_texts(diagnosis("mismatch", lag))) == [effect_sentence("steering_lag", lag.parameters)]


def test_line_of_an_improbable_name_states_its_probability() -> None:
    probable = finding("steering_lag")
    improbable = replace(probable, confidence=0.1)
    in_set = replace(finding("steering_lag", ("steering_delay",)), confidence=0.1)
    lines = [effect_lines(with_texts(diagnosis("mismatch", each)))[0] for each in (probable, improbable, in_set)]
    stated = [line.endswith(" The name is uncertain (probability 10 %).") for line in lines]
    assert stated == [False, True, False]
    assert lines[2].endswith(" Probably none of these names is correct (probability of one: 20 %).")
    likely_set = replace(in_set, confidence=0.3)
    assert "Probably none" not in effect_lines(with_texts(diagnosis("mismatch", likely_set)))[0]


def test_line_states_that_an_effect_may_be_absent() -> None:
    damping = finding("yaw_damping")
    (present,) = effect_lines(with_texts(diagnosis("mismatch", damping)))
    absent = replace(damping, parameters={"coefficient": Estimate(0.012, 0.01, 0.0, 0.029, "N m s/rad")})
    (uncertain,) = effect_lines(with_texts(diagnosis("mismatch", absent)))
    assert uncertain.endswith(" Its 90 % interval includes the value without the effect.")
    assert "without the effect" not in present
    stated = replace(absent, car_file_values={"coefficient": 0.05})
    assert "without the effect" not in effect_lines(with_texts(diagnosis("mismatch", stated)))[0]


def test_effects_that_raise_the_score_explain_no_negative_share() -> None:
    """The position error may fall although the error of all channels rises."""
    rest = Unexplained(1.21, ("yaw",), "everywhere alike", "odd in steering", "dr/dt += -1 d")
    worse = replace(diagnosis("mismatch", finding("steering_lag"), refit=4.0, with_effects=4.4), unexplained=rest)
    sentence = verdict_sentence(worse)
    assert "(all channels: from 4 to 4.4 noise floors), so the effects do not lower the error over" in sentence
    assert "over all channels, and their names are uncertain." in sentence
    assert sentence.endswith("The refit's squared excess over the noise floor stays unexplained.")
    assert "%" not in sentence
