"""A car with real observations that sends no commands."""

from __future__ import annotations

from collections.abc import Callable

from carlab.core.car import Car
from carlab.core.errors import ActuatorFaultError, NotArmedError, NotOpenError
from carlab.core.quantities import NEUTRAL, Action, CarState, Health, Observation, Reality


class DryRunCar(Car):
    """Wrapper of any car: it forwards observations, checks commands and discards them.

    The wrapped car is never armed; it keeps sending neutral. ``as_sent`` maps an action to the action that the car
    would have sent (for example with the rounding of its calibration); by default it is the identity.
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
        """Observation of the wrapped car, with its errors."""
        return self.car.observe()

    def arm(self) -> None:
        """Arm the dry run; the wrapped car stays disarmed.

        Raises ActuatorFaultError while a fault is latched, NotOpenError when closed.
        """
        self._require_open()
        if self._is_latched:
            raise ActuatorFaultError("The dry run was stopped for safety; reset the fault first.")
        self._is_armed = True

    def command(self, action: Action) -> Action:
        """Check the action and return the action that would have been sent.

        The wrapped car gets neutral, so a lost or faulty motor controller ends a dry run as it ends a drive. Raises
        NotOpenError, ActionOutOfRangeError, NotArmedError and ActuatorFaultError.
        """
        self._require_open()
        self.check(action)
        self.car.command(NEUTRAL)
        if not self._is_armed:
            if action.is_neutral:
                return NEUTRAL
            raise NotArmedError("The car is not armed; arm it before the first moving command.")
        return action if self._as_sent is None else self._as_sent(action)

    def stop(self, *, planned: bool) -> None:
        """Disarm, and stop the wrapped car."""
        self._is_armed = False
        self._is_latched = self._is_latched or not planned
        self.car.stop(planned=planned)

    def reset_fault(self) -> None:
        """Clear the latched fault here and in the wrapped car. Raises NotOpenError when closed."""
        self._require_open()
        self.car.reset_fault()
        self._is_latched = False

    def health(self) -> Health:
        """Health of the wrapped car."""
        return self.car.health()

    def pose_problems(self) -> tuple[str, ...]:
        """Suspected errors of the wrapped car's motion capture."""
        return self.car.pose_problems()

    def place(self, state: CarState) -> bool:
        """Place the wrapped car."""
        return self.car.place(state)

    def seed_noise(self, seed: int) -> None:
        """Seed the noise of the wrapped car."""
        self.car.seed_noise(seed)

    def close(self) -> None:
        """Close the car."""
        self._is_open = self._is_armed = False
        self.car.close()

    def _require_open(self) -> None:
        if not self._is_open:
            raise NotOpenError(f"{self.name} is not open; call open() first, or use it in a with block.")
