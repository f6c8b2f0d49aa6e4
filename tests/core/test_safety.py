"""The safety gate: dense around its bounds, and driven through a car that only writes down what it is told."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from carlab.core.car import Car
from carlab.core.clock import SimulatedClock
from carlab.core.documents import SafetyEvent
from carlab.core.errors import ConfigError, NotArmedError
from carlab.core.geofence import rectangle
from carlab.core.outcome import EndReason
from carlab.core.quantities import Action, ActionLimits, CarState, Health, Observation, Reality
from carlab.core.safety import SafeCar, SafetyEnvelope, SafetyState, SafetyStop, limit, slew

ANY_FLOAT = st.floats(allow_nan=True, allow_infinity=True)
PERIOD_S = 1.0 / 30.0


class LoggingCar(Car):
    """Writes down every command; has no physics."""

    def __init__(self) -> None:
        self.name, self.reality, self.limits, self.clock = (
            "log",
            Reality.SIMULATED,
            ActionLimits(),
            SimulatedClock(10.0),
        )
        self.log: list[Action] = []
        self.stops: list[bool] = []

    def open(self) -> None: ...
    def observe(self) -> Observation:
        return seen(self.clock.now_s())

    def arm(self) -> None: ...
    def command(self, action: Action) -> Action:
        self.check(action)
        self.log.append(action)
        return action

    def stop(self, *, planned: bool) -> None:
        self.stops.append(planned)

    def reset_fault(self) -> None: ...
    def health(self) -> Health:
        return Health(True)

    def close(self) -> None: ...


def seen(t_s: float, state: CarState | None = None, tracked: bool = True) -> Observation:
    return Observation(state or CarState(), t_s, t_s, 1, tracked)


def gate(**envelope: object) -> tuple[SafeCar, LoggingCar, list[SafetyEvent]]:
    car, events = LoggingCar(), []
    safe = SafeCar(car, SafetyEnvelope(**envelope), events.append)  # type: ignore[arg-type]
    return safe, car, events


def test_nothing_passes_before_arming() -> None:
    safe, car, _ = gate()
    with pytest.raises(NotArmedError):
        safe.command(Action(0.1, 0.1), seen(10.0), PERIOD_S)
    assert car.log == []


@given(st.lists(st.tuples(ANY_FLOAT, ANY_FLOAT), max_size=20))
def test_no_command_sequence_gets_past_the_bounds(commands: list[tuple[float, float]]) -> None:
    envelope = SafetyEnvelope(max_steering=0.8, max_throttle=0.3, steering_rate_per_s=3.0, throttle_rate_per_s=2.0)
    car = LoggingCar()
    safe = SafeCar(car, envelope, lambda event: None)
    safe.arm()
    previous = Action()
    for steering, throttle in commands:
        try:
            safe.command(Action(steering, throttle), car.observe(), PERIOD_S)
        except SafetyStop as stop:
            assert stop.reason is EndReason.BAD_COMMAND
            assert not (math.isfinite(steering) and math.isfinite(throttle))
            assert safe.state is SafetyState.FAULT
            assert car.stops == [False]
            break
        sent = car.log[-1]
        assert abs(sent.steering) <= 0.8
        assert abs(sent.throttle) <= 0.3
        # Away from zero a channel moves by no more than its rate allows.
        for now, before, rate in ((sent.steering, previous.steering, 3.0), (sent.throttle, previous.throttle, 2.0)):
            if abs(now) > abs(before) or now * before < 0:
                start = before if now * before >= 0 else 0.0
                assert abs(now - start) <= rate * PERIOD_S * (1 + 1e-9)
        previous = sent
        car.clock.sleep_until(car.clock.now_s() + PERIOD_S)
    with_fault = safe.state is SafetyState.FAULT
    if with_fault:
        before = len(car.log)
        with pytest.raises(NotArmedError):
            safe.command(Action(), car.observe(), PERIOD_S)
        assert len(car.log) == before


@pytest.mark.parametrize(("age_s", "paused"), [(0.0, False), (0.099, False), (0.101, True), (0.499, True)])
def test_a_stale_pose_gives_neutral_and_comes_back(age_s: float, paused: bool) -> None:
    safe, car, events = gate()
    safe.arm()
    sent = safe.command(Action(0.5, 0.5), seen(car.clock.now_s() - age_s), PERIOD_S)
    assert sent.is_neutral is paused
    assert [e.kind for e in events] == (["stale_pose"] if paused else [])
    car.clock.sleep_until(car.clock.now_s() + PERIOD_S)
    assert not safe.command(Action(0.5, 0.5), seen(car.clock.now_s()), PERIOD_S).is_neutral


@pytest.mark.parametrize(("tracked", "reason"), [(True, EndReason.POSE_STALE), (False, EndReason.TRACKING_LOST)])
def test_a_lost_pose_ends_the_episode(tracked: bool, reason: EndReason) -> None:
    safe, car, events = gate()
    safe.arm()
    with pytest.raises(SafetyStop) as caught:
        safe.command(Action(0.5, 0.5), seen(car.clock.now_s() - 0.501, tracked=tracked), PERIOD_S)
    assert caught.value.reason is reason
    assert "501 ms" in str(caught.value)
    assert car.log == []
    assert car.stops == [False]
    assert events[-1].kind == reason.name.lower()


def test_overspeed_and_geofence() -> None:
    arena = rectangle(-1.0, 1.0, -1.0, 1.0)
    for state, reason in [
        (CarState(vx_mps=2.01), EndReason.OVERSPEED),
        (CarState(x_m=1.01), EndReason.GEOFENCE),
        # 0.15 s reaction and 3 m/s^2: 1.5 m/s needs 0.225 + 0.375 = 0.6 m.
        (CarState(x_m=0.41, vx_mps=1.5), EndReason.GEOFENCE),
        (CarState(x_m=-0.41, vx_mps=-1.5), EndReason.GEOFENCE),
        (CarState(y_m=0.41, vy_mps=1.5), EndReason.GEOFENCE),
        (CarState(y_m=0.41, yaw_rad=math.pi / 2, vx_mps=1.5), EndReason.GEOFENCE),
        (CarState(x_m=0.39, vx_mps=1.5), None),
        (CarState(x_m=0.99, vx_mps=-1.5), None),
        (CarState(vx_mps=1.99, x_m=-0.9), None),
    ]:
        safe, car, _ = gate(max_speed_mps=2.0, arena_m=arena)
        safe.arm()
        if reason is None:
            safe.command(Action(0.1, 0.1), seen(10.0, state), PERIOD_S)
            assert len(car.log) == 1
        else:
            with pytest.raises(SafetyStop) as caught:
                safe.command(Action(0.1, 0.1), seen(10.0, state), PERIOD_S)
            assert caught.value.reason is reason, state
            assert car.log == []


@given(st.floats(-1, 1), st.floats(-1, 1), st.floats(0, 2))
def test_slew_reaches_its_target_and_never_holds_back_a_release(target: float, previous: float, step: float) -> None:
    value = slew(target, previous, step)
    assert min(target, previous, 0.0) <= value <= max(target, previous, 0.0)
    if abs(target) <= abs(previous) and target * previous >= 0:
        assert value == target
    assert slew(0.0, previous, 0.0) == 0.0


def test_limit_is_the_identity_inside_the_envelope() -> None:
    action = Action(0.3, -0.2)
    assert limit(action, action, 0.0, SafetyEnvelope()) == action


@pytest.mark.parametrize(
    "bad",
    [{"max_speed_mps": 0.0}, {"max_throttle": 1.2}, {"lost_pose_s": 0.05}, {"deceleration_mps2": -1.0}],
)
def test_an_impossible_envelope_is_refused(bad: dict[str, float]) -> None:
    with pytest.raises(ConfigError):
        SafetyEnvelope(**bad)  # type: ignore[arg-type]
