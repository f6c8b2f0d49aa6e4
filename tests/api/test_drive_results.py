"""``carlab.drive`` writes its results after an error and after ^C too."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

import carlab
from carlab.core.errors import ActuatorFaultError, ConfigError, NotReadyError
from carlab.core.outcome import EndReason
from carlab.core.quantities import CarState
from carlab.recording import picture
from sim_backends.simulated_car import SimulatedCar


def drive(out: Path, **options: Any) -> carlab.DriveRun:
    return carlab.drive("sim", **({"policy": "neutral", "ticks": 5, "out": out, "rerun": False} | options))


def fail_at_placing(monkeypatch: pytest.MonkeyPatch, number: int, error: BaseException) -> None:
    """Let the simulated car fail when it is placed for episode ``number``."""
    place, calls = SimulatedCar.place, [-1]  # The first call opens the car.

    def failing(self: SimulatedCar, state: CarState) -> bool:
        calls[0] += 1
        if calls[0] == number:
            raise error
        return place(self, state)

    monkeypatch.setattr(SimulatedCar, "place", failing)


@pytest.mark.parametrize(
    "error",
    [
        ActuatorFaultError("The VESC does not answer; check its cable."),
        NotReadyError("The car", ["the port is missing.", "no pose arrived."]),
        KeyboardInterrupt(),
        RuntimeError("an error without a sentence"),
    ],
)
def test_error_keeps_finished_episodes_and_names_their_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: BaseException
) -> None:
    fail_at_placing(monkeypatch, 3, error)
    message = str(error)
    with pytest.raises(type(error)) as raised:
        drive(tmp_path, episodes=4)
    (run,) = tmp_path.iterdir()
    text = "\n".join((str(raised.value), *getattr(raised.value, "__notes__", ())))
    assert text.startswith(message)
    assert f"{run} has the 2 episodes before, see result.json." in text
    if isinstance(error, carlab.CarlabError):
        assert str(run) in str(raised.value), "a program that prints the error prints the folder"
    assert [row["episode"] for row in json.loads((run / "result.json").read_text())["episodes"]] == [1, 2]
    assert (run / "summary.png").stat().st_size > 0


def test_error_before_the_first_episode_names_no_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fail_at_placing(monkeypatch, 1, ActuatorFaultError("The VESC does not answer."))
    with pytest.raises(ActuatorFaultError) as raised:
        drive(tmp_path)
    assert str(raised.value) == "The VESC does not answer."
    assert not list(tmp_path.iterdir())


def signalling(call: Callable[..., Any]) -> Callable[..., Any]:
    """The function, with ^C when it is called."""

    def call_after_signal(*args: Any, **options: Any) -> Any:
        signal.raise_signal(signal.SIGINT)
        return call(*args, **options)

    return call_after_signal


@pytest.fixture
def interrupts_raise() -> Iterator[None]:
    """^C raises KeyboardInterrupt, although a shell ignores it for programs in the background."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("interrupts_raise")
@pytest.mark.parametrize(
    "second", ["carlab.recording.picture.save_summary", "sim_backends.simulated_car.SimulatedCar.close"]
)
def test_second_interrupt_after_the_drive_loses_no_result(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, second: str
) -> None:
    """The first ^C ends the drive at tick 3; the second one comes while the car is closed or the picture is drawn."""
    original = SimulatedCar.close if second.endswith("close") else picture.save_summary
    monkeypatch.setattr(second, signalling(original))

    def on_tick(tick: Any) -> None:
        if tick.step == 3:
            signal.raise_signal(signal.SIGINT)

    run = drive(tmp_path, episodes=3, hooks=carlab.RunHooks(on_tick=on_tick))
    assert run.end is EndReason.STOP_REQUESTED
    assert json.loads((run.folder / "result.json").read_text())["end_reason"] == "STOP_REQUESTED"
    assert run.picture.is_file() == second.endswith("close"), "^C leaves out the picture"


def test_object_that_is_no_policy_is_refused_with_what_it_lacks(tmp_path: Path) -> None:
    class Nameless:
        def act(self, view: object) -> None: ...

    with pytest.raises(ConfigError, match=r"this one lacks the method reset and the attribute name \(a string\)"):
        drive(tmp_path, policy=Nameless())
    with pytest.raises(ConfigError, match="this one lacks the method act and the method reset and"):
        drive(tmp_path, policy=3)
    with pytest.raises(
        ConfigError, match=r"--policy Failing: it is a class; give an object of it, Failing\(\.\.\.\)\."
    ):
        drive(tmp_path, policy=Failing)
    assert not list(tmp_path.iterdir())


class Failing:
    name = "failing"

    def reset(self) -> None: ...

    def act(self, view: object) -> carlab.Action:
        raise ZeroDivisionError("division by zero")


def test_text_of_a_run_names_the_cause_of_its_end(tmp_path: Path) -> None:
    run = drive(tmp_path, policy=Failing(), picture=False)
    assert repr(run) == f"<DriveRun {run.folder}: 1 episode, policy_error: ZeroDivisionError: division by zero>"
    run = drive(tmp_path, picture=False, episodes=2)
    assert repr(run) == f"<DriveRun {run.folder}: 2 episodes, completed>"


@pytest.mark.parametrize("call", [carlab.drive, carlab.learn])
def test_driving_outside_the_main_thread_is_refused(tmp_path: Path, call: Callable[..., Any]) -> None:
    errors: list[BaseException] = []

    def run() -> None:
        try:
            call("sim", out=tmp_path)
        except BaseException as error:
            errors.append(error)

    thread = threading.Thread(target=run)
    thread.start()
    thread.join()
    (error,) = errors
    assert isinstance(error, ConfigError)
    assert "call carlab in the main thread, or in a process of its own." in str(error)
    assert not list(tmp_path.iterdir())


def test_default_episode_has_the_same_duration_at_another_control_rate(tmp_path: Path) -> None:
    """The control period of dart_jetracer is 0.1 s."""
    slow = carlab.drive("dart_jetracer", policy="neutral", out=tmp_path, rerun=False, picture=False)
    fast = drive(tmp_path, ticks=None, picture=False)
    ticks = [run.episodes[0].data.ticks for run in (slow, fast)]
    assert ticks == [33, 100]
    assert slow.episodes[0].total_reward == pytest.approx(fast.episodes[0].total_reward, rel=0.1)


def test_drive_without_a_viewer_loads_no_library_that_it_does_not_need(tmp_path: Path) -> None:
    """They load for several seconds; only a viewer, a picture and rerun files need them."""
    code = (
        "import sys, carlab; carlab.drive(policy='neutral', ticks=2, out=sys.argv[1], rerun=False, picture=False); "
        "print({'torch', 'scipy', 'stable_baselines3', 'matplotlib', 'rerun'} & set(sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", code, str(tmp_path)], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"
