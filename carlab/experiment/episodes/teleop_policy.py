"""Teleoperation by gamepad or keyboard, with a dead-man control.

The car moves only while the dead-man control is held; its release gives neutral within one tick. The device is polled
at each tick. An unplugged gamepad or a window without focus counts as a release.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from typing import Any, Protocol, Self

from carlab.core.errors import NotReadyError
from carlab.core.outcome import EndReason
from carlab.core.policy import PolicyInput
from carlab.core.quantities import NEUTRAL, Action


@dataclass(frozen=True, slots=True)
class TeleopInput:
    """State of an input device. Steering and throttle in [-1, 1], steering positive to the left."""

    steering: float = 0.0
    throttle: float = 0.0
    deadman: bool = False
    emergency_stop: bool = False
    finish: bool = False
    present: bool = True


class InputSource(Protocol):
    """An input device; ``open`` connects to it."""

    name: str

    def open(self) -> None:
        """Open the device. Raises NotReadyError with a remedy."""

    def poll(self) -> TeleopInput:
        """Current state of the device, without blocking."""

    def close(self) -> None:
        """Release the device. Idempotent."""


# SDL numbers of axes and buttons of common gamepads; triggers read -1 when released and +1 when pressed.
STEERING_AXIS, FORWARD_AXIS, REVERSE_AXIS = 0, 5, 2
DEADMAN_BUTTON, EMERGENCY_BUTTON, FINISH_BUTTON = 4, 1, 7
DEAD_ZONE = 0.08


def gamepad_input(axes: list[float], buttons: list[bool]) -> TeleopInput:
    """Convert raw axes in [-1, 1] and buttons; a missing axis or button counts as released."""

    def axis(index: int, rest: float) -> float:
        return axes[index] if index < len(axes) else rest

    def button(index: int) -> bool:
        return index < len(buttons) and buttons[index]

    def without_dead_zone(value: float) -> float:
        size = max(abs(value) - DEAD_ZONE, 0.0) / (1.0 - DEAD_ZONE)
        return size if value > 0 else -size

    forward = 0.5 * (axis(FORWARD_AXIS, -1.0) + 1.0)
    reverse = 0.5 * (axis(REVERSE_AXIS, -1.0) + 1.0)
    return TeleopInput(
        steering=-without_dead_zone(axis(STEERING_AXIS, 0.0)),
        throttle=without_dead_zone(forward - reverse),
        deadman=button(DEADMAN_BUTTON),
        emergency_stop=button(EMERGENCY_BUTTON),
        finish=button(FINISH_BUTTON),
    )


def _pygame(*, window: bool) -> Any:
    """Import pygame on demand, without its banner; without a window it uses SDL's dummy video driver."""
    os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
    if not window:
        os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
    import pygame

    return pygame


@dataclass(slots=True)
class GamepadSource:
    """Gamepad number ``index``, by default the first."""

    index: int = 0
    name: str = "gamepad"
    _pygame: Any = None
    _stick: Any = None
    # SDL reports triggers as 0 (pressed half-way) until their first event; until then they count as released.
    _touched: set[int] = field(default_factory=set)

    def open(self) -> None:
        """Open the gamepad. Raises NotReadyError if it is not connected."""
        self._pygame = _pygame(window=False)
        self._pygame.display.init()
        self._pygame.joystick.init()
        count = self._pygame.joystick.get_count()
        if self.index >= count:
            self.close()
            raise NotReadyError(
                "Gamepad", [f"number {self.index} is missing ({count} found); plug it in, press a button, try again."]
            )
        self._stick = self._pygame.joystick.Joystick(self.index)
        self._stick.init()

    def poll(self) -> TeleopInput:
        """Current state of the gamepad; ``present`` is False if it was unplugged."""
        if self._stick is None:
            return TeleopInput(present=False)
        for event in self._pygame.event.get():
            if event.type == self._pygame.JOYDEVICEREMOVED:
                self._stick = None
                return TeleopInput(present=False)
            if event.type == self._pygame.JOYAXISMOTION:
                self._touched.add(event.axis)
        triggers = (FORWARD_AXIS, REVERSE_AXIS)
        axes = [
            -1.0 if i in triggers and i not in self._touched else float(self._stick.get_axis(i))
            for i in range(self._stick.get_numaxes())
        ]
        buttons = [bool(self._stick.get_button(i)) for i in range(self._stick.get_numbuttons())]
        return gamepad_input(axes, buttons)

    def close(self) -> None:
        """Release the gamepad. Idempotent."""
        self._stick = None
        self._touched.clear()
        if self._pygame is not None:
            self._pygame.quit()
            self._pygame = None


@dataclass(slots=True)
class KeyboardSource:
    """Arrow keys or WASD in a small window; shift is the dead-man control, space stops at once, escape ends."""

    throttle: float = 0.4
    name: str = "keyboard"
    _pygame: Any = None
    _held: set[int] = field(default_factory=set)

    def open(self) -> None:
        """Open the window that receives the keys. Raises NotReadyError without a desktop."""
        self._pygame = _pygame(window=True)
        try:
            self._pygame.display.init()
            self._pygame.display.set_mode((420, 120))
        except self._pygame.error as error:
            self.close()
            raise NotReadyError(
                "Keyboard", [f"no window can be opened ({error}); run it on a desktop, or use a gamepad."]
            ) from error
        self._pygame.display.set_caption("carlab: hold SHIFT, drive with the arrows, SPACE stops, ESC ends")

    def poll(self) -> TeleopInput:
        """Currently held keys; none if the window has lost the focus."""
        if self._pygame is None:
            return TeleopInput(present=False)
        pg = self._pygame
        emergency = finish = False
        for event in pg.event.get():
            if event.type == pg.KEYDOWN:
                self._held.add(event.key)
                emergency |= event.key == pg.K_SPACE
                finish |= event.key == pg.K_ESCAPE
            elif event.type == pg.KEYUP:
                self._held.discard(event.key)
            elif event.type == pg.WINDOWFOCUSLOST:
                self._held.clear()
            elif event.type == pg.QUIT:
                finish = True

        def held(*keys: int) -> bool:
            return any(key in self._held for key in keys)

        return TeleopInput(
            steering=float(held(pg.K_LEFT, pg.K_a)) - float(held(pg.K_RIGHT, pg.K_d)),
            throttle=self.throttle * (float(held(pg.K_UP, pg.K_w)) - float(held(pg.K_DOWN, pg.K_s))),
            deadman=held(pg.K_LSHIFT, pg.K_RSHIFT),
            emergency_stop=emergency,
            finish=finish,
        )

    def close(self) -> None:
        """Close the window."""
        self._held.clear()
        if self._pygame is not None:
            self._pygame.quit()
            self._pygame = None


class TeleopPolicy:
    """A policy that polls an input source at each tick; pass ``stop_reason`` to the episode's hooks."""

    def __init__(self, source: InputSource, max_throttle: float = 1.0) -> None:
        self.name = f"teleop:{source.name}"
        self._source = source
        self._max_throttle = max_throttle
        self._stop: EndReason | None = None

    def __enter__(self) -> Self:
        self._source.open()
        return self

    def __exit__(self, *exc_info: object) -> None:
        self._source.close()

    def reset(self) -> None:
        """Clear an earlier stop."""
        self._stop = None

    def act(self, view: PolicyInput) -> Action | None:
        """The driver's action while the dead-man control is held, else neutral; None once the driver ends."""
        driver = self._source.poll()
        if not driver.present:
            self._stop = EndReason.DEADMAN_RELEASED
        elif driver.emergency_stop:
            self._stop = EndReason.EMERGENCY_STOP
        elif driver.finish:
            return None
        if self._stop is not None or not driver.deadman:
            return NEUTRAL
        return Action(driver.steering, driver.throttle * self._max_throttle)

    def stop_reason(self) -> EndReason | None:
        """Emergency stop or lost device; None without either."""
        return self._stop
