"""One suite for every car: simulated, emulated over serial, emulated over CAN, dry run, and with --hil a real car.

The emulated cars use the complete hardware path: sender process, bytes on a pty or CAN bus, NatNet over UDP.
"""

import math
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from carlab.cars import choose_car
from carlab.core.car import Car
from carlab.core.errors import (
    ActionOutOfRangeError,
    ActuatorFaultError,
    CarlabError,
    NotArmedError,
    NotOpenError,
    NotReadyError,
)
from carlab.core.quantities import NEUTRAL, Action, CarState, Reality

KINDS = [
    "sim",
    pytest.param("emulated", marks=pytest.mark.realtime),
    pytest.param("emulated-can", marks=pytest.mark.realtime),
    "dry-run",
    pytest.param("real", marks=pytest.mark.hil),
]


def build(kind: str, request: pytest.FixtureRequest) -> Car:
    if kind == "real":
        return choose_car(str(Path(request.config.getoption("--hil")))).car
    if kind == "dry-run":
        return choose_car("sim", dry_run=True).car
    return choose_car(kind).car


@pytest.fixture(params=KINDS)
def closed_car(request: pytest.FixtureRequest) -> Iterator[Car]:
    car = build(request.param, request)
    yield car
    car.close()


@pytest.fixture(scope="module", params=KINDS)
def opened_car(request: pytest.FixtureRequest) -> Iterator[Car]:
    """One car of each kind for all tests that need no new one; an emulated car has three processes."""
    with build(request.param, request) as car:
        yield car


@pytest.fixture
def car(opened_car: Car) -> Iterator[Car]:
    """An open car that is disarmed and has no fault."""
    yield opened_car
    if opened_car.reality is Reality.REAL:
        assert problems_after_waiting(opened_car) == ()
    opened_car.stop(planned=True)
    reset_fault(opened_car)


def problems_after_waiting(car: Car) -> tuple[str, ...]:
    """Problems that do not end within five seconds; on a busy machine the newest pose is late now and then."""
    end_s = car.clock.now_s() + 5.0
    while (problems := car.health().problems) and car.clock.now_s() < end_s:
        wait(car, 0.05)
    return problems


def arm(car: Car) -> None:
    """Arm within five seconds; on a busy machine poses may be late, and the car refuses to arm."""
    within_five_seconds(car, car.arm, NotReadyError)


def reset_fault(car: Car) -> None:
    """Reset within five seconds; on a busy machine an answer of the VESC may be late, and the reset is refused."""
    within_five_seconds(car, car.reset_fault, ActuatorFaultError)


def within_five_seconds(car: Car, action: Callable[[], None], refusal: type[CarlabError]) -> None:
    """Repeat an action while the car refuses it."""
    end_s = car.clock.now_s() + 5.0
    while True:
        try:
            return action()
        except refusal:
            if car.clock.now_s() > end_s:
                raise
            wait(car, 0.05)


def wait(car: Car, seconds: float) -> None:
    car.clock.sleep_until(car.clock.now_s() + seconds)


def hold(car: Car, action: Action, seconds: float) -> None:
    """Command every 30 ms, as a control loop does, so that no watchdog fires."""
    end_s = car.clock.now_s() + seconds
    while car.clock.now_s() < end_s:
        car.command(action)
        wait(car, 0.03)


def test_constructing_does_nothing_and_a_closed_car_raises(closed_car: Car) -> None:
    for use in (closed_car.observe, closed_car.arm, lambda: closed_car.command(NEUTRAL)):
        with pytest.raises(NotOpenError):
            use()
    assert not closed_car.health().ready
    closed_car.stop(planned=True)
    closed_car.stop(planned=False)
    closed_car.close()


def test_open_and_close_are_idempotent(closed_car: Car) -> None:
    closed_car.open()
    closed_car.open()
    assert problems_after_waiting(closed_car) == ()
    closed_car.close()
    closed_car.close()
    with pytest.raises(NotOpenError):
        closed_car.observe()


def test_observations_are_fresh_and_advance(car: Car) -> None:
    first = car.observe()
    wait(car, 0.2)
    second = car.observe()
    assert second.sequence > first.sequence
    assert second.t_capture_s > first.t_capture_s
    assert second.t_receive_s >= second.t_capture_s
    assert 0.0 <= car.clock.now_s() - second.t_receive_s < 0.15
    assert second.tracked
    assert [p.sequence for p in second.poses] == sorted({p.sequence for p in second.poses})
    assert second.poses[-1].sequence == second.sequence
    assert second.velocity_delay_s > 0.0


def test_only_neutral_is_accepted_before_arming(closed_car: Car) -> None:
    with closed_car:
        assert closed_car.command(NEUTRAL).is_neutral
        with pytest.raises(NotArmedError):
            closed_car.command(Action(0.2, 0.2))


@pytest.mark.parametrize(
    "bad", [Action(math.nan, 0), Action(0, math.inf), Action(1.01, 0.0), Action(0.0, -1.5)], ids=str
)
def test_bad_commands_are_refused_and_change_nothing(car: Car, bad: Action) -> None:
    arm(car)
    with pytest.raises(ActionOutOfRangeError):
        car.command(bad)
    with pytest.raises(ActionOutOfRangeError):
        car.check(bad)
    assert car.command(NEUTRAL).is_neutral


def test_command_returns_what_is_sent(car: Car) -> None:
    arm(car)
    for action in (Action(0.5, 0.0), Action(-1.0, 0.0), Action(0.123, 0.0)):
        sent = car.command(action)
        # Device steps: one in a thousand of the servo's range, a third of that in steering.
        assert sent.steering == pytest.approx(action.steering, abs=0.002)
        assert sent.throttle == pytest.approx(action.throttle, abs=0.002)


def test_commands_drive_the_car_forward_and_left(car: Car) -> None:
    if car.reality in (Reality.DRY_RUN, Reality.REAL):
        pytest.skip("this car does not move, or has no space")
    assert car.place(CarState(0.0, 0.0, 0.5))
    start = car.observe().state
    assert math.hypot(start.x_m, start.y_m) < 0.01
    assert start.yaw_rad == pytest.approx(0.5, abs=0.02)
    assert start.speed_mps < 0.1
    arm(car)
    hold(car, Action(0.6, 0.3), 0.8)
    moved = car.observe().state
    # Forward along its heading, turning left.
    assert moved.vx_mps > 0.3
    assert moved.yaw_rate_radps > 0.2
    assert moved.x_m * math.cos(0.5) + moved.y_m * math.sin(0.5) > 0.1


def test_watchdog_sends_neutral_when_commands_stop(car: Car) -> None:
    if car.reality in (Reality.DRY_RUN, Reality.REAL):
        pytest.skip("this car does not move, or has no space")
    car.place(CarState())
    arm(car)
    hold(car, Action(0.0, 0.5), 0.6)
    fast = car.observe().state.vx_mps
    # Without commands: after the deadline of 0.15 s and the command delay of 0.08 s the motor force is zero.
    wait(car, 0.4)
    later = car.observe().state.vx_mps
    wait(car, 0.3)
    latest = car.observe().state.vx_mps
    assert fast > 0.5
    assert latest < later


def test_a_planned_stop_disarms_and_an_unplanned_one_latches(car: Car) -> None:
    arm(car)
    car.stop(planned=True)
    with pytest.raises(NotArmedError):
        car.command(Action(0.1, 0.0))
    arm(car)
    car.stop(planned=False)
    with pytest.raises((ActuatorFaultError, NotArmedError)):
        car.command(Action(0.1, 0.0))
    with pytest.raises(ActuatorFaultError):
        car.arm()
    reset_fault(car)
    with pytest.raises(NotArmedError):
        car.command(Action(0.1, 0.0))
    arm(car)
    assert car.command(Action(0.1, 0.0)).steering > 0


def test_car_can_be_opened_again(closed_car: Car) -> None:
    for _ in range(2):
        with closed_car:
            closed_car.observe()
            arm(closed_car)
            closed_car.command(Action(0.1, 0.0))


def test_reality_of_each_car_is_declared(closed_car: Car, request: pytest.FixtureRequest) -> None:
    kind = request.node.callspec.params["closed_car"]
    expected = {"sim": Reality.SIMULATED, "dry-run": Reality.DRY_RUN, "real": Reality.REAL}
    assert closed_car.reality is expected.get(kind, Reality.EMULATED)
