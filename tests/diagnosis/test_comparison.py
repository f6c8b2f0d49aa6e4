"""The comparison of two groups of recordings on simulated cars whose change is known."""

import json
from dataclasses import replace

import numpy as np
import pytest

import carlab
from carlab.cli import run
from carlab.cli.exit_codes import EXIT_INCONCLUSIVE
from carlab.core.errors import ConfigError, DataError
from carlab.diagnosis.comparison.compare import compare
from carlab.diagnosis.comparison.result import Change, Comparison
from carlab.diagnosis.findings import Estimate
from carlab.diagnosis.identification.fit_parameters import with_effect
from carlab.diagnosis.recordings import Inconclusive
from sim_backends import SimulatorConfig
from tests.helpers.recorded_drives import PERIOD_S, drive

CAR = SimulatorConfig(control_period_s=PERIOD_S)
SECONDS = 60.0
"""Length of a recording; a comparison needs 50 s."""
CANDIDATES = (
    *("steering_lag", "steering_offset", "motor_lag", "command_delay", "throttle_nonlinearity"),
    *("motor.drive_gain", "steering.max_angle", "tyre.rear.mu"),
)


def with_unknown_physics(config: SimulatorConfig) -> SimulatorConfig:
    """Add physics of the real car that the simulator of the comparison does not have."""
    return with_effect(config, "aerodynamic_drag").with_values({"effects.aerodynamic_drag.coefficient": 0.25})


@pytest.fixture(scope="module")
def first():
    return drive(with_unknown_physics(CAR), SECONDS, 21)


def second(config: SimulatorConfig, seed: int = 22):
    return drive(with_unknown_physics(config), SECONDS, seed)


@pytest.fixture(scope="module")
def unchanged():
    """A second recording of the same car."""
    return second(CAR)


LAG_S = 0.08


@pytest.fixture(scope="module")
def slower():
    """A recording of the car with a slower servo."""
    return second(with_effect(CAR, "steering_lag").with_values({"effects.steering_lag.time_constant": LAG_S}))


@pytest.fixture(scope="module")
def slower_servo(first, slower):
    return compare([first], [slower], CAR, candidates=CANDIDATES)


def test_change_is_named_with_its_size_although_the_simulator_lacks_physics(slower_servo):
    found = slower_servo
    assert found.verdict == "changed"
    assert [change.id for change in found.changes] == ["steering_lag"]
    assert found.changes[0].parameters["time_constant"].value == pytest.approx(LAG_S, rel=0.1)


@pytest.mark.parametrize("rows", [-70, 95])
def test_repaired_clock_offset_is_no_change_of_the_delay(first, unchanged, rows):
    """The delay of the repaired commands is known to about a row; a row later is no change either."""
    late = replace(unchanged, sent=np.roll(unchanged.sent, rows, axis=0))
    found = compare([first], [late], CAR, candidates=CANDIDATES)
    assert [fault.id for fault in found.data_faults] == ["clock_offset"]
    assert (found.verdict, found.changes) == ("nothing", ())


def test_interval_of_a_large_change_contains_it(slower_servo):
    estimate = slower_servo.changes[0].parameters["time_constant"]
    assert estimate.low90 <= LAG_S <= estimate.high90


@pytest.mark.slow
def test_changed_base_parameter_is_named(first):
    gain = CAR.values()["motor.drive_gain"]
    found = compare([first], [second(CAR.with_values({"motor.drive_gain": 0.85 * gain}))], CAR, candidates=CANDIDATES)
    assert [change.id for change in found.changes] == ["motor.drive_gain"]
    estimate = found.changes[0].parameters["motor.drive_gain"]
    assert estimate.low90 <= -0.15 * gain <= estimate.high90
    assert "motor.drive_gain changed" in found.changes[0].sentence.lower()


@pytest.mark.parametrize("seed", [22, pytest.param(23, marks=pytest.mark.slow)])
def test_same_car_has_no_change(first, seed):
    assert compare([first], [second(CAR, seed)], CAR, candidates=CANDIDATES).verdict == "nothing"


def test_stop_without_a_change_is_inconclusive(first):
    stopped = compare([first], [first], CAR, stop=lambda: True)
    assert (stopped.verdict, stopped.changes) == ("inconclusive", ())
    assert stopped.sentence == "The comparison was stopped before it found a change. Compare again for a result."


def test_stop_after_a_change_is_stated(first, slower, slower_servo):
    activities = []
    stopped = compare(
        [first],
        [slower],
        CAR,
        candidates=("steering_lag", "motor_lag", "motor.drive_gain"),
        progress=lambda activity, share: activities.append(activity),
        stop=lambda: "change 1" in activities,
    )
    assert stopped.verdict == "changed"
    assert not stopped.is_complete
    assert stopped.sentence.endswith("The comparison was stopped, so it may have missed further changes.")
    assert slower_servo.is_complete
    assert "stopped" not in slower_servo.sentence


def test_result_that_cannot_be_written_is_refused_with_one_sentence(first, unchanged, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(DataError, match="file"):
        carlab.compare([first], [unchanged], "sim", out=tmp_path / "file" / "out", stop=lambda: True)


def test_unusable_groups_are_refused_with_one_sentence(first):
    with pytest.raises(DataError, match=r"second group has 20 s of driving; a comparison needs 50 s"):
        compare([first], [drive(CAR, 20.0, 3)], CAR)
    still = np.zeros_like(first.sent)
    constant = replace(first, sent=still, requested=still)
    with pytest.raises(DataError, match="steering command is constant"):
        compare([first], [constant], CAR)
    with pytest.raises(ConfigError, match="needs two groups"):
        carlab.compare([first], [], "sim")
    with pytest.raises(ConfigError, match="cannot change in this car"):
        carlab.compare([first], [first], "sim", candidates=["spoiler"])


def csv_files(folder, *episodes):
    """The recordings as CSV files."""
    paths = []
    for k, episode in enumerate(episodes):
        names = ("t", "x", "y", "yaw", "vx", "vy", "yaw_rate", "steering", "throttle")
        commands = np.vstack([episode.sent, episode.sent[-1:]])
        rows = np.column_stack([episode.times_s, episode.states, commands])
        paths.append(folder / f"group_{k}.csv")
        np.savetxt(paths[-1], rows, delimiter=",", header=",".join(names), comments="", fmt="%.7g")
    return paths


def test_verb_without_a_verdict_has_the_exit_code_of_a_diagnosis_without_one(first, tmp_path, capsys, monkeypatch):
    paths = csv_files(tmp_path, first, drive(CAR, 20.0, 3))
    arguments = ["compare", str(paths[0]), "--with", str(paths[1]), "--out", str(tmp_path / "out")]
    assert run(arguments) == EXIT_INCONCLUSIVE == Inconclusive.exit_code
    assert "second group has 20 s of driving" in " ".join(capsys.readouterr().err.split())
    undecided = Comparison("inconclusive", "The comparison was stopped.", is_complete=False)
    monkeypatch.setattr("carlab.cli.compare.compare", lambda *arguments, **options: undecided)
    assert run(arguments) == EXIT_INCONCLUSIVE
    assert undecided.sentence in capsys.readouterr().err


def test_verb_writes_the_result_of_the_call(first, unchanged, tmp_path, capsys):
    """The yaw of the second file is in degrees: the repair is reported."""
    in_degrees = unchanged.states * np.where(np.arange(6) == 2, np.degrees(1.0), 1.0)
    paths = csv_files(tmp_path, first, replace(unchanged, states=in_degrees))
    arguments = ["compare", str(paths[0]), "--with", str(paths[1]), "--candidates", "motor_lag", "steering_offset"]
    assert run([*arguments, "--out", str(tmp_path / "out")]) == 0
    printed = " ".join(capsys.readouterr().out.split())
    assert "No effect or parameter of the simulator changed significantly" in printed
    assert "yaw: repaired: Column 'yaw': yaw follows the course over ground only when read in degrees" in printed
    saved = json.loads((tmp_path / "out" / "compare.json").read_text(encoding="utf-8"))
    assert saved["schema"] == "carlab.compare/1"
    assert saved["verdict"] == "nothing"
    assert [(fault["id"], fault["channel"]) for fault in saved["data_faults"]] == [("wrong_unit", "yaw")]
    assert run(["compare", str(paths[0]), "--with", str(paths[0])]) == 2
    assert "is in both groups" in capsys.readouterr().err


def test_changed_base_parameter_keeps_its_name_in_a_sentence():
    estimate = Estimate(0.5, 0.1, 0.3, 0.7, "N")
    change = Change("motor.drive_gain", {"motor.drive_gain": estimate}, {"motor.drive_gain": 8.2}, 0.001, 0.2, 5.0)
    assert change.sentence == "motor.drive_gain changed by 0.5 N (0.3 to 0.7 at 90 %), from 8.2 N."
    lag = Change(
        "steering_lag", {"time_constant": replace(estimate, unit="s")}, {"time_constant": 0.1}, 0.001, 0.2, 5.0
    )
    assert lag.sentence.endswith("changed: time_constant by 0.5 s (0.3 to 0.7 at 90 %), from 0.1 s.")
    result = Comparison("changed", "Two changed.", (change, lag))
    assert str(result).splitlines() == ["Two changed.", f"  {change.sentence}", f"  {lag.sentence}"]
