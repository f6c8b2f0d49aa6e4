"""Driving by hand: a dead-man that means it, through SDL's own event queue."""

import pygame
import pytest

from carlab.core.errors import NotReadyError
from carlab.core.outcome import EndReason
from carlab.core.policy import PolicyInput
from carlab.core.quantities import CarState, Observation
from carlab.experiment.episodes.teleop_policy import (
    GamepadMapping,
    GamepadSource,
    KeyboardSource,
    TeleopInput,
    TeleopPolicy,
    gamepad_input,
)

VIEW = PolicyInput(features=None, observation=Observation(CarState(), 0.0, 0.0, 0), step=0, elapsed_s=0.0)  # type: ignore[arg-type]
REST = [0.0, 0.0, -1.0, 0.0, 0.0, -1.0]


class Hands:
    """A device that says what the test sets."""

    name = "hands"

    def __init__(self) -> None:
        self.now = TeleopInput()
        self.opened = 0

    def open(self) -> None:
        self.opened += 1

    def poll(self) -> TeleopInput:
        return self.now

    def close(self) -> None:
        self.opened -= 1


def test_release_is_neutral_within_one_tick_and_holding_again_drives_on() -> None:
    hands = Hands()
    with TeleopPolicy(hands, max_throttle=0.5) as policy:
        assert hands.opened == 1
        policy.reset()
        hands.now = TeleopInput(steering=0.4, throttle=1.0, deadman=True)
        action = policy.act(VIEW)
        assert action is not None
        assert (action.steering, action.throttle) == (0.4, 0.5)
        hands.now = TeleopInput(steering=0.4, throttle=1.0, deadman=False)
        assert policy.act(VIEW).is_neutral  # type: ignore[union-attr]
        assert policy.stop_reason() is None
        hands.now = TeleopInput(throttle=1.0, deadman=True)
        assert not policy.act(VIEW).is_neutral  # type: ignore[union-attr]
    assert hands.opened == 0


@pytest.mark.parametrize(
    ("event", "reason"),
    [
        (TeleopInput(deadman=True, throttle=1.0, emergency_stop=True), EndReason.EMERGENCY_STOP),
        (TeleopInput(deadman=True, throttle=1.0, present=False), EndReason.DEADMAN_RELEASED),
    ],
)
def test_an_emergency_stop_and_an_unplugged_device_latch(event: TeleopInput, reason: EndReason) -> None:
    hands = Hands()
    policy = TeleopPolicy(hands)
    policy.reset()
    hands.now = event
    assert policy.act(VIEW).is_neutral  # type: ignore[union-attr]
    assert policy.stop_reason() is reason
    hands.now = TeleopInput(deadman=True, throttle=1.0)
    assert policy.act(VIEW).is_neutral  # type: ignore[union-attr]
    assert policy.stop_reason() is reason


def test_finishing_ends_the_script() -> None:
    hands = Hands()
    policy = TeleopPolicy(hands)
    hands.now = TeleopInput(deadman=True, finish=True)
    assert policy.act(VIEW) is None


def test_gamepad_axes_follow_the_conventions() -> None:
    mapping = GamepadMapping()
    buttons = [False] * 12
    assert gamepad_input(REST, buttons, mapping) == TeleopInput()
    left = gamepad_input([-1.0, *REST[1:]], buttons, mapping)
    assert left.steering == pytest.approx(1.0)  # Stick to the left steers left, which is positive.
    forward = gamepad_input([*REST[:5], 1.0], buttons, mapping)
    assert forward.throttle == pytest.approx(1.0)
    both = gamepad_input([0.0, 0.0, 1.0, 0.0, 0.0, 1.0], buttons, mapping)
    assert both.throttle == 0.0
    drift = gamepad_input([0.07, *REST[1:]], buttons, mapping)
    assert drift.steering == 0.0
    held = gamepad_input(REST, [*[False] * 4, True], mapping)
    assert held.deadman
    assert gamepad_input([], [], mapping) == TeleopInput()


def test_no_gamepad_is_a_sentence() -> None:
    with pytest.raises(NotReadyError, match="plug it in"):
        GamepadSource(index=31).open()
    assert not GamepadSource().poll().present


def test_keyboard_through_sdl_events() -> None:
    source = KeyboardSource(throttle=0.4)
    source.open()
    try:
        source.poll()

        def press(key: int) -> None:
            pygame.event.post(pygame.event.Event(pygame.KEYDOWN, key=key))

        for key in (pygame.K_LSHIFT, pygame.K_UP, pygame.K_LEFT):
            press(key)
        assert source.poll() == TeleopInput(steering=1.0, throttle=0.4, deadman=True)
        # Held keys send no events and stay held.
        assert source.poll() == TeleopInput(steering=1.0, throttle=0.4, deadman=True)
        pygame.event.post(pygame.event.Event(pygame.KEYUP, key=pygame.K_LSHIFT))
        assert not source.poll().deadman
        press(pygame.K_LSHIFT)
        assert source.poll().deadman
        pygame.event.post(pygame.event.Event(pygame.WINDOWFOCUSLOST))
        assert source.poll() == TeleopInput()
        press(pygame.K_SPACE)
        assert source.poll().emergency_stop
        pygame.event.post(pygame.event.Event(pygame.QUIT))
        assert source.poll().finish
    finally:
        source.close()
    assert not source.poll().present
