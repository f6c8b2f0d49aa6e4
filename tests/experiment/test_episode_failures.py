"""Whatever raises, and wherever: the car stops, the episode ends once with a true reason, no error is swallowed."""

import itertools
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from carlab.core.documents import Document, EpisodeEnded, EpisodeStarted, Tick, Transition
from carlab.core.errors import ActuatorFaultError, NotReadyError, PoseLostError
from carlab.core.outcome import EndReason
from carlab.core.policy import PolicyInput
from carlab.core.quantities import Action, Observation
from carlab.core.safety import SafetyEnvelope
from carlab.core.task import ParkingTask
from carlab.experiment.episodes.episode import EpisodeHooks, first_observation, run_episode
from sim_backends.simulated_car import SimulatedCar

PERIOD_S = 1.0 / 30.0
TICKS = 3


class Boom(Exception):
    """Raised on purpose."""


class Fuse:
    """Counts calls, and raises at one of them, by name and number."""

    def __init__(self, name: str = "", number: int = -1, error: BaseException | None = None) -> None:
        self.calls: dict[str, int] = {}
        self._name, self._number = name, number
        self._error = Boom(f"{name} {number}") if error is None else error

    def __call__(self, name: str) -> None:
        number = self.calls[name] = self.calls.get(name, -1) + 1
        if (name, number) == (self._name, self._number):
            raise self._error


class FusedCar(SimulatedCar):
    """A car each of whose methods may fail."""

    def __init__(self, fuse: Fuse) -> None:
        super().__init__()
        self.fuse = fuse
        self.is_armed = False
        self.stops: list[bool] = []

    def observe(self) -> Observation:
        self.fuse("observe")
        return super().observe()

    def arm(self) -> None:
        super().arm()
        self.is_armed = True
        self.fuse("arm")

    def command(self, action: Action) -> Action:
        self.fuse("command")
        return super().command(action)

    def health(self) -> Any:
        self.fuse("health")
        return super().health()

    def stop(self, *, planned: bool) -> None:
        super().stop(planned=planned)
        self.is_armed = False
        self.stops.append(planned)
        self.fuse("stop")


class FusedPolicy:
    name = "fused"

    def __init__(self, fuse: Fuse, act: Callable[[PolicyInput], Any] = lambda view: Action(0.1, 0.2)) -> None:
        self.fuse, self._act = fuse, act

    def reset(self) -> None:
        self.fuse("reset")

    def act(self, view: PolicyInput) -> Any:
        self.fuse("act")
        return self._act(view)


def drive(car: FusedCar, fuse: Fuse, policy: FusedPolicy | None = None) -> tuple[list[Document], BaseException | None]:
    documents: list[Document] = []

    def emit(document: Document) -> None:
        documents.append(document)
        fuse("emit")

    def silent(name: str) -> Callable[..., None]:
        return lambda *args: fuse(name)

    hooks = EpisodeHooks(emit, silent("stop_requested"), silent("recorder_failed"), silent("heartbeat"))
    try:
        run_episode(
            car,
            FusedPolicy(fuse) if policy is None else policy,
            ParkingTask(),
            SafetyEnvelope(),
            period_s=PERIOD_S,
            max_ticks=TICKS,
            hooks=hooks,
        )
    except BaseException as error:
        return documents, error
    return documents, None


def clean_run() -> dict[str, int]:
    fuse = Fuse()
    with FusedCar(fuse) as car:
        assert drive(car, fuse)[1] is None
        return dict(fuse.calls)


CALLS = clean_run()
EVERY_CALL = [(name, number) for name, count in CALLS.items() for number in range(count + 1)]


@pytest.mark.parametrize(("name", "number"), EVERY_CALL)
@pytest.mark.parametrize("error", [Boom("boom"), KeyboardInterrupt()], ids=["error", "interrupt"])
def test_an_error_at_any_call_leaves_the_car_stopped(name: str, number: int, error: BaseException) -> None:
    fuse = Fuse(name, number, error)
    with FusedCar(fuse) as car:
        documents, raised = drive(car, fuse)
        assert not car.is_armed
        if isinstance(documents[-1], EpisodeStarted):
            assert (name, number) == ("emit", 0)  # No recorder started, and nothing was armed.
            assert car.stops == []
            assert raised is error
            return
        assert car.stops, "it was not stopped"
        assert sum(isinstance(d, EpisodeEnded) for d in documents) == 1
        ended = documents[-1]
        assert isinstance(ended, EpisodeEnded)
    if name == "act" and isinstance(error, Boom):
        assert raised is None
        assert ended.reason is EndReason.POLICY_ERROR
    else:
        assert raised is error
        at_the_end = name == "stop" or (name in ("emit", "heartbeat") and number == CALLS[name])
        if not at_the_end:
            assert ended.reason is EndReason.CRASHED
            assert type(error).__name__ in ended.detail


def test_the_reason_survives_a_stop_that_fails() -> None:
    fuse = Fuse("stop", 0)
    with FusedCar(fuse) as car:
        documents, raised = drive(car, fuse, FusedPolicy(fuse, lambda view: None))
    assert isinstance(raised, Boom)
    assert isinstance(documents[-1], EpisodeEnded)
    assert documents[-1].reason is EndReason.POLICY_FINISHED


@pytest.mark.parametrize(
    ("name", "error", "reason"),
    [
        ("arm", NotReadyError("car cannot be armed", ["it moves"]), EndReason.NOT_READY),
        ("arm", ActuatorFaultError("a fault is latched"), EndReason.ACTUATOR_FAULT),
        ("reset", Boom("no such file"), EndReason.CRASHED),
    ],
)
def test_what_fails_before_the_car_is_armed_latches_nothing(name: str, error: Exception, reason: EndReason) -> None:
    fuse = Fuse(name, 0, error)
    with FusedCar(fuse) as car:
        documents, raised = drive(car, fuse)
        assert raised is error
        assert isinstance(documents[-1], EpisodeEnded)
        assert documents[-1].reason is reason
        assert car.stops == [True]
        assert drive(car, fuse)[1] is None, "and the next attempt may succeed"


def test_a_policy_gets_ready_before_the_car_is_armed() -> None:
    fuse = Fuse()
    with FusedCar(fuse) as car:
        policy = FusedPolicy(fuse)
        armed: list[bool] = []
        policy.reset = lambda: armed.append(car.is_armed)  # type: ignore[method-assign]
        drive(car, fuse, policy)
    assert armed == [False]


@pytest.mark.parametrize("answer", [(0.1, 0.2), [0.1, 0.2], 0.3, "left"])
def test_what_is_no_action_is_an_error_of_the_policy(answer: object) -> None:
    fuse = Fuse()
    with FusedCar(fuse) as car:
        documents, raised = drive(car, fuse, FusedPolicy(fuse, lambda view: answer))
        assert raised is None
        assert car.stops[-1] is False
    assert isinstance(documents[-1], EpisodeEnded)
    assert documents[-1].reason is EndReason.POLICY_ERROR
    assert type(answer).__name__ in documents[-1].detail
    assert not any(isinstance(d, Tick) for d in documents)


def test_a_policy_that_thinks_too_long_is_not_blamed_on_motion_capture() -> None:
    fuse = Fuse()
    with FusedCar(fuse) as car:

        def think(view: PolicyInput) -> Action:
            car.clock.sleep_until(car.clock.now_s() + (0.6 if view.step == 1 else 0.0))
            return Action(0.1, 0.2)

        documents, _ = drive(car, fuse, FusedPolicy(fuse, think))
        assert car.stops == [False]
    assert isinstance(documents[-1], EpisodeEnded)
    assert documents[-1].reason is EndReason.LATE_LOOP
    assert "took 0.6 s" in documents[-1].detail
    assert fuse.calls["command"] == 0, "the command of a tick long ago was not sent"


class BlindCar(FusedCar):
    """Sees nothing, or not enough, for a while."""

    def __init__(self, until_s: float, **what: Any) -> None:
        super().__init__(Fuse())
        self.until_s, self.what = until_s, what

    def observe(self) -> Observation:
        observation = super().observe()
        if self.clock.now_s() < self.until_s:
            if not self.what:
                raise PoseLostError("not seen yet")
            values = {name: getattr(observation, name) for name in Observation.__slots__}
            return Observation(**{**values, **self.what})
        return observation


@pytest.mark.parametrize(
    ("what", "sentence"),
    [
        ({}, "not seen yet"),
        ({"tracked": False}, "does not see the car"),
        ({"velocity_valid": False}, "frame rate of motion capture is too low"),
    ],
)
def test_the_first_pose_is_waited_for_with_a_beating_heart(what: dict[str, Any], sentence: str) -> None:
    beats: list[float] = []
    with BlindCar(1.5, **what) as car:
        seen = first_observation(car, lambda where: beats.append(car.clock.now_s()))
        assert seen.tracked
        assert seen.velocity_valid
        assert car.clock.now_s() >= 1.5
        assert max(b - a for a, b in itertools.pairwise(beats)) < 0.1
        car.until_s = 1e9
        with pytest.raises(PoseLostError, match=sentence):
            first_observation(car)


def test_a_pose_that_never_comes_is_told_and_latches_nothing() -> None:
    documents: list[Document] = []
    with BlindCar(1e9) as car:
        with pytest.raises(PoseLostError):
            run_episode(
                car,
                FusedPolicy(Fuse()),
                ParkingTask(),
                SafetyEnvelope(),
                period_s=PERIOD_S,
                hooks=EpisodeHooks(emit=documents.append),
            )
        assert car.stops == [True]
    assert isinstance(documents[-1], EpisodeEnded)
    assert documents[-1].reason is EndReason.POSE_STALE
    assert documents[-1].steps == 0


def test_a_recorder_that_failed_ends_the_episode() -> None:
    fuse = Fuse()
    with FusedCar(fuse) as car:
        data = run_episode(
            car,
            FusedPolicy(fuse),
            ParkingTask(),
            SafetyEnvelope(),
            period_s=PERIOD_S,
            hooks=EpisodeHooks(recorder_failed=lambda: "the disk is full" if fuse.calls.get("act", -1) == 6 else None),
        )
        assert car.stops == [False]
    assert (data.metadata["end_reason"], data.metadata["end_detail"]) == ("RECORDER_ERROR", "the disk is full")
    assert data.ticks == 7


def test_every_step_of_a_tick_is_told_to_the_watch() -> None:
    """What hangs without a word of its own would be blamed on the step before."""
    beats: list[str] = []
    with FusedCar(Fuse()) as car:
        run_episode(
            car,
            FusedPolicy(car.fuse),
            ParkingTask(),
            SafetyEnvelope(),
            period_s=PERIOD_S,
            max_ticks=2,
            hooks=EpisodeHooks(heartbeat=beats.append),
        )
    tick = ["inside the policy 'fused'", "commanding", "waiting for the next tick", "observing"]
    assert beats == ["waiting for the first pose", "arming", "observing", *tick, *tick, "stopping the car"]


class CoarseCar(FusedCar):
    """Its wire knows tenths only."""

    def command(self, action: Action) -> Action:
        return super().command(Action(round(action.steering, 1), round(action.throttle, 1)))


def test_recorded_and_learned_from_is_what_was_sent() -> None:
    documents: list[Document] = []
    with CoarseCar(Fuse()) as car:
        data = run_episode(
            car,
            FusedPolicy(car.fuse, lambda view: Action(0.234, 0.9)),
            ParkingTask(),
            SafetyEnvelope(max_throttle=0.46),
            period_s=PERIOD_S,
            max_ticks=5,
            hooks=EpisodeHooks(emit=documents.append),
        )
    sent = [0.2, 0.5]
    assert data.sent.tolist() == [sent] * 5
    assert data.requested.tolist() == [[0.234, 0.9]] * 5
    ticks = [d for d in documents if isinstance(d, Tick)]
    assert [t.sent for t in ticks] == [Action(*sent)] * 5
    assert [t.requested for t in ticks] == [Action(0.234, 0.9)] * 5
    moves = [d for d in documents if isinstance(d, Transition)]
    assert [m.action for m in moves] == [Action(*sent)] * 5
    assert moves[-1].next_features[-6:].tolist() == sent * 3
    assert moves[0].reward == ParkingTask().reward(moves[0].features, np.array(sent), moves[0].next_features)


def drive_with_thinking_times(times_in_periods: Callable[[int], float]) -> tuple[str, int]:
    with FusedCar(Fuse()) as car:

        def think(view: PolicyInput) -> Action:
            car.clock.sleep_until(car.clock.now_s() + times_in_periods(view.step) * PERIOD_S)
            return Action()

        policy = FusedPolicy(car.fuse, think)
        data = run_episode(car, policy, ParkingTask(), SafetyEnvelope(), period_s=PERIOD_S, max_ticks=100)
        return data.metadata["end_reason"], data.ticks


@pytest.mark.parametrize(
    ("times", "end"),
    [
        (lambda step: 0.9, ("COMPLETED", 100)),
        # Half a period late and more, or so late that a tick is left out: bad where it is the rule, with 30 ticks seen.
        (lambda step: 1.7, ("LATE_LOOP", 30)),
        (lambda step: 2.1, ("LATE_LOOP", 30)),
        (lambda step: 1.3 if step % 40 < 39 else 1.0, ("LATE_LOOP", 30)),
        (lambda step: 2.1 if step % 2 else 0.0, ("COMPLETED", 100)),
        (lambda step: 2.1 if step >= 50 else 0.0, ("LATE_LOOP", 66)),
    ],
)
def test_late_ticks_end_the_episode_where_they_are_the_rule(
    times: Callable[[int], float], end: tuple[str, int]
) -> None:
    assert drive_with_thinking_times(times) == end
