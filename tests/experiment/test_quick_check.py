"""The quick check after an episode: whether the simulator explains the recording; a failed check ends no run."""

from __future__ import annotations

import json
import shlex
from dataclasses import replace
from pathlib import Path

import parking_drives as drives
import pytest
import tomli_w

from carlab.cars import choose_car
from carlab.core.errors import DataError
from carlab.experiment.campaign.campaign import Campaign
from carlab.experiment.campaign.figures import EpisodeFigures
from carlab.experiment.campaign.hooks import LearnHooks
from carlab.experiment.campaign.quick_check import EpisodeCheck, check, check_path, run_check_subprocess
from carlab.experiment.campaign.report import learning_curve, save_check, save_row
from carlab.experiment.campaign.training_plan import TrainingPlan
from carlab.recording.run_folder import RunDirectory
from sim_backends.car_parameters import SimulatorConfig

SIMULATOR = SimulatorConfig.from_preset()
LAGGING = replace(SIMULATOR, effects={"motor_lag": {"time_constant": 0.08}})
ROW = EpisodeFigures(1, 20.0, 30.0, False, 0.5, 0.1, 0.0, 97, 1.0, 0.1, 3.0, 60.0, 100, "COMPLETED")


def make_run(folder: Path, true: SimulatorConfig, episodes: int) -> RunDirectory:
    run: RunDirectory = drives.drive_like_learning(true, folder, episodes, seed=21)
    for number in range(1, episodes + 1):
        (run.models / f"{number:04d}").mkdir(parents=True)
    return run


def test_check_is_saved_in_the_model_folder_and_names_the_next_step(tmp_path: Path) -> None:
    run = make_run(tmp_path / "my runs", LAGGING, 4)
    check_result = run_check_subprocess(run, SIMULATOR)
    assert check_result is not None
    assert (check_result.episode, check_result.verdict) == (4, "left")
    assert check_result.excess > 1.0
    assert "motor_lag" in check_result.sentences[1]
    saved = json.loads(check_path(run, 4).read_text())
    assert saved["sentences"] == list(check_result.sentences)
    assert saved["causes"][0]["id"] == "motor_lag"
    simulator, out = f"{run.path}/simulator.toml", f"{run.path}/diagnosis"
    assert shlex.split(saved["next"]) == ["carlab", "diagnose", str(run.path), "--car", simulator, "--out", out]
    assert saved["next"] in check_result.sentences[1]
    assert not check_path(run, 3).exists()


def test_failed_check_is_reported_in_one_sentence_and_not_repeated(tmp_path: Path) -> None:
    run = make_run(tmp_path, SIMULATOR, 1)
    run.recordings()[0].write_bytes(b"rubbish")
    check_result = run_check_subprocess(run, SIMULATOR)
    assert check_result is not None
    assert check_result.verdict == "failed"
    (sentence,) = check_result.sentences
    assert "learning continues" in sentence
    assert "MCAP" in sentence
    assert "\n" not in sentence
    assert json.loads(check_path(run, 1).read_text())["verdict"] == "failed", "a failed check is not repeated"
    with pytest.raises(DataError):
        check(run.path, run.recordings(), tomli_w.dumps(SIMULATOR.to_tables()))


def test_stopped_check_writes_nothing_and_is_repeated(tmp_path: Path) -> None:
    run = make_run(tmp_path, SIMULATOR, 1)
    assert run_check_subprocess(run, SIMULATOR, stop=lambda: True) is None
    assert not check_path(run, 1).exists()
    save_row(run, ROW)
    checks: list[EpisodeCheck] = []

    def on_check(check_result: EpisodeCheck) -> None:
        checks.append(check_result)
        save_check(run, check_result)

    campaign = Campaign(choose_car("sim"), TrainingPlan(""), 1, run, LearnHooks(on_check=on_check))
    assert list(campaign.run_episodes()) == []
    assert [t.verdict for t in checks] == ["explains"]
    (row,) = learning_curve(run)
    assert (row.verdict, row.excess) == ("explains", checks[0].excess)
    assert row.diagnosis == checks[0].sentences[0]
    assert row.total_reward == ROW.total_reward
    assert list(campaign.run_episodes()) == []
    assert len(checks) == 1, "one check per episode"


def test_learning_curve_rows_are_read_with_and_without_a_check(tmp_path: Path) -> None:
    run = make_run(tmp_path, SIMULATOR, 0)
    check_result = EpisodeCheck(2, "left", 3.5, float("nan"), ("It has left.", "First guess: motor_lag."), "left")
    save_row(run, replace(ROW, episode=2))
    save_check(run, check_result)
    save_row(run, ROW)
    content = json.loads((run.path / "learn.json").read_text())
    for name in ("verdict", "excess", "excess_std", "diagnosis"):
        del content["episodes"][0][name]
    (run.path / "learn.json").write_text(json.dumps(content))
    first, second = learning_curve(run)
    assert str(first) == str(ROW)
    assert str(second) == str(replace(ROW, episode=2).with_check(check_result))
    assert content["episodes"][1]["excess_std"] is None


def test_rows_of_earlier_schemas_are_read_under_their_new_names(tmp_path: Path) -> None:
    run = make_run(tmp_path, SIMULATOR, 0)
    row = replace(ROW, predicted_return=31.5, verdict="left", success=True).to_dict()
    assert row["distance_m"] == ROW.distance_m
    row["foretold"], row["reality"] = row.pop("predicted_return"), row.pop("verdict")
    row["parked"] = row.pop("success")
    for added in ("task_figures", "cost", "violations", "predicted_cost", "outcome"):
        del row[added]
    (run.path / "learn.json").write_text(json.dumps({"schema": "carlab.learn/1", "episodes": [row]}))
    (read,) = learning_curve(run)
    assert (read.predicted_return, read.verdict, read.success) == (31.5, "left", True)
    save_row(run, replace(ROW, episode=ROW.episode + 1))
    content = json.loads((run.path / "learn.json").read_text())
    assert content["schema"] == "carlab.learn/3"
    assert content["episodes"][0]["predicted_return"] == 31.5


@pytest.mark.parametrize("changed", [{"distance_m": "far"}, {"episode": [1]}, {"unknown": 1.0}, {"task_figures": [1]}])
def test_malformed_row_is_refused_in_one_sentence(tmp_path: Path, changed: dict[str, object]) -> None:
    run = make_run(tmp_path, SIMULATOR, 0)
    (run.path / "learn.json").write_text(json.dumps({"episodes": [{**ROW.to_dict(), **changed}]}))
    with pytest.raises(DataError, match=r"cannot be read .*remove it, and the next run restores it\.$"):
        learning_curve(run)


@pytest.mark.parametrize(
    ("distance_m", "yaw_rad", "is_strict"), [(0.049, 0.19, True), (0.051, 0.0, False), (0.0, 0.21, False)]
)
def test_strict_parking_criterion_is_that_of_the_authors(distance_m: float, yaw_rad: float, is_strict: bool) -> None:
    assert replace(ROW, distance_m=distance_m, yaw_error_rad=yaw_rad).is_strictly_parked is is_strict


@pytest.mark.parametrize(
    ("end", "counts"),
    [("COMPLETED", True), ("GOAL_REACHED", True), ("STOP_REQUESTED", False), ("TRACKING_LOST", False)],
)
def test_episode_that_a_fault_or_a_person_ended_is_not_strictly_parked(end: str, counts: bool) -> None:
    assert replace(ROW, distance_m=0.01, yaw_error_rad=0.01, end=end).is_strictly_parked is counts
