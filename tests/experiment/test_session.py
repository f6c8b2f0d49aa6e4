"""Several episodes in a row: standing before each, one end of each whoever tells it, nothing forgotten on the way."""

import signal
import threading
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from carlab.core.clock import MonotonicClock
from carlab.core.documents import Document, EpisodeEnded
from carlab.core.outcome import EndReason
from carlab.core.policy import PolicyInput
from carlab.core.quantities import Action, CarState, Observation
from carlab.core.safety import SafetyEnvelope
from carlab.core.task import ParkingTask
from carlab.experiment.episodes import session as session_module
from carlab.experiment.episodes.session import Session, SessionHooks, wait_until_still
from carlab.recording.mcap.source import read_episode
from carlab.recording.recorder import Recorder
from carlab.recording.run_folder import RunDirectory
from sim_backends.simulated_car import SimulatedCar

PATIENT_S = 20.0


class Forward:
    name = "forward"

    def reset(self) -> None: ...

    def act(self, view: PolicyInput) -> Action | None:
        return Action(0.0, 0.4)


class HeavyCar(SimulatedCar):
    """A car that nobody but a person can put somewhere; it remembers how fast it was when it was armed."""

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self.armed_at_mps: list[float] = []

    def arm(self) -> None:
        self.armed_at_mps.append(self.true_state.speed_mps)
        super().arm()


def make(car: SimulatedCar, policy: Any, folder: Path, hooks: SessionHooks | None = None, **options: Any) -> Session:
    return Session(
        car,
        policy,
        ParkingTask(),
        SafetyEnvelope(),
        RunDirectory.create(folder, "test"),
        1 / 30,
        hooks=SessionHooks() if hooks is None else hooks,
        record_rerun=False,
        **options,
    )


@pytest.mark.parametrize("by_hand", [False, True])
def test_an_episode_begins_with_a_car_that_stands(tmp_path: Path, by_hand: bool) -> None:
    with HeavyCar() as car:
        asked: list[CarState] = []
        if by_hand:
            car.place = lambda state: False  # type: ignore[method-assign]
        session = make(car, Forward(), tmp_path, SessionHooks(place_by_hand=asked.append), place=by_hand, max_ticks=30)
        results = session.drive(3)
    assert [r.reason for r in results] == [EndReason.COMPLETED] * 3
    assert all(r.data.states[-1, 3] > 0.3 for r in results), "it did roll at each end"
    assert len(asked) == (3 if by_hand else 0)
    assert len(car.armed_at_mps) == 3
    assert max(car.armed_at_mps) < 0.1


def test_a_car_that_does_not_come_to_rest_is_not_waited_for_for_ever() -> None:
    with SimulatedCar() as car:
        assert wait_until_still(car)
        car.place(CarState(vx_mps=3.0))
        began_s = car.clock.now_s()
        assert not wait_until_still(car, timeout_s=0.2)
        assert car.clock.now_s() - began_s < 0.3


def test_a_signal_while_a_person_places_the_car_ends_the_session_at_once(tmp_path: Path) -> None:
    def place(start: CarState) -> None:
        signal.raise_signal(signal.SIGINT)
        raise AssertionError("it went on waiting for Enter")

    with HeavyCar() as car:
        car.place = lambda state: False  # type: ignore[method-assign]
        assert make(car, Forward(), tmp_path, SessionHooks(place_by_hand=place)).drive(3) == []
    assert car.armed_at_mps == []


class Spy(Recorder):
    """Keeps what it was given."""

    seen: list[Document]

    def emit(self, document: Any) -> None:
        type(self).seen.append(document)
        super().emit(document)


@pytest.mark.parametrize("comes_back", ["while it is stopped", "after its end was told"])
def test_a_loop_that_comes_back_does_not_end_the_episode_twice(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, comes_back: str
) -> None:
    """The loop hangs in the policy, or at its very end; the watch stops it; then it goes on."""
    Spy.seen = []
    monkeypatch.setattr(session_module, "Recorder", Spy)
    hung, stopping = threading.Event(), threading.Event()
    at_the_end = comes_back == "after its end was told"

    class Stuck(Forward):
        def act(self, view: PolicyInput) -> Action | None:
            if view.step == 5:
                if at_the_end:
                    return None
                assert stopping.wait(PATIENT_S)
            return super().act(view)

    class SlowlyStopping(SimulatedCar):
        def stop(self, *, planned: bool) -> None:
            super().stop(planned=planned)
            if not planned and threading.current_thread() is not threading.main_thread():
                stopping.set()
                time.sleep(0.5)  # The loop comes back meanwhile and finds a car with a fault.

    abandoned: list[EndReason] = []
    finished: list[Path] = []

    def on_abandon(reason: EndReason, detail: str) -> None:
        abandoned.append(reason)
        finished.extend(tmp_path.glob("*/episodes/*.mcap"))  # The process may end right here.
        hung.set()

    with SlowlyStopping(clock=MonotonicClock()) as car:
        session = make(car, Stuck(), tmp_path, SessionHooks(on_abandon=on_abandon), hang_timeout_s=0.4)
        if at_the_end:
            run_episode = session_module.run_episode

            def and_hang(*args: Any, **options: Any) -> Any:
                data = run_episode(*args, **options)
                assert hung.wait(PATIENT_S)
                return data

            monkeypatch.setattr(session_module, "run_episode", and_hang)
        results = session.drive(1)
    assert abandoned == [EndReason.LOOP_HUNG]
    assert finished == [results[0].path]
    assert stopping.is_set(), "the watch stopped the car, and latched it"
    ends = [d for d in Spy.seen if isinstance(d, EpisodeEnded)]
    expected = EndReason.POLICY_FINISHED if at_the_end else EndReason.LOOP_HUNG
    assert [e.reason for e in ends] == [expected]
    recording = read_episode(results[0].path)
    assert recording.metadata["end_reason"] == expected.name
    if not at_the_end:
        assert "inside the policy" in recording.metadata["end_detail"]


@pytest.mark.parametrize(
    ("reason", "by_signal", "episodes"),
    [
        (EndReason.EMERGENCY_STOP, False, 1),
        (EndReason.STOP_REQUESTED, False, 1),
        (EndReason.STOP_REQUESTED, True, 1),
        (EndReason.POLICY_FINISHED, False, 3),
    ],
)
def test_no_episode_follows_a_stop(tmp_path: Path, reason: EndReason, by_signal: bool, episodes: int) -> None:
    ticks: list[int] = []

    def stop_reason() -> EndReason | None:
        if not ticks or ticks[-1] < 4 or reason is EndReason.POLICY_FINISHED:
            return None
        if by_signal:
            signal.raise_signal(signal.SIGTERM)
            return None
        return reason

    class Short(Forward):
        def act(self, view: PolicyInput) -> Action | None:
            return None if view.step == 10 else super().act(view)

    with HeavyCar() as car:
        hooks = SessionHooks(on_tick=lambda tick: ticks.append(tick.step), stop_reason=stop_reason)
        results = make(car, Short(), tmp_path, hooks).drive(3)
    assert [r.reason for r in results] == [reason] * episodes
    assert len(car.armed_at_mps) == episodes
    if reason is not EndReason.POLICY_FINISHED:
        assert ticks[-1] <= 5


def test_a_speed_that_is_not_known_is_not_standing() -> None:
    class Unsure(SimulatedCar):
        def observe(self) -> Observation:
            return replace(super().observe(), velocity_valid=False)

    with Unsure() as car:
        assert not wait_until_still(car, timeout_s=0.2)
