"""The interface of every car: real, emulated or simulated."""

from __future__ import annotations

from abc import abstractmethod

from carlab.core.clock import Clock
from carlab.core.errors import ActionOutOfRangeError
from carlab.core.quantities import Action, ActionLimits, CarState, Health, Observation, Reality
from carlab.core.resource import Resource


class Car(Resource):
    """Interface of a car.

    Constructing does nothing. ``open`` connects without motion; the car stays disarmed and accepts only neutral.
    ``arm`` enables commands. ``stop`` and ``close`` leave the car in neutral in every state. A failure latches: the
    car accepts no command until ``reset_fault`` and a new ``arm``.
    """

    name: str
    reality: Reality
    limits: ActionLimits
    clock: Clock

    @abstractmethod
    def open(self) -> None:
        """Connect actuator and motion capture; idempotent. Raises NotReadyError with all reasons."""

    @abstractmethod
    def observe(self) -> Observation:
        """Newest state, without blocking. Raises PoseLostError before the first pose, NotOpenError when closed."""

    @abstractmethod
    def arm(self) -> None:
        """Enable commands. Raises NotReadyError with all reasons; ActuatorFaultError while a fault is latched."""

    @abstractmethod
    def command(self, action: Action) -> Action:
        """Post a command, held until the next one or the watchdog's deadline; returns the command that is sent.

        Raises ActionOutOfRangeError (nothing is sent), NotArmedError, ActuatorFaultError, NotOpenError.
        """

    @abstractmethod
    def stop(self, *, planned: bool) -> None:
        """Send neutral and disarm. ``planned=False`` latches a fault. Never raises for a closed car."""

    @abstractmethod
    def reset_fault(self) -> None:
        """Clear a latched fault; the car stays disarmed. Raises ActuatorFaultError if the cause persists."""

    @abstractmethod
    def health(self) -> Health:
        """A snapshot of links, firmware and motion capture."""

    @abstractmethod
    def close(self) -> None:
        """Send neutral, then disconnect. Idempotent and safe after any failure."""

    @property
    def watchdog_trips(self) -> int:
        """Number of times since ``open`` that a command became too old and neutral replaced it; 0 if unknown."""
        return 0

    def pose_problems(self) -> tuple[str, ...]:
        """Suspected errors of motion capture while poses arrive, with their remedies; empty if there are none."""
        return ()

    def place(self, state: CarState) -> bool:
        """Put the car at ``state`` without driving; returns False if a person has to do it."""
        return False

    def seed_noise(self, seed: int) -> None:
        """Restart the random numbers of simulated sensors with a seed; real sensors have none."""

    def check(self, action: Action) -> None:
        """Raise ActionOutOfRangeError if ``action`` is not a number or beyond the limits; sends nothing."""
        if not action.is_finite:
            raise ActionOutOfRangeError(f"{action} is not a number; the policy that made it has diverged.")
        for channel, limit in (("steering", self.limits.max_steering), ("throttle", self.limits.max_throttle)):
            value = getattr(action, channel)
            if abs(value) > limit + 1e-9:
                raise ActionOutOfRangeError(
                    f"{channel} {value:+.3f} is beyond the car's limit of {limit:.3f}; clip it or raise the limit."
                )
