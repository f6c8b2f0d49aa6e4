"""The control loop of one episode: order of documents, alignment of rows and commands, end reasons, stopped car."""

import itertools
import math
import sys
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from episodes import PERIOD_S, drive_episode
from terminating_parking import TerminatingParking

from carlab.core.documents import Document, EpisodeEnded, EpisodeStarted, HealthReading, SafetyEvent, Tick, Transition
from carlab.core.geofence import rectangle
from carlab.core.manoeuvres import MANOEUVRES, coast_down, steering_chirp, steering_steps
from carlab.core.outcome import EndReason
from carlab.core.policy import PolicyInput
from carlab.core.quantities import NEUTRAL, Action, CarState
from carlab.core.safety import SafetyEnvelope
from carlab.core.task import ParkingTask, RecordedTask
from carlab.experiment.episodes.episode import EpisodeHooks
from carlab.experiment.episodes.scripted_policies import (
    ManoeuvrePolicy,
    NeutralPolicy,
    ReplayPolicy,
    ReverseParkingPolicy,
)
from sim_backends.car_parameters import SimulatorConfig
from sim_backends.simulated_car import SimulatedCar


class FunctionPolicy:
    """A policy that is a function of the tick."""

    name = "function"

    def __init__(self, act: Callable[[int], Action | None]) -> None:
        self._act = act

    def reset(self) -> None: ...

    def act(self, view: PolicyInput) -> Action | None:
        return self._act(view.step)


class StopCountingCar(SimulatedCar):
    """Records for each stop whether it was planned."""

    def __init__(self) -> None:
        super().__init__()
        self.stops: list[bool] = []

    def stop(self, *, planned: bool) -> None:
        self.stops.append(planned)
        super().stop(planned=planned)


def sine_steering(step: int) -> Action:
    return Action(round(0.5 * math.sin(step / 5), 6), 0.3)


def test_documents_are_in_order_and_agree_with_the_arrays() -> None:
    documents: list[Document] = []
    with SimulatedCar() as car:
        data = drive_episode(
            car, FunctionPolicy(sine_steering), max_ticks=40, hooks=EpisodeHooks(emit=documents.append)
        )
    assert isinstance(documents[0], EpisodeStarted)
    assert isinstance(documents[-1], EpisodeEnded)
    ticks = [d for d in documents if isinstance(d, Tick)]
    transitions = [d for d in documents if isinstance(d, Transition)]
    assert [t.step for t in ticks] == [t.step for t in transitions] == list(range(40))
    assert sum(isinstance(d, HealthReading) for d in documents) == 2
    np.testing.assert_array_equal(data.sent, [t.sent.to_array() for t in ticks])
    np.testing.assert_array_equal(data.states[:-1], [t.observation.state.to_array() for t in ticks])
    np.testing.assert_allclose(np.diff(data.times_s), PERIOD_S, atol=1e-12)
    np.testing.assert_array_equal(data.rewards, [t.reward for t in transitions])
    assert documents[-1].total_reward == pytest.approx(data.rewards.sum())
    assert transitions[-1].truncated
    assert not transitions[-1].terminated


def test_transition_holds_the_action_sent_at_its_tick() -> None:
    documents: list[Document] = []
    with SimulatedCar() as car:
        drive_episode(
            car, FunctionPolicy(lambda k: Action(k / 100, 0.0)), max_ticks=20, hooks=EpisodeHooks(emit=documents.append)
        )
    for row in (d for d in documents if isinstance(d, Transition)):
        assert row.action.steering == pytest.approx(row.step / 100)
        expected = [max(row.step + k - 2, 0) / 100 for k in range(3)]
        np.testing.assert_allclose(row.next_features[7::2], expected)
        before = [max(row.step + k - 3, 0) / 100 for k in range(3)]
        np.testing.assert_allclose(row.features[7::2], before)


@pytest.mark.parametrize(
    ("act", "envelope", "reason", "planned"),
    [
        (sine_steering, SafetyEnvelope(), EndReason.COMPLETED, True),
        (lambda k: None if k == 5 else NEUTRAL, SafetyEnvelope(), EndReason.POLICY_FINISHED, True),
        (lambda k: Action(math.nan, 0.0), SafetyEnvelope(), EndReason.BAD_COMMAND, False),
        (lambda k: 1 / 0, SafetyEnvelope(), EndReason.POLICY_ERROR, False),  # type: ignore[return-value]
        (lambda k: Action(0.0, 1.0), SafetyEnvelope(max_speed_mps=0.5), EndReason.OVERSPEED, False),
        (
            lambda k: Action(0.0, 1.0),
            SafetyEnvelope(arena_m=rectangle(-1.5, 1.5, -1.5, 1.5)),
            EndReason.GEOFENCE,
            False,
        ),
    ],
)
def test_episode_ends_with_its_reason_and_a_stopped_car(
    act: Callable[[int], Action | None], envelope: SafetyEnvelope, reason: EndReason, planned: bool
) -> None:
    documents: list[Document] = []
    with StopCountingCar() as car:
        data = drive_episode(car, FunctionPolicy(act), envelope=envelope, hooks=EpisodeHooks(emit=documents.append))
        assert car.stops[-1] is planned
    ended = documents[-1]
    assert isinstance(ended, EpisodeEnded)
    assert ended.reason is reason
    assert data.metadata["end_reason"] == reason.name
    assert data.metadata["end_sentence"] == reason.value
    assert reason.is_safety_stop is not planned
    if reason in (EndReason.GEOFENCE, EndReason.OVERSPEED):
        assert any(isinstance(d, SafetyEvent) and d.kind == reason.name.lower() for d in documents)
    if reason is EndReason.GEOFENCE:
        assert abs(data.states[:, :2]).max() < 1.5


def test_stop_request_ends_the_episode_after_the_tick() -> None:
    requests: list[int] = []

    def stop() -> EndReason | None:
        requests.append(1)
        return EndReason.STOP_REQUESTED if len(requests) > 10 else None

    with SimulatedCar() as car:
        hooks = EpisodeHooks(stop_requested=stop)
        data = drive_episode(car, FunctionPolicy(sine_steering), hooks=hooks)
    assert data.ticks == 10
    assert data.metadata["end_reason"] == "STOP_REQUESTED"


def test_recorder_error_is_raised_after_the_car_is_stopped() -> None:
    def emit(document: Document) -> None:
        if isinstance(document, Tick) and document.step == 3:
            raise OSError(28, "No space left on device")

    with StopCountingCar() as car:
        with pytest.raises(OSError, match="No space"):
            drive_episode(car, FunctionPolicy(sine_steering), hooks=EpisodeHooks(emit=emit))
        assert car.stops == [False]


def test_reached_goal_ends_the_episode_if_the_task_terminates_there() -> None:
    task = TerminatingParking()
    with SimulatedCar() as car:
        car.place(CarState(0.05, 0.0, 0.1))
        data = drive_episode(car, NeutralPolicy(), task)
    assert data.ticks == 1
    assert data.metadata["end_reason"] == "GOAL_REACHED"


def test_replayed_commands_reproduce_the_episode() -> None:
    with SimulatedCar(seed=1) as car:
        car.place(CarState())
        first = drive_episode(car, FunctionPolicy(sine_steering), RecordedTask(CarState(), 60))
    with SimulatedCar(seed=1) as car:
        car.place(CarState())
        policy = ReplayPolicy(first.times_s[:-1], first.sent)
        replayed = drive_episode(car, policy, RecordedTask(CarState(), 100))
    assert replayed.metadata["end_reason"] == "POLICY_FINISHED"
    np.testing.assert_array_equal(replayed.sent, first.sent)
    np.testing.assert_allclose(replayed.states, first.states, atol=1e-9)


def test_parking_policy_parks_from_ten_starts() -> None:
    task = ParkingTask()
    simulator = SimulatorConfig()
    for seed in range(200, 210):
        with SimulatedCar(simulator, seed=seed) as car:
            car.place(task.sample_start(np.random.default_rng(seed)))
            data = drive_episode(
                car, ReverseParkingPolicy.for_car(simulator), task, SafetyEnvelope(arena_m=task.arena_m), max_ticks=150
            )
        assert task.summary(data.times_s, data.states)["success"], (seed, data.states[-1])


@pytest.mark.parametrize("name", sorted(MANOEUVRES))
def test_manoeuvres_stay_in_range_and_end(name: str) -> None:
    manoeuvre = MANOEUVRES[name]()
    times = np.arange(0.0, manoeuvre.duration_s, 0.01)
    commands = [manoeuvre.command(float(t)) for t in times]
    assert all(c is not None and max(abs(c.steering), abs(c.throttle)) <= 1.0 for c in commands)
    assert manoeuvre.command(manoeuvre.duration_s) is None
    assert manoeuvre.command(-0.1) == NEUTRAL
    with SimulatedCar() as car:
        task = RecordedTask(CarState(), 1000)
        data = drive_episode(car, ManoeuvrePolicy(manoeuvre), task)
    assert data.metadata["end_reason"] == "POLICY_FINISHED"
    assert data.ticks == pytest.approx(manoeuvre.duration_s / PERIOD_S, abs=1)


def test_chirp_sweeps_the_requested_frequencies() -> None:
    chirp = steering_chirp(low_hz=0.5, high_hz=3.0, duration_s=12.0, amplitude=0.4)
    t = np.arange(0.0, 12.0, 0.001)
    values = np.array([chirp.at(float(s)).steering for s in t])
    crossings = t[1:][np.diff(np.sign(values)) != 0]
    # The phase 2 pi (f0 + (f1 - f0) t / 2T) t gives 2 * mean frequency * duration zero crossings.
    assert len(crossings) == pytest.approx(2 * 1.75 * 12.0, abs=1)
    assert 1 / (2 * np.diff(crossings)[0]) == pytest.approx(0.7, abs=0.15)
    assert 1 / (2 * np.diff(crossings)[-1]) == pytest.approx(3.0, abs=0.15)


def test_steering_steps_and_coast_down_have_the_requested_levels() -> None:
    steps = steering_steps(small=0.3, large=0.8)
    levels = {steps.at(t).steering for t in np.arange(0, steps.duration_s, 0.05)}
    assert levels == {0.0, 0.3, -0.3, 0.8, -0.8}
    coast = coast_down(throttle=0.5, push_s=1.0, coast_s=2.0)
    assert coast.at(0.99).throttle == 0.5
    assert coast.at(1.01).throttle == 0.0


class WrongAtTick(ParkingTask):
    """A parking task whose reward calls a function at each tick."""

    def __init__(self, reward: Callable[[int], object]) -> None:
        super().__init__()
        object.__setattr__(self, "rewards", map(reward, itertools.count()))

    def reward(self, features: Any, action: Any, next_features: Any) -> Any:
        return next(self.rewards)  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("reward", "detail"),
    [
        (lambda k: 1.0 if k < 5 else 1 / 0, "ZeroDivisionError"),
        (lambda k: 1.0 if k < 5 else math.nan, "The reward is nan"),
        (lambda k: 1.0 if k < 5 else np.zeros(3), "TypeError"),
        (lambda k: 1.0 if k < 5 else sys.exit(0), "SystemExit"),
    ],
)
def test_error_of_a_task_while_driving_stops_the_car_and_keeps_the_ticks(
    reward: Callable[[int], object], detail: str
) -> None:
    with StopCountingCar() as car:
        data = drive_episode(car, FunctionPolicy(sine_steering), WrongAtTick(reward))
        assert car.stops == [False]
    assert data.metadata["end_reason"] == EndReason.TASK_ERROR.name
    assert detail in data.metadata["end_detail"]
    np.testing.assert_array_equal(data.rewards, np.ones(5))
