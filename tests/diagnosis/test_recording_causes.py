"""The report states faults of the recording that look like physics: limited commands, stamps and filtered poses."""

from collections.abc import Callable
from dataclasses import replace

import pytest

from carlab.diagnosis.findings import DataFault, Diagnosis, EffectFinding
from carlab.diagnosis.report.recording_causes import recording_causes
from tests.diagnosis.report_material import (
    changed,
    estimate,
    lag_finding,
    mismatch,
    no_mismatch,
    parameters_only,
    unexplained_physics,
)

LIMITED = DataFault("limited_commands", "steering", 900, "reported: the log or the radio limits the command.")


def lag(effect_id: str, parameter: str, value_s: float) -> EffectFinding:
    finding = replace(lag_finding(), id=effect_id, parameters={parameter: estimate(value_s, 0.003, "s")})
    return replace(finding, indistinguishable_from=(), separating_drive="")


STEERING_LAG = lag("steering_lag", "time_constant", 0.06)
MOTOR_LAG = lag("motor_lag", "time_constant", 0.05)
LATENCY = lag("mocap_latency", "latency", 0.05)


@pytest.mark.parametrize(
    "effects",
    [
        (STEERING_LAG, MOTOR_LAG),
        (lag("steering_delay", "delay", 0.015), lag("throttle_delay", "delay", 0.012)),
        (MOTOR_LAG, lag("steering_delay", "delay", 0.05), lag("mocap_latency", "latency", 0.0)),
        (lag("command_delay", "extra_delay", 0.05), lag("motor_lag", "time_constant", 0.02)),
    ],
)  # fmt: skip
def test_equal_delays_of_both_commands_may_be_a_filter_of_the_poses(effects: tuple[EffectFinding, ...]) -> None:
    sentence = changed(mismatch(), effects=effects).sentence
    assert "A filter of the poses in the motion-capture software makes both late by a similar time" in sentence
    assert "Switch off the smoothing" in sentence


@pytest.mark.parametrize(
    "effects",
    [
        (STEERING_LAG,),
        (STEERING_LAG, lag("motor_lag", "time_constant", 0.2)),
        (lag("command_delay", "extra_delay", 0.05),),
        (LATENCY, lag("velocity_filter_lag", "time_constant", 0.05)),
    ],
)
def test_other_delays_are_no_filter_of_the_poses(effects: tuple[EffectFinding, ...]) -> None:
    assert recording_causes(changed(mismatch(), effects=effects)) == ""


def test_latency_counts_in_addition_to_that_of_the_car_file() -> None:
    """A latency of 50 ms in place of 49 ms delays nothing."""
    effects = (lag("steering_lag", "time_constant", 0.02), LATENCY)
    known = changed(mismatch(), effects=effects, car_file_parameters={"mocap.latency": 0.049})
    assert recording_causes(known) == ""
    assert "The steering is 0.07 s late and the drive 0.05 s." in recording_causes(changed(mismatch(), effects=effects))


@pytest.mark.parametrize("make", [mismatch, no_mismatch, parameters_only])
def test_fitted_latency_far_above_its_prior_is_stated(make: Callable[[], Diagnosis]) -> None:
    """Only a delay of the commands can be so long; no effect explains it, because the latency does."""
    delay = {"timing.command_delay": 0.03}
    late = {"mocap.latency": estimate(0.056, 0.0002, "s")}
    sentence = changed(make(), parameters=late, car_file_parameters=delay).sentence
    assert "The poses are 0.056 s late (mocap.latency, which the car file does not state)." in sentence
    assert "A command delay of 0.078 s, not 0.03 s as in the car file," in sentence
    usual = {"mocap.latency": estimate(0.02, 0.0002, "s")}
    assert "late (mocap.latency" not in changed(make(), parameters=usual, car_file_parameters=delay).sentence
    stated = delay | {"mocap.latency": 0.055}
    assert "late (mocap.latency" not in changed(make(), parameters=late, car_file_parameters=stated).sentence
    hidden = late | {"timing.command_delay": estimate(0.05, 0.001, "s")}
    assert "late (mocap.latency" not in changed(make(), parameters=hidden, car_file_parameters=delay).sentence


def test_limited_commands_replace_the_class_of_missing_physics() -> None:
    limited = changed(unexplained_physics(), data_faults=(LIMITED,))
    assert "Class of the missing physics" in unexplained_physics().sentence
    assert "Class of the missing physics" not in limited.sentence
    assert "The log or the radio limits the steering." in limited.sentence
    assert limited.advice.startswith("Record again with a log of the commands that the car executes")


def test_commands_that_predict_the_recordings_are_not_limited() -> None:
    """A motor with a dead band responds more near the largest command, as with a log that limits the commands."""
    held, effects = dict(mismatch().held_out), (STEERING_LAG,)
    for score, is_stated in ((1.2, False), (3.0, True)):
        held["with_effects"] = replace(held["with_effects"], score=score)
        found = changed(mismatch(), effects=effects, held_out=held, data_faults=(LIMITED,))
        assert ("The log or the radio limits the steering." in found.sentence) is is_stated
        assert found.advice.startswith("Record again with a log of the commands") is is_stated


def test_wrong_frame_rate_is_stated_with_the_verdict() -> None:
    fault = DataFault("wrong_frame_rate", "t, vx, vy, yaw_rate", 900, "repaired: the velocities were multiplied.")
    assert "The stamps probably have a wrong frame rate" in changed(mismatch(), data_faults=(fault,)).sentence


def test_error_of_slow_poses_is_no_missing_physics() -> None:
    """At 20 Hz the simulator of the car itself has an error above the noise."""
    fault = DataFault("slow_poses", "vx, vy, yaw_rate", 900, "reported: the poses are 0.05 s apart.")
    held = dict(mismatch().held_out)
    held["with_effects"] = replace(held["with_effects"], score=1.9)
    above = changed(mismatch(), held_out=held).sentence
    assert "the simulator lacks physics that the diagnosis does not find" in above
    slow = changed(mismatch(), held_out=held, data_faults=(fault,)).sentence
    assert "the simulator lacks physics" not in slow
    assert "The poses are so far apart that the estimated velocities have errors above the noise" in slow
    held["with_effects"] = replace(held["with_effects"], score=1.1)
    assert "so far apart" not in changed(mismatch(), held_out=held, data_faults=(fault,)).sentence


def test_model_that_predicts_worse_than_the_car_file_is_stated() -> None:
    """A fit to 17 s of driving extrapolates."""
    held = dict(mismatch().held_out)
    held["with_effects"] = replace(held["with_effects"], score=51.0)
    worse = changed(mismatch(), held_out=held).sentence
    assert "against 51 noise floors): the fitted recordings may be too short or too uniform to determine" in worse
    assert "than model.toml" not in mismatch().sentence
    held["nominal"] = replace(held["nominal"], score=0.9)
    held["with_effects"] = replace(held["with_effects"], score=1.1)
    assert "than model.toml" not in changed(mismatch(), held_out=held).sentence
