"""A car without physics that records its commands, and a safety gate around it."""

from carlab.core.car import Car
from carlab.core.clock import SimulatedClock
from carlab.core.documents import SafetyEvent
from carlab.core.quantities import Action, ActionLimits, CarState, Health, Observation, Reality
from carlab.core.safety import SafeCar, SafetyEnvelope


class LoggingCar(Car):
    """Record every command; no physics."""

    def __init__(self) -> None:
        self.name, self.reality = "log", Reality.SIMULATED
        self.limits, self.clock = ActionLimits(), SimulatedClock(10.0)
        self.log: list[Action] = []
        self.stops: list[bool] = []
        self.trips = 0

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

    @property
    def watchdog_trips(self) -> int:
        return self.trips

    def close(self) -> None: ...


def seen(t_s: float, state: CarState | None = None, tracked: bool = True) -> Observation:
    return Observation(state or CarState(), t_s, t_s, 1, tracked)


def gate(**envelope: object) -> tuple[SafeCar, LoggingCar, list[SafetyEvent]]:
    car, events = LoggingCar(), []
    safe = SafeCar(car, SafetyEnvelope(**envelope), events.append)  # type: ignore[arg-type]
    return safe, car, events
