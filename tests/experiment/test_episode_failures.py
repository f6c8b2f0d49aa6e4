"""Errors at any call of the control loop: the car stops, the episode ends once with its true reason, and no error is
swallowed."""

import itertools
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from episodes import PERIOD_S, drive_episode

from carlab.core.documents import Document, EpisodeEnded, EpisodeStarted, Tick, Transition
from carlab.core.errors import ActuatorFaultError, NotReadyError, PoseLostError
from carlab.core.outcome import EndReason
from carlab.core.policy import PolicyInput
from carlab.core.quantities import Action, Observation
from carlab.core.safety import SafetyEnvelope
from carlab.core.task import ParkingTask
from carlab.experiment.episodes.episode import EpisodeHooks, first_observation
from sim_backends.simulated_car import SimulatedCar

TICKS = 3


class InjectedError(Exception):
    """Raised by a ``FaultInjector``."""


class FaultInjector:
    """Counts calls by name and raises an error at one of them."""

    def __init__(self, name: str = "", number: int = -1, error: BaseException | None = None) -> None:
        self.calls: dict[str, int] = {}
        self._name, self._number = name, number
        self._error = InjectedError(f"{name} {number}") if error is None else error

    def __call__(self, name: str) -> None:
        number = self.calls[name] = self.calls.get(name, -1) + 1
        if (name, number) == (self._name, self._number):
            raise self._error


class FaultyCar(SimulatedCar):
    """A car whose methods call the fault injector."""

    def __init__(self, injector: FaultInjector) -> None:
        super().__init__()
        self.injector = injector
        self.is_armed = False
        self.stops: list[bool] = []

    def observe(self) -> Observation:
        self.injector("observe")
        return super().observe()

    def arm(self) -> None:
        super().arm()
        self.is_armed = True
        self.injector("arm")

    def command(self, action: Action) -> Action:
        self.injector("command")
        return super().command(action)

    def health(self) -> Any:
        self.injector("health")
        return super().health()

    def stop(self, *, planned: bool) -> None:
        super().stop(planned=planned)
        self.is_armed = False
        self.stops.append(planned)
        self.injector("stop")


class FaultyPolicy:
    name = "faulty"

    def __init__(
        self, injector: FaultInjector, act: Callable[[PolicyInput], Any] = lambda view: Action(0.1, 0.2)
    ) -> None:
        self.injector, self._act = injector, act

    def reset(self) -> None:
        self.injector("reset")

    def act(self, view: PolicyInput) -> Any:
        self.injector("act")
        return self._act(view)


def drive(
    car: FaultyCar, injector: FaultInjector, policy: FaultyPolicy | None = None
) -> tuple[list[Document], BaseException | None]:
    documents: list[Document] = []

    def emit(document: Document) -> None:
        documents.append(document)
        injector("emit")

    def counted(name: str) -> Callable[..., None]:
        return lambda *args: injector(name)

    hooks = EpisodeHooks(emit, counted("stop_requested"), counted("recorder_failed"), counted("heartbeat"))
    try:
        drive_episode(car, FaultyPolicy(injector) if policy is None else policy, max_ticks=TICKS, hooks=hooks)
    except BaseException as error:
        return documents, error
    return documents, None


def calls_without_error() -> dict[str, int]:
    injector = FaultInjector()
    with FaultyCar(injector) as car:
        assert drive(car, injector)[1] is None
        return dict(injector.calls)


CALLS = calls_without_error()
EVERY_CALL = [(name, number) for name, count in CALLS.items() for number in range(count + 1)]


@pytest.mark.parametrize(("name", "number"), EVERY_CALL)
@pytest.mark.parametrize("error", [InjectedError("injected"), KeyboardInterrupt()], ids=["error", "interrupt"])
def test_error_at_any_call_leaves_the_car_stopped(name: str, number: int, error: BaseException) -> None:
    injector = FaultInjector(name, number, error)
    with FaultyCar(injector) as car:
        documents, raised = drive(car, injector)
        assert not car.is_armed
        if isinstance(documents[-1], EpisodeStarted):
            assert (name, number) == ("emit", 0)  # The recorder failed first; the car was not armed.
            assert car.stops == []
            assert raised is error
            return
        assert car.stops, "the car was not stopped"
        assert sum(isinstance(d, EpisodeEnded) for d in documents) == 1
        ended = documents[-1]
        assert isinstance(ended, EpisodeEnded)
    if name == "act" and isinstance(error, InjectedError):
        assert raised is None
        assert ended.reason is EndReason.POLICY_ERROR
    else:
        assert raised is error
        after_the_end = name == "stop" or (name in ("emit", "heartbeat") and number == CALLS[name])
        if not after_the_end:
            assert ended.reason is EndReason.CRASHED
            assert type(error).__name__ in ended.detail


def test_end_reason_is_kept_when_the_stop_fails() -> None:
    injector = FaultInjector("stop", 0)
    with FaultyCar(injector) as car:
        documents, raised = drive(car, injector, FaultyPolicy(injector, lambda view: None))
    assert isinstance(raised, InjectedError)
    assert isinstance(documents[-1], EpisodeEnded)
    assert documents[-1].reason is EndReason.POLICY_FINISHED


@pytest.mark.parametrize(
    ("name", "error", "reason"),
    [
        ("arm", NotReadyError("car cannot be armed", ["it moves"]), EndReason.NOT_READY),
        ("arm", ActuatorFaultError("a fault is latched"), EndReason.ACTUATOR_FAULT),
        ("reset", InjectedError("no such file"), EndReason.CRASHED),
    ],
)
def test_error_before_arming_latches_no_fault(name: str, error: Exception, reason: EndReason) -> None:
    injector = FaultInjector(name, 0, error)
    with FaultyCar(injector) as car:
        documents, raised = drive(car, injector)
        assert raised is error
        assert isinstance(documents[-1], EpisodeEnded)
        assert documents[-1].reason is reason
        assert car.stops == [True]
        assert drive(car, injector)[1] is None, "the next episode succeeds"


def test_policy_is_reset_before_the_car_is_armed() -> None:
    injector = FaultInjector()
    with FaultyCar(injector) as car:
        policy = FaultyPolicy(injector)
        armed: list[bool] = []
        policy.reset = lambda: armed.append(car.is_armed)  # type: ignore[method-assign]
        drive(car, injector, policy)
    assert armed == [False]


def policy_error(output: object) -> str:
    """Drive with a policy that returns ``output``; the episode ends before its first tick with the returned detail."""
    injector = FaultInjector()
    with FaultyCar(injector) as car:
        documents, raised = drive(car, injector, FaultyPolicy(injector, lambda view: output))
        assert raised is None
        assert car.stops[-1] is False
    assert isinstance(documents[-1], EpisodeEnded)
    assert documents[-1].reason is EndReason.POLICY_ERROR
    assert not any(isinstance(d, Tick) for d in documents)
    return documents[-1].detail


@pytest.mark.parametrize("output", [(0.1, 0.2), [0.1, 0.2], 0.3, "left"])
def test_policy_output_that_is_no_action_ends_with_policy_error(output: object) -> None:
    assert type(output).__name__ in policy_error(output)


@pytest.mark.parametrize(
    "action",
    [Action(np.array([0.1]), 0.0), Action("a", 0.0), Action(np.array("a"), 0.0), Action(None, 0.0), Action(0, 10**400)],
)
def test_action_that_is_no_pair_of_numbers_ends_with_policy_error(action: Action) -> None:
    assert "steering and throttle must be single numbers" in policy_error(action)


@pytest.mark.parametrize("action", [Action(np.float32(0.25), np.int64(0)), Action(np.array(0.25), np.array(0))])
def test_numbers_of_numpy_are_an_action(action: Action) -> None:
    injector = FaultInjector()
    with FaultyCar(injector) as car:
        documents, _ = drive(car, injector, FaultyPolicy(injector, lambda view: action))
    ticks = [document for document in documents if isinstance(document, Tick)]
    assert ticks[0].requested == Action(0.25, 0.0)
    assert isinstance(ticks[0].requested.steering, float)


def test_slow_policy_ends_with_late_loop_and_not_with_a_pose_fault() -> None:
    injector = FaultInjector()
    with FaultyCar(injector) as car:

        def act_slowly(view: PolicyInput) -> Action:
            car.clock.sleep_until(car.clock.now_s() + (0.6 if view.step == 1 else 0.0))
            return Action(0.1, 0.2)

        documents, _ = drive(car, injector, FaultyPolicy(injector, act_slowly))
        assert car.stops == [False]
    assert isinstance(documents[-1], EpisodeEnded)
    assert documents[-1].reason is EndReason.LATE_LOOP
    assert "took 0.6 s" in documents[-1].detail
    assert injector.calls["command"] == 0, "the late command was not sent"


class SlowTask(ParkingTask):
    """A task whose reward takes 50 ms on the clock of the car."""

    def __init__(self, car: SimulatedCar) -> None:
        super().__init__()
        object.__setattr__(self, "car", car)

    def reward(self, features: Any, action: Any, next_features: Any) -> Any:
        self.car.clock.sleep_until(self.car.clock.now_s() + 0.05)
        return super().reward(features, action, next_features)


def test_late_loop_states_the_times_of_policy_and_task() -> None:
    with FaultyCar(FaultInjector()) as car:
        policy = FaultyPolicy(car.injector, lambda view: Action())
        data = drive_episode(car, policy, SlowTask(car), max_ticks=100)
    assert data.metadata["end_reason"] == "LATE_LOOP"
    assert "A tick has 33 ms; the median computation time of the policy was 0.0 ms" in data.metadata["end_detail"]
    assert data.metadata["end_detail"].endswith("that of the task's functions 50.0 ms.")


class BlindCar(FaultyCar):
    """Raises PoseLostError until ``until_s``, or returns observations with the given changes."""

    def __init__(self, until_s: float, **changes: Any) -> None:
        super().__init__(FaultInjector())
        self.until_s, self.changes = until_s, changes

    def observe(self) -> Observation:
        observation = super().observe()
        if self.clock.now_s() < self.until_s:
            if not self.changes:
                raise PoseLostError("not seen yet")
            values = {name: getattr(observation, name) for name in Observation.__slots__}
            return Observation(**{**values, **self.changes})
        return observation


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({}, "not seen yet"),
        ({"tracked": False}, "does not see the car"),
        ({"velocity_valid": False}, "frame rate of motion capture is too low"),
    ],
)
def test_waiting_for_the_first_pose_sends_heartbeats(changes: dict[str, Any], sentence: str) -> None:
    beats: list[float] = []
    with BlindCar(1.5, **changes) as car:
        observation = first_observation(car, lambda where: beats.append(car.clock.now_s()))
        assert observation.tracked
        assert observation.velocity_valid
        assert car.clock.now_s() >= 1.5
        assert max(b - a for a, b in itertools.pairwise(beats)) < 0.1
        car.until_s = 1e9
        with pytest.raises(PoseLostError, match=sentence):
            first_observation(car)


def test_missing_first_pose_ends_with_pose_stale_and_latches_no_fault() -> None:
    documents: list[Document] = []
    with BlindCar(1e9) as car:
        with pytest.raises(PoseLostError):
            drive_episode(car, FaultyPolicy(FaultInjector()), hooks=EpisodeHooks(emit=documents.append))
        assert car.stops == [True]
    assert isinstance(documents[-1], EpisodeEnded)
    assert documents[-1].reason is EndReason.POSE_STALE
    assert documents[-1].steps == 0


def test_failed_recorder_ends_the_episode() -> None:
    injector = FaultInjector()
    with FaultyCar(injector) as car:
        data = drive_episode(
            car,
            FaultyPolicy(injector),
            hooks=EpisodeHooks(
                recorder_failed=lambda: "the disk is full" if injector.calls.get("act", -1) == 6 else None
            ),
        )
        assert car.stops == [False]
    assert (data.metadata["end_reason"], data.metadata["end_detail"]) == ("RECORDER_ERROR", "the disk is full")
    assert data.ticks == 7


def test_heartbeat_names_every_step_of_a_tick() -> None:
    """A step without a heartbeat of its own would be reported under the name of the step before it."""
    beats: list[str] = []
    with FaultyCar(FaultInjector()) as car:
        drive_episode(car, FaultyPolicy(car.injector), max_ticks=2, hooks=EpisodeHooks(heartbeat=beats.append))
    tick = ["inside the policy 'faulty'", "commanding", "waiting for the next tick", "observing"]
    assert beats == ["waiting for the first pose", "arming", "observing", *tick, *tick, "stopping the car"]


class CoarseCar(FaultyCar):
    """Sends commands rounded to tenths."""

    def command(self, action: Action) -> Action:
        return super().command(Action(round(action.steering, 1), round(action.throttle, 1)))


def test_recording_and_transitions_hold_the_sent_command() -> None:
    documents: list[Document] = []
    with CoarseCar(FaultInjector()) as car:
        data = drive_episode(
            car,
            FaultyPolicy(car.injector, lambda view: Action(0.234, 0.9)),
            envelope=SafetyEnvelope(max_throttle=0.46),
            max_ticks=5,
            hooks=EpisodeHooks(emit=documents.append),
        )
    sent = [0.2, 0.5]
    assert data.sent.tolist() == [sent] * 5
    assert data.requested.tolist() == [[0.234, 0.9]] * 5
    ticks = [d for d in documents if isinstance(d, Tick)]
    assert [t.sent for t in ticks] == [Action(*sent)] * 5
    assert [t.requested for t in ticks] == [Action(0.234, 0.9)] * 5
    transitions = [d for d in documents if isinstance(d, Transition)]
    assert [m.action for m in transitions] == [Action(*sent)] * 5
    assert transitions[-1].next_features[-6:].tolist() == sent * 3
    assert transitions[0].reward == ParkingTask().reward(
        transitions[0].features, np.array(sent), transitions[0].next_features
    )


def drive_with_policy_times(times_in_periods: Callable[[int], float]) -> tuple[str, int]:
    with FaultyCar(FaultInjector()) as car:

        def act_slowly(view: PolicyInput) -> Action:
            car.clock.sleep_until(car.clock.now_s() + times_in_periods(view.step) * PERIOD_S)
            return Action()

        policy = FaultyPolicy(car.injector, act_slowly)
        data = drive_episode(car, policy, max_ticks=100)
        return data.metadata["end_reason"], data.ticks


@pytest.mark.parametrize(
    ("times", "end"),
    [
        (lambda step: 0.9, ("COMPLETED", 100)),
        # A tick counts as late after half a period or after a skipped tick; more than 15 of 30 end it.
        (lambda step: 1.7, ("LATE_LOOP", 30)),
        (lambda step: 2.1, ("LATE_LOOP", 30)),
        (lambda step: 1.3 if step % 40 < 39 else 1.0, ("LATE_LOOP", 30)),
        (lambda step: 2.1 if step % 2 else 0.0, ("COMPLETED", 100)),
        (lambda step: 2.1 if step >= 50 else 0.0, ("LATE_LOOP", 66)),
    ],
)
def test_episode_ends_if_most_of_30_ticks_are_late(times: Callable[[int], float], end: tuple[str, int]) -> None:
    assert drive_with_policy_times(times) == end
