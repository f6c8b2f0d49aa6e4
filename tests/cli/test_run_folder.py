"""The run folder: complete after a drive, absent if the car did not open, consistent after an interruption."""

import json
import logging
import os
import re
import signal
import sys
import threading
from pathlib import Path

import pytest

from carlab.cli.runs import ask_to_place
from carlab.core.clock import MonotonicClock
from carlab.core.policy import PolicyInput
from carlab.core.quantities import NEUTRAL, Action, CarState
from carlab.experiment.episodes.interrupts import Interrupts
from carlab.experiment.episodes.scripted_policies import ReplayPolicy
from carlab.experiment.episodes.teleop_policy import KeyboardSource, TeleopInput
from carlab.recording.mcap.source import read_episode
from carlab.recording.run_folder import RunDirectory
from tests.helpers.command_line import Carlab


def test_run_folder_contains_results_and_log(carlab: Carlab, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def act(self: object, view: PolicyInput) -> Action:
        logging.getLogger("test").warning("tick %d", view.step)
        return NEUTRAL

    monkeypatch.setattr("carlab.experiment.episodes.scripted_policies.NeutralPolicy.act", act)
    handlers = list(logging.getLogger().handlers)
    folder = tmp_path / "with space ü"
    argv = ("--policy", "neutral", "--episodes", "2", "--ticks", "5", "--out", folder, "--no-rerun", "--no-picture")
    code, text = carlab("drive", *argv)
    assert code == 0
    (run,) = folder.iterdir()
    assert f"'{run}/episodes/0001.mcap'" in text, "the printed command can be pasted into a shell"
    result = json.loads((run / "result.json").read_text())
    assert result["end_reason"] == "COMPLETED"
    assert [(e["episode"], e["ticks"]) for e in result["episodes"]] == [(1, 5), (2, 5)]
    lines = [json.loads(line) for line in (run / "log.jsonl").read_text().splitlines()]
    assert [line["message"] for line in lines if line["logger"] == "test"] == [f"tick {n}" for n in range(5)] * 2
    assert [h for h in logging.getLogger().handlers if isinstance(h, logging.FileHandler)] == [
        h for h in handlers if isinstance(h, logging.FileHandler)
    ]


@pytest.mark.parametrize("error", [KeyboardInterrupt(), OSError(5, "no such thing")])
def test_no_folder_remains_if_the_car_does_not_open(
    carlab: Carlab, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: BaseException
) -> None:
    def refuse(self: object) -> None:
        raise error

    monkeypatch.setattr("sim_backends.simulated_car.SimulatedCar.open", refuse)
    code, _ = carlab("drive", "--ticks", "5", "--out", tmp_path)
    assert code == (130 if isinstance(error, KeyboardInterrupt) else 1)
    assert not list(tmp_path.iterdir())


def test_drive_that_ends_before_the_first_tick_has_the_exit_code_of_a_safety_stop(
    carlab: Carlab, tmp_path: Path
) -> None:
    """The task's start pose lies outside this arena."""
    arena = "[hardware.arena]\ncorners_m = [[-1, -1], [1, -1], [1, 1], [-1, 1]]\n"
    (tmp_path / "small.toml").write_text(arena)
    code, text = carlab("drive", "--vehicle", tmp_path / "small.toml", "--out", tmp_path / "runs", "--no-rerun")
    assert code == 4
    assert "move it back inside" in text
    assert "or enlarge the arena" in text
    assert re.search(r"\b1 0 0\.0 .* geofence", text), "the table has the episode with 0 ticks"
    assert "No tick is complete." in text
    assert "carlab view" not in text
    (result,) = tmp_path.glob("runs/*/result.json")
    assert json.loads(result.read_text())["end_reason"] == "GEOFENCE"


def test_error_of_the_picture_does_not_replace_the_result(
    carlab: Carlab, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*arguments: object) -> None:
        raise ValueError("no font")

    monkeypatch.setattr("carlab.recording.picture.save_summary", refuse)
    code, text = carlab("drive", "--policy", "neutral", "--ticks", "5", "--out", tmp_path, "--no-rerun")
    assert code == 0
    assert "Recorded in" in text
    assert "summary.png shows it" not in text
    (log,) = tmp_path.glob("*/log.jsonl")
    assert "was not drawn (no font)" in log.read_text()


def test_diverging_simulation_is_not_blamed_on_motion_capture(carlab: Carlab, tmp_path: Path) -> None:
    (tmp_path / "stiff.toml").write_text("[motor]\ndamping = 1560\n")
    options = ("--policy", "figure_eight", "--ticks", "60", "--out", tmp_path / "runs", "--no-rerun")
    code, text = carlab("drive", "--car", tmp_path / "stiff.toml", *options)
    assert code == 2
    assert "The simulation of car 'stiff' diverged" in text
    assert "Motive" not in text


def test_interrupted_replay_ends_with_stop_requested(
    carlab: Carlab, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    code, _ = carlab("drive", "--ticks", "20", "--out", tmp_path, "--name", "first", "--no-rerun", "--no-picture")
    assert code == 0
    (recording,) = tmp_path.glob("*first/episodes/*.mcap")
    act = ReplayPolicy.act

    def interrupted(self: ReplayPolicy, view: PolicyInput) -> Action | None:
        if view.step == 5:
            signal.raise_signal(signal.SIGINT)
        return act(self, view)

    monkeypatch.setattr(ReplayPolicy, "act", interrupted)
    code, _ = carlab("replay", recording, "--drive", "--out", tmp_path)
    assert code == 130
    (result,) = tmp_path.glob("*replay/result.json")
    assert json.loads(result.read_text())["end_reason"] == "STOP_REQUESTED"


def test_interrupted_import_leaves_no_partial_file(
    carlab: Carlab, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rows = "".join(f"{n / 30},{n / 30},0,0,1,0,0,0,0.2\n" for n in range(100))
    (tmp_path / "drive.csv").write_text(f"t,x,y,yaw,vx,vy,yaw_rate,steering,throttle\n{rows}")

    def interrupted(self: object, item: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("carlab.recording.mcap.sink.McapSink.write", interrupted)
    assert carlab("import", tmp_path / "drive.csv")[0] == 130
    assert [entry.name for entry in tmp_path.iterdir()] == ["drive.csv"]


def test_interrupt_during_the_placing_prompt_requests_a_stop(monkeypatch: pytest.MonkeyPatch) -> None:
    from rich.progress import Progress

    def interrupted_input(*args: object, **kwargs: object) -> str:
        os.kill(os.getpid(), signal.SIGINT)
        signal.sigtimedwait([], 5.0)
        pytest.fail("the prompt was not interrupted")

    master, terminal = os.openpty()
    monkeypatch.setattr("carlab.cli.runs.console.input", interrupted_input)
    with os.fdopen(master), os.fdopen(terminal) as keyboard, Interrupts() as interrupts:
        monkeypatch.setattr(sys, "stdin", keyboard)
        ask_to_place(Progress(disable=True), "")(CarState())
        assert interrupts.count == 1
        assert interrupts.requested.is_set()


def test_line_that_was_typed_before_the_prompt_does_not_confirm_the_placing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Enter during the last episode or the training: a person may be carrying the car when the next start is asked."""
    from rich.progress import Progress

    master, terminal = os.openpty()
    confirmed: list[bool] = []

    def confirm() -> None:
        confirmed.append(True)
        os.write(master, b"\n")

    confirming = threading.Timer(0.3, confirm)
    with os.fdopen(master, "rb"), os.fdopen(terminal) as keyboard:
        monkeypatch.setattr(sys, "stdin", keyboard)
        os.write(master, b"\n\n")
        confirming.start()
        ask_to_place(Progress(disable=True), "")(CarState())
        assert confirmed
        confirming.join()


def test_simulated_car_driven_by_hand_runs_in_real_time(
    carlab: Carlab, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DISPLAY", ":carlab")
    monkeypatch.setattr(KeyboardSource, "open", lambda self: None)
    monkeypatch.setattr(KeyboardSource, "poll", lambda self: TeleopInput())
    argv = ("--policy", "keyboard", "--ticks", "45", "--out", tmp_path, "--no-rerun", "--no-picture")
    start_s = MonotonicClock().now_s()
    code, _ = carlab("drive", *argv)
    assert code == 0
    assert MonotonicClock().now_s() - start_s > 44 / 30.0


@pytest.mark.parametrize(("option", "throttle"), [((), 0.4), (("--max-throttle", "0.1"), 0.1)])
def test_key_gives_the_maximum_throttle(
    carlab: Carlab, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, option: tuple[str, ...], throttle: float
) -> None:
    monkeypatch.setenv("DISPLAY", ":carlab")
    monkeypatch.setattr(KeyboardSource, "open", lambda self: None)
    monkeypatch.setattr(KeyboardSource, "poll", lambda self: TeleopInput(throttle=self.throttle, deadman=True))
    argv = ("--policy", "keyboard", "--ticks", "12", "--out", tmp_path, "--no-rerun", "--no-picture", *option)
    assert carlab("drive", *argv)[0] == 0
    (path,) = tmp_path.glob("*/episodes/*.mcap")
    assert read_episode(path).sent[-1, 1] == pytest.approx(throttle)


def test_resume_refuses_folders_that_are_no_learning_run(carlab: Carlab, tmp_path: Path) -> None:
    (tmp_path / "some").mkdir()
    code, text = carlab("learn", "--resume", tmp_path / "some")
    assert code == 1
    assert "is not the folder of a run of carlab learn (it has no campaign.json)" in text
    assert list((tmp_path / "some").iterdir()) == []
    driven = RunDirectory.create(tmp_path, "driven")
    before = set(driven.path.rglob("*"))
    code, text = carlab("learn", "--resume", driven.path)
    assert code == 1
    assert "is not the folder of a run of carlab learn (it has no campaign.json)" in text
    assert "Errno" not in text
    assert set(driven.path.rglob("*")) == before
