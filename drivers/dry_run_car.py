"""A car whose inputs are real and whose commands go nowhere."""

from __future__ import annotations

from collections.abc import Callable

from carlab.core.car import Car
from carlab.core.errors import ActuatorFaultError, NotArmedError, NotOpenError
from carlab.core.quantities import NEUTRAL, Action, CarState, Health, Observation, Reality


class DryRunCar(Car):
    """Wraps any car: observations are passed on, commands are checked and discarded.

    The wrapped car is never armed; it keeps sending neutral. ``as_sent`` turns an action into what the car would
    have sent (a calibration's rounding, for example) and is the identity unless given.
    """

    def __init__(self, car: Car, as_sent: Callable[[Action], Action] | None = None) -> None:
        self.car = car
        self.name = car.name
        self.reality = Reality.DRY_RUN
        self.limits = car.limits
        self.clock = car.clock
        self._as_sent = as_sent
        self._is_open = False
        self._is_armed = False
        self._is_latched = False

    def open(self) -> None:
        """Open the car."""
        self.car.open()
        self._is_open = True

    def observe(self) -> Observation:
        """What the car sees."""
        return self.car.observe()

    def arm(self) -> None:
        """Arm the pretence only."""
        self._require_open()
        if self._is_latched:
            raise ActuatorFaultError("The dry run was stopped for safety; reset the fault first.")
        self._is_armed = True

    def command(self, action: Action) -> Action:
        """Check the action and say what would have been sent."""
        self._require_open()
        self.check(action)
        if not self._is_armed:
            if action.is_neutral:
                return NEUTRAL
            raise NotArmedError("The car is not armed; arm it before the first moving command.")
        return action if self._as_sent is None else self._as_sent(action)

    def stop(self, *, planned: bool) -> None:
        """Disarm; the wrapped car stops as well."""
        self._is_armed = False
        self._is_latched = self._is_latched or not planned
        self.car.stop(planned=planned)

    def reset_fault(self) -> None:
        """Clear the latch here and in the car."""
        self._require_open()
        self.car.reset_fault()
        self._is_latched = False

    def health(self) -> Health:
        """The car's."""
        return self.car.health()

    def place(self, state: CarState) -> bool:
        """The car's."""
        return self.car.place(state)

    def close(self) -> None:
        """Close the car."""
        self._is_open = self._is_armed = False
        self.car.close()

    def _require_open(self) -> None:
        if not self._is_open:
            raise NotOpenError(f"{self.name} is not open; call open() first, or use it in a with block.")
