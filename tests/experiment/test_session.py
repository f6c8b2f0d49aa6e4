"""Several episodes in a row: the car stands still before each one, each episode ends once, none follows a stop."""

import gc
import signal
import threading
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from carlab.core.clock import MonotonicClock
from carlab.core.documents import Document, EpisodeEnded
from carlab.core.errors import ConfigError
from carlab.core.geofence import rectangle
from carlab.core.outcome import EndReason
from carlab.core.policy import PolicyInput
from carlab.core.quantities import Action, CarState, Observation
from carlab.core.safety import SafetyEnvelope, SafetyStop
from carlab.core.task import ParkingTask
from carlab.experiment.episodes import session as session_module
from carlab.experiment.episodes.hooks import RunHooks
from carlab.experiment.episodes.session import Session, wait_until_still
from carlab.recording.mcap.source import read_episode
from carlab.recording.recorder import Recorder
from carlab.recording.run_folder import RunDirectory
from sim_backends.simulated_car import SimulatedCar

TIMEOUT_S = 20.0


class Forward:
    name = "forward"

    def reset(self) -> None: ...

    def act(self, view: PolicyInput) -> Action | None:
        return Action(0.0, 0.4)


class ArmSpeedCar(SimulatedCar):
    """Records its speed at each arming."""

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self.armed_at_mps: list[float] = []

    def arm(self) -> None:
        self.armed_at_mps.append(self.true_state.speed_mps)
        super().arm()


def make_session(
    car: SimulatedCar,
    policy: Any,
    folder: Path,
    hooks: RunHooks | None = None,
    envelope: SafetyEnvelope | None = None,
    **options: Any,
) -> Session:
    return Session(
        car,
        policy,
        ParkingTask(),
        SafetyEnvelope() if envelope is None else envelope,
        RunDirectory.create(folder, "test"),
        1 / 30,
        hooks=RunHooks() if hooks is None else hooks,
        record_rerun=False,
        **options,
    )


@pytest.mark.parametrize("by_hand", [False, True])
def test_car_stands_still_at_the_start_of_each_episode(tmp_path: Path, by_hand: bool) -> None:
    with ArmSpeedCar() as car:
        placed_by_hand: list[CarState] = []
        if by_hand:
            car.place = lambda state: False  # type: ignore[method-assign]
        session = make_session(
            car, Forward(), tmp_path, RunHooks(place_by_hand=placed_by_hand.append), place=by_hand, max_ticks=30
        )
        results = session.drive(3)
    assert [r.reason for r in results] == [EndReason.COMPLETED] * 3
    assert all(r.data.states[-1, 3] > 0.3 for r in results), "the car moves at the end of each episode"
    assert len(placed_by_hand) == (3 if by_hand else 0)
    assert len(car.armed_at_mps) == 3
    assert max(car.armed_at_mps) < 0.1


def test_person_is_not_asked_to_place_the_car_outside_the_arena(tmp_path: Path) -> None:
    with ArmSpeedCar() as car:
        car.place = lambda state: False  # type: ignore[method-assign]
        placed_by_hand: list[CarState] = []
        hooks, envelope = RunHooks(place_by_hand=placed_by_hand.append), SafetyEnvelope(arena_m=rectangle(2, 4, 2, 4))
        with pytest.raises(ConfigError, match=r"^The start pose \(1\.\d+, -1\.\d+\) m is outside the arena; enlarge"):
            make_session(car, Forward(), tmp_path, hooks, envelope).drive(1)
    assert placed_by_hand == []
    assert car.armed_at_mps == []


def test_waiting_for_standstill_ends_at_the_timeout() -> None:
    with SimulatedCar() as car:
        assert wait_until_still(car)
        car.place(CarState(vx_mps=3.0))
        start_s = car.clock.now_s()
        assert not wait_until_still(car, timeout_s=0.2)
        assert car.clock.now_s() - start_s < 0.3


def test_signal_during_placement_by_hand_ends_the_session_at_once(tmp_path: Path) -> None:
    def place(start: CarState) -> None:
        signal.raise_signal(signal.SIGINT)
        raise AssertionError("the session still waits for Enter")

    with ArmSpeedCar() as car:
        car.place = lambda state: False  # type: ignore[method-assign]
        assert make_session(car, Forward(), tmp_path, RunHooks(place_by_hand=place)).drive(3) == []
    assert car.armed_at_mps == []


class SpyRecorder(Recorder):
    """Keeps the emitted documents."""

    emitted: list[Document]

    def emit(self, document: Any) -> None:
        type(self).emitted.append(document)
        super().emit(document)


@pytest.mark.realtime
@pytest.mark.parametrize("resumes", ["while the car is stopped", "after the end was emitted"])
def test_hung_loop_that_resumes_does_not_end_the_episode_twice(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, resumes: str
) -> None:
    """The loop hangs in the policy or after the end of the episode, the watch stops the car, the loop resumes."""
    SpyRecorder.emitted = []
    monkeypatch.setattr(session_module, "Recorder", SpyRecorder)
    hung, stopping = threading.Event(), threading.Event()
    after_the_end = resumes == "after the end was emitted"

    class HangingPolicy(Forward):
        def act(self, view: PolicyInput) -> Action | None:
            if view.step == 5:
                if after_the_end:
                    return None
                assert stopping.wait(TIMEOUT_S)
            return super().act(view)

    class SlowlyStoppingCar(SimulatedCar):
        def stop(self, *, planned: bool) -> None:
            super().stop(planned=planned)
            if not planned and threading.current_thread() is not threading.main_thread():
                stopping.set()
                time.sleep(0.5)  # Meanwhile the loop resumes and finds a car with a fault.

    abandoned: list[EndReason] = []
    finished: list[Path] = []

    def on_abandon(reason: EndReason, detail: str) -> None:
        abandoned.append(reason)
        finished.extend(tmp_path.glob("*/episodes/*.mcap"))  # The recording is complete: the process may end here.
        hung.set()

    with SlowlyStoppingCar(clock=MonotonicClock()) as car:
        session = make_session(car, HangingPolicy(), tmp_path, RunHooks(on_abandon=on_abandon), hang_timeout_s=0.4)
        if after_the_end:
            run_episode = session_module.run_episode

            def run_and_hang(*args: Any, **options: Any) -> Any:
                data = run_episode(*args, **options)
                assert hung.wait(TIMEOUT_S)
                return data

            monkeypatch.setattr(session_module, "run_episode", run_and_hang)
        results = session.drive(1)
    assert abandoned == [EndReason.LOOP_HUNG]
    assert finished == [results[0].path]
    assert stopping.is_set(), "the watch stops the car with a latched fault"
    ends = [d for d in SpyRecorder.emitted if isinstance(d, EpisodeEnded)]
    expected = EndReason.POLICY_FINISHED if after_the_end else EndReason.LOOP_HUNG
    assert [e.reason for e in ends] == [expected]
    assert results[0].reason is expected
    with pytest.raises(SafetyStop, match="The loop hung while"):
        session.drive(1)
    recording = read_episode(results[0].path)
    assert recording.metadata["end_reason"] == expected.name
    if not after_the_end:
        assert "inside the policy" in recording.metadata["end_detail"]


def test_slow_policy_of_a_car_in_simulated_time_is_no_hanging_loop(tmp_path: Path) -> None:
    """The watchdog thread polls every 0.05 s, so it would act within the 0.5 s."""

    class SlowPolicy(Forward):
        def act(self, view: PolicyInput) -> Action | None:
            if view.step == 2:
                time.sleep(0.5)
            return super().act(view)

    abandoned: list[EndReason] = []
    with SimulatedCar() as car:
        hooks = RunHooks(on_abandon=lambda reason, detail: abandoned.append(reason))
        session = make_session(car, SlowPolicy(), tmp_path, hooks, hang_timeout_s=0.1, max_ticks=5)
        (result,) = session.drive(1)
    assert result.reason is EndReason.COMPLETED
    assert abandoned == []


@pytest.mark.realtime
def test_loop_that_resumes_after_the_car_was_closed_raises_where_it_hung(tmp_path: Path) -> None:
    abandoned = threading.Event()

    class HangingPolicy(Forward):
        def act(self, view: PolicyInput) -> Action | None:
            if view.step == 5:
                assert abandoned.wait(TIMEOUT_S)
            return super().act(view)

    with SimulatedCar(clock=MonotonicClock()) as car:
        hooks = RunHooks(on_abandon=lambda reason, detail: abandoned.set())
        slow_guard = SafetyEnvelope(lost_pose_s=2.0)  # on a busy machine, the pose is older than 0.5 s after the hang
        session = make_session(car, HangingPolicy(), tmp_path, hooks, hang_timeout_s=0.4, envelope=slow_guard)
        with pytest.raises(SafetyStop, match="The loop hung while inside the policy 'forward'") as raised:
            session.drive(2)
    assert raised.value.reason is EndReason.LOOP_HUNG
    (recording,) = tmp_path.glob("*/episodes/*.mcap")
    assert f"The recording is {recording}." in str(raised.value)
    assert read_episode(recording).metadata["end_reason"] == "LOOP_HUNG"


@pytest.mark.parametrize(
    ("reason", "by_signal", "episodes"),
    [
        (EndReason.EMERGENCY_STOP, False, 1),
        (EndReason.STOP_REQUESTED, False, 1),
        (EndReason.STOP_REQUESTED, True, 1),
        (EndReason.POLICY_FINISHED, False, 3),
    ],
)
def test_no_episode_follows_a_requested_stop(tmp_path: Path, reason: EndReason, by_signal: bool, episodes: int) -> None:
    ticks: list[int] = []

    def stop_reason() -> EndReason | None:
        if not ticks or ticks[-1] < 4 or reason is EndReason.POLICY_FINISHED:
            return None
        if by_signal:
            signal.raise_signal(signal.SIGTERM)
            return None
        return reason

    class ShortPolicy(Forward):
        def act(self, view: PolicyInput) -> Action | None:
            return None if view.step == 10 else super().act(view)

    with ArmSpeedCar() as car:
        hooks = RunHooks(on_tick=lambda tick: ticks.append(tick.step))
        results = make_session(car, ShortPolicy(), tmp_path, hooks, stop_reason=stop_reason).drive(3)
    assert [r.reason for r in results] == [reason] * episodes
    assert len(car.armed_at_mps) == episodes
    if reason is not EndReason.POLICY_FINISHED:
        assert ticks[-1] <= 5


@pytest.mark.parametrize("ticks", [0, 1])
def test_episode_without_a_tick_is_no_success_at_the_goal(tmp_path: Path, ticks: int) -> None:
    class Neutral(Forward):
        def act(self, view: PolicyInput) -> Action | None:
            return Action() if view.step < ticks else None

    with SimulatedCar() as car:
        assert car.place(CarState())
        (result,) = make_session(car, Neutral(), tmp_path, place=False).drive(1)
    assert result.data.ticks == ticks
    assert bool(result.summary["success"]) is (ticks > 0)
    assert (ParkingTask().outcome(result.summary) == "parked") is (ticks > 0)


def test_car_with_unknown_speed_does_not_count_as_still() -> None:
    class UnknownSpeedCar(SimulatedCar):
        def observe(self) -> Observation:
            return replace(super().observe(), velocity_valid=False)

    with UnknownSpeedCar() as car:
        assert not wait_until_still(car, timeout_s=0.2)


def test_objects_from_before_the_episode_are_not_visited_by_the_garbage_collector(tmp_path: Path) -> None:
    """A full collection stops the control loop for as long as it visits objects."""
    frozen: list[int] = []

    class Watching(Forward):
        def act(self, view: PolicyInput) -> Action | None:
            frozen.append(gc.get_freeze_count())
            return super().act(view)

    gc.unfreeze()  # of the objects from before the tests
    earlier = [[k] for k in range(100_000)]
    with SimulatedCar() as car:
        make_session(car, Watching(), tmp_path, max_ticks=5).drive(1)
    assert frozen
    assert min(frozen) >= len(earlier)
    assert gc.get_freeze_count() == 0
