"""Driving by hand: dead-man switch, latching stops, gamepad axes, and keyboard input through SDL's event queue."""

import pygame
import pytest

from carlab.core.errors import NotReadyError
from carlab.core.outcome import EndReason
from carlab.core.policy import PolicyInput
from carlab.core.quantities import CarState, Observation
from carlab.experiment.episodes.teleop_policy import (
    GamepadSource,
    KeyboardSource,
    TeleopInput,
    TeleopPolicy,
    gamepad_input,
)

VIEW = PolicyInput(features=None, observation=Observation(CarState(), 0.0, 0.0, 0), step=0, elapsed_s=0.0)  # type: ignore[arg-type]
AXES_AT_REST = [0.0, 0.0, -1.0, 0.0, 0.0, -1.0]


class FakeDevice:
    """An input device that returns the input ``now``."""

    name = "fake device"

    def __init__(self) -> None:
        self.now = TeleopInput()
        self.opened = 0

    def open(self) -> None:
        self.opened += 1

    def poll(self) -> TeleopInput:
        return self.now

    def close(self) -> None:
        self.opened -= 1


def test_released_dead_man_switch_gives_neutral_until_it_is_held_again() -> None:
    device = FakeDevice()
    with TeleopPolicy(device, max_throttle=0.5) as policy:
        assert device.opened == 1
        policy.reset()
        device.now = TeleopInput(steering=0.4, throttle=1.0, deadman=True)
        action = policy.act(VIEW)
        assert action is not None
        assert (action.steering, action.throttle) == (0.4, 0.5)
        device.now = TeleopInput(steering=0.4, throttle=1.0, deadman=False)
        assert policy.act(VIEW).is_neutral  # type: ignore[union-attr]
        assert policy.stop_reason() is None
        device.now = TeleopInput(throttle=1.0, deadman=True)
        assert not policy.act(VIEW).is_neutral  # type: ignore[union-attr]
    assert device.opened == 0


@pytest.mark.parametrize(
    ("event", "reason"),
    [
        (TeleopInput(deadman=True, throttle=1.0, emergency_stop=True), EndReason.EMERGENCY_STOP),
        (TeleopInput(deadman=True, throttle=1.0, present=False), EndReason.DEADMAN_RELEASED),
    ],
)
def test_emergency_stop_and_unplugged_device_latch(event: TeleopInput, reason: EndReason) -> None:
    device = FakeDevice()
    policy = TeleopPolicy(device)
    policy.reset()
    device.now = event
    assert policy.act(VIEW).is_neutral  # type: ignore[union-attr]
    assert policy.stop_reason() is reason
    device.now = TeleopInput(deadman=True, throttle=1.0)
    assert policy.act(VIEW).is_neutral  # type: ignore[union-attr]
    assert policy.stop_reason() is reason


def test_finish_input_ends_the_policy() -> None:
    device = FakeDevice()
    policy = TeleopPolicy(device)
    device.now = TeleopInput(deadman=True, finish=True)
    assert policy.act(VIEW) is None


def test_gamepad_axes_follow_the_sign_conventions() -> None:
    buttons = [False] * 12
    assert gamepad_input(AXES_AT_REST, buttons) == TeleopInput()
    left = gamepad_input([-1.0, *AXES_AT_REST[1:]], buttons)
    assert left.steering == pytest.approx(1.0)  # Stick to the left steers left, which is positive.
    forward = gamepad_input([*AXES_AT_REST[:5], 1.0], buttons)
    assert forward.throttle == pytest.approx(1.0)
    both = gamepad_input([0.0, 0.0, 1.0, 0.0, 0.0, 1.0], buttons)
    assert both.throttle == 0.0
    drift = gamepad_input([0.07, *AXES_AT_REST[1:]], buttons)
    assert drift.steering == 0.0
    held = gamepad_input(AXES_AT_REST, [*[False] * 4, True])
    assert held.deadman
    assert gamepad_input([], []) == TeleopInput()


def test_missing_gamepad_is_reported() -> None:
    with pytest.raises(NotReadyError, match="plug it in"):
        GamepadSource(index=31).open()
    assert not GamepadSource().poll().present


def test_keyboard_input_follows_sdl_events() -> None:
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
