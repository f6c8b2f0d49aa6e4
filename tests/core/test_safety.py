"""The safety gate: tests near its limits, with a car that only logs its commands."""

import math
from dataclasses import fields, replace

import pytest
from hypothesis import given
from hypothesis import strategies as st
from logging_car import LoggingCar, gate, seen

from carlab.core.errors import ActionOutOfRangeError, ActuatorFaultError, ConfigError, NotArmedError
from carlab.core.geofence import rectangle
from carlab.core.outcome import EndReason
from carlab.core.quantities import Action, ActionLimits, CarState, Observation
from carlab.core.safety import SafeCar, SafetyEnvelope, SafetyState, SafetyStop, limit, slew

ANY_FLOAT = st.floats(allow_nan=True, allow_infinity=True)
PERIOD_S = 1.0 / 30.0
NUMBERS = [f.name for f in fields(SafetyEnvelope) if f.name != "arena_m"]


def test_nothing_passes_before_arming() -> None:
    safe, car, _ = gate()
    with pytest.raises(NotArmedError):
        safe.command(Action(0.1, 0.1), seen(10.0), PERIOD_S)
    assert car.log == []


@given(st.lists(st.tuples(ANY_FLOAT, ANY_FLOAT), max_size=20))
def test_every_command_sequence_stays_within_the_limits(commands: list[tuple[float, float]]) -> None:
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
    if safe.state is SafetyState.FAULT:
        before = len(car.log)
        with pytest.raises(NotArmedError):
            safe.command(Action(), car.observe(), PERIOD_S)
        assert len(car.log) == before


@pytest.mark.parametrize(("age_s", "paused"), [(0.0, False), (0.099, False), (0.101, True), (0.499, True)])
def test_stale_pose_gives_neutral_until_a_fresh_pose(age_s: float, paused: bool) -> None:
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
        (CarState(vx_mps=-2.01), EndReason.OVERSPEED),
        (CarState(vx_mps=1.5, vy_mps=1.5), EndReason.OVERSPEED),
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
def test_slew_reaches_its_target_and_never_limits_motion_to_zero(target: float, previous: float, step: float) -> None:
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
    [
        {"max_throttle": 1.2},
        {"lost_pose_s": 0.05},
        {"deceleration_mps2": -1.0},
        {"reaction_s": -0.1},
        *({name: 0.0} for name in NUMBERS if name != "reaction_s"),
        *({name: math.nan} for name in NUMBERS),
        *({name: math.inf} for name in NUMBERS),
    ],
    ids=str,
)
def test_an_impossible_envelope_is_refused(bad: dict[str, float]) -> None:
    with pytest.raises(ConfigError):
        SafetyEnvelope(**bad)  # type: ignore[arg-type]


STATE_FIELDS = [f.name for f in fields(CarState)]


@pytest.mark.parametrize("name", STATE_FIELDS)
@pytest.mark.parametrize("value", [math.nan, math.inf])
@pytest.mark.parametrize("arena", [(), rectangle(-9.0, 9.0, -9.0, 9.0)], ids=["no arena", "arena"])
def test_a_state_that_is_not_a_number_ends_the_episode(
    name: str, value: float, arena: tuple[tuple[float, float], ...]
) -> None:
    safe, car, _ = gate(arena_m=arena)
    safe.arm()
    with pytest.raises(SafetyStop) as caught:
        safe.command(Action(0.1, 0.1), seen(10.0, replace(CarState(), **{name: value})), PERIOD_S)
    assert caught.value.reason is EndReason.TRACKING_LOST
    assert (car.log, car.stops) == ([], [False])


def test_suspected_error_of_motion_capture_gives_neutral_and_ends_the_episode(monkeypatch: pytest.MonkeyPatch) -> None:
    safe, car, events = gate()
    safe.arm()
    assert not safe.command(Action(0.1, 0.1), seen(10.0), PERIOD_S).is_neutral
    for problems, is_neutral in (((), False), (("the body is tilted.",), True), ((), False)):
        monkeypatch.setattr(car, "pose_problems", lambda problems=problems: problems)
        car.clock.sleep_until(car.clock.now_s() + 0.6)
        assert safe.command(Action(0.1, 0.1), seen(car.clock.now_s()), PERIOD_S).is_neutral is is_neutral
    monkeypatch.setattr(car, "pose_problems", lambda: ("the body is tilted.",))
    for _ in range(2):
        car.clock.sleep_until(car.clock.now_s() + 0.4)
        assert safe.command(Action(0.1, 0.1), seen(car.clock.now_s()), PERIOD_S).is_neutral
    car.clock.sleep_until(car.clock.now_s() + 0.2)
    with pytest.raises(SafetyStop, match=r"may be wrong\. Motion capture reports: the body is tilted\.") as caught:
        safe.command(Action(0.1, 0.1), seen(car.clock.now_s()), PERIOD_S)
    assert caught.value.reason is EndReason.TRACKING_LOST
    assert car.stops == [False]
    assert [event.text for event in events] == ["Neutral while motion capture reports: the body is tilted."] * 2 + [
        f"{EndReason.TRACKING_LOST.value} {caught.value.detail}"
    ]


@pytest.mark.parametrize(
    ("t_capture_s", "t_receive_s", "why"),
    [
        (10.0, math.nan, "arrived nan ms ago"),
        (math.nan, 10.0, "captured nan ms ago"),
        (10.0, 3610.0, "ahead of the car's clock"),
        (9.499, 10.0, "captured 501 ms ago"),
        (9.501, 9.95, None),
        (10.005, 10.005, None),
    ],
)
def test_pose_with_implausible_times_ends_the_episode(t_capture_s: float, t_receive_s: float, why: str | None) -> None:
    safe, car, _ = gate()
    safe.arm()
    observation = Observation(CarState(), t_capture_s, t_receive_s, 1)
    if why is None:
        assert not safe.command(Action(0.1, 0.1), observation, PERIOD_S).is_neutral
        return
    with pytest.raises(SafetyStop, match=why) as caught:
        safe.command(Action(0.1, 0.1), observation, PERIOD_S)
    assert caught.value.reason is EndReason.POSE_STALE
    assert car.log == []


@pytest.mark.parametrize(
    ("state", "dt_capture_s", "dt_receive_s", "leaps"),
    [
        # 2 m/s and 20 rad/s for 0.05 s, and the margins of 0.1 m and 0.5 rad: 0.2 m and 1.5 rad.
        (CarState(x_m=0.199), 0.05, 0.05, False),
        (CarState(x_m=0.201), 0.05, 0.05, True),
        (CarState(x_m=-0.15, y_m=0.15), 0.05, 0.05, True),
        (CarState(yaw_rad=3.0 - 1.49), 0.05, 0.05, False),
        (CarState(yaw_rad=3.0 - 1.51), 0.05, 0.05, True),
        (CarState(yaw_rad=3.0 + 1.49 - 2 * math.pi), 0.05, 0.05, False),
        (CarState(yaw_rad=3.0 - math.pi), 0.05, 0.05, True),
        # Frames that were held up and came in a burst; a camera's clock that was set back.
        (CarState(x_m=0.19), 0.05, 0.001, False),
        (CarState(x_m=0.19), -1.0, 0.05, False),
        (CarState(x_m=0.21), -1.0, 0.05, True),
    ],
)
def test_pose_jump_ends_the_episode(state: CarState, dt_capture_s: float, dt_receive_s: float, leaps: bool) -> None:
    if state.yaw_rad == 0.0:
        state = replace(state, yaw_rad=3.0)
    safe, car, events = gate(max_speed_mps=2.0, lost_pose_s=2.0)
    safe.arm()
    car.clock.sleep_until(10.0 + 1.0)
    safe.command(Action(0.1, 0.1), Observation(CarState(yaw_rad=3.0), 10.95, 10.95, 1), PERIOD_S)
    later = Observation(state, 10.95 + dt_capture_s, 10.95 + dt_receive_s, 2)
    if not leaps:
        safe.command(Action(0.1, 0.1), later, PERIOD_S)
        assert len(car.log) == 2
        return
    with pytest.raises(SafetyStop, match="It moved by") as caught:
        safe.command(Action(0.1, 0.1), later, PERIOD_S)
    assert caught.value.reason is EndReason.POSE_JUMP
    assert car.stops == [False]
    assert events[-1].kind == "pose_jump"
    # The next episode may begin anywhere.
    safe.arm()
    safe.command(Action(0.1, 0.1), later, PERIOD_S)


def test_another_body_at_rest_after_a_gap_is_a_jump() -> None:
    safe, car, _ = gate(max_speed_mps=2.0)
    safe.arm()
    safe.command(Action(0.1, 0.1), seen(10.0), PERIOD_S)
    car.clock.sleep_until(10.4)
    with pytest.raises(SafetyStop) as caught:
        safe.command(Action(0.1, 0.1), seen(10.4, CarState(x_m=1.5)), PERIOD_S)
    assert caught.value.reason is EndReason.POSE_JUMP


def test_an_unknown_speed_gives_neutral_until_it_is_known() -> None:
    safe, car, events = gate()
    safe.arm()
    assert safe.command(Action(0.5, 0.5), replace(seen(10.0), velocity_valid=False), PERIOD_S).is_neutral
    assert safe.state is SafetyState.PAUSED
    assert [e.kind for e in events] == ["unknown_speed"]
    car.clock.sleep_until(10.0 + PERIOD_S)
    assert not safe.command(Action(0.5, 0.5), seen(10.0 + PERIOD_S), PERIOD_S).is_neutral
    assert safe.state is SafetyState.ARMED


def test_events_are_emitted_at_the_start_of_an_intervention_only() -> None:
    safe, car, events = gate(max_throttle=0.2)
    safe.arm()
    for throttle in (0.1, 0.5, 0.6, 0.1, 0.5):
        safe.command(Action(0.0, throttle), seen(car.clock.now_s()), PERIOD_S)
        car.clock.sleep_until(car.clock.now_s() + PERIOD_S)
    assert [e.kind for e in events] == ["limited", "limited"]
    assert [a.throttle for a in car.log] == [0.1, 0.2, 0.2, 0.1, 0.2]


def test_watchdog_trips_are_reported_once_and_from_arming_on() -> None:
    safe, car, events = gate()
    car.trips = 3
    safe.arm()
    for trips in (3, 4, 4, 6):
        car.trips = trips
        safe.command(Action(0.0, 0.1), seen(car.clock.now_s()), PERIOD_S)
        car.clock.sleep_until(car.clock.now_s() + PERIOD_S)
    assert [(e.kind, round((e.t_s - 10.0) / PERIOD_S)) for e in events] == [("watchdog", 1), ("watchdog", 3)]
    assert [a.throttle for a in car.log] == [0.1] * 4


def test_narrower_limit_of_envelope_and_car_applies() -> None:
    for steering, throttle in ((0.3, 0.9), (0.9, 0.3)):
        car = LoggingCar()
        car.limits = ActionLimits(max_steering=0.5, max_throttle=0.5)
        envelope = SafetyEnvelope(
            max_steering=steering, max_throttle=throttle, steering_rate_per_s=1e3, throttle_rate_per_s=1e3
        )
        safe = SafeCar(car, envelope, lambda event: None)
        safe.arm()
        sent = safe.command(Action(1.0, -1.0), seen(10.0), PERIOD_S)
        assert sent == Action(min(steering, 0.5), -min(throttle, 0.5))


@pytest.mark.parametrize("bad", [Action(math.nan, 0.0), Action(0.0, math.inf), Action(-math.inf, math.nan)])
def test_nan_command_never_reaches_the_car(bad: Action) -> None:
    safe, car, _ = gate()
    car.check = lambda action: None  # type: ignore[method-assign]
    safe.arm()
    with pytest.raises(SafetyStop) as caught:
        safe.command(bad, seen(10.0), PERIOD_S)
    assert caught.value.reason is EndReason.BAD_COMMAND
    assert (car.log, car.stops) == ([], [False])


def test_returned_command_is_that_of_the_car() -> None:
    safe, car, _ = gate()
    car.command = lambda action: Action(0.123, round(action.throttle, 1))  # type: ignore[method-assign]
    safe.arm()
    assert safe.command(Action(0.12345, 0.26), seen(10.0), PERIOD_S) == Action(0.123, 0.3)


def test_slew_does_not_accumulate_over_a_gap() -> None:
    safe, car, _ = gate(throttle_rate_per_s=1.0, lost_pose_s=2.0)
    safe.arm()
    assert safe.command(Action(0.0, 1.0), seen(10.0), PERIOD_S).throttle == pytest.approx(PERIOD_S)
    car.clock.sleep_until(15.0)
    assert safe.command(Action(0.0, 1.0), seen(15.0), PERIOD_S).throttle == pytest.approx(3 * PERIOD_S)
    # And the rate is that of real time, whatever the period says.
    car.clock.sleep_until(15.01)
    assert safe.command(Action(0.0, 1.0), seen(15.01), PERIOD_S).throttle == pytest.approx(3 * PERIOD_S + 0.01)


def test_slew_begins_at_neutral_after_arming_and_after_a_pause() -> None:
    safe, car, _ = gate(throttle_rate_per_s=1.0)
    safe.arm()
    for k in range(20):
        safe.command(Action(0.0, 1.0), seen(10.0 + k * PERIOD_S), PERIOD_S)
        car.clock.sleep_until(10.0 + (k + 1) * PERIOD_S)
    assert car.log[-1].throttle > 0.5
    now_s = car.clock.now_s()
    assert safe.command(Action(0.0, 1.0), seen(now_s - 0.2, CarState()), PERIOD_S).is_neutral
    car.clock.sleep_until(now_s + PERIOD_S)
    assert safe.command(Action(0.0, 1.0), seen(now_s + PERIOD_S), PERIOD_S).throttle == pytest.approx(PERIOD_S)
    safe.stop(planned=True)
    safe.arm()
    assert safe.command(Action(0.0, 1.0), seen(now_s + PERIOD_S), PERIOD_S).throttle == pytest.approx(PERIOD_S)


@pytest.mark.parametrize(
    ("error", "reason"),
    [
        (ActuatorFaultError("the link is gone"), EndReason.ACTUATOR_FAULT),
        (NotArmedError("stopped from elsewhere"), EndReason.ACTUATOR_FAULT),
        (ActionOutOfRangeError("beyond the car's limit"), EndReason.BAD_COMMAND),
    ],
)
def test_error_of_the_car_ends_the_episode(error: Exception, reason: EndReason) -> None:
    safe, car, _ = gate()
    safe.arm()

    def refuse(action: Action) -> Action:
        raise error

    car.command = refuse  # type: ignore[method-assign]
    with pytest.raises(SafetyStop) as caught:
        safe.command(Action(0.1, 0.1), seen(10.0), PERIOD_S)
    assert (caught.value.reason, caught.value.detail) == (reason, str(error))
    assert car.stops == [False]
    with pytest.raises(NotArmedError):
        safe.command(Action(), seen(10.0), PERIOD_S)


@given(st.floats(-1, 1), st.floats(-1, 1), st.floats(-2, 0))
def test_zero_time_step_moves_no_command_away_from_zero(target: float, previous: float, dt_s: float) -> None:
    value = limit(Action(0.0, target), Action(0.0, previous), dt_s, SafetyEnvelope()).throttle
    assert abs(value) <= abs(previous)
    assert value * previous >= 0.0


@pytest.mark.parametrize("planned", [True, False])
def test_no_command_passes_after_a_stop(planned: bool) -> None:
    safe, car, _ = gate()
    safe.arm()
    safe.stop(planned=planned)
    assert car.stops == [planned]
    assert safe.state is (SafetyState.DISARMED if planned else SafetyState.FAULT)
    with pytest.raises(NotArmedError):
        safe.command(Action(), seen(10.0), PERIOD_S)
    assert car.log == []
