"""Documents that an episode emits. Recorders and displays receive them; the control loop does not depend on these.

Order: one EpisodeStarted; then Tick, Transition, SafetyEvent and HealthReading as they happen; one EpisodeEnded.
All ``t_s`` are on the car's clock.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from carlab.core.outcome import EndReason
from carlab.core.quantities import Action, FloatArray, Health, Observation, Reality


@dataclass(frozen=True, slots=True)
class EpisodeStarted:
    """The first document. ``goal`` is (x [m], y [m], yaw [rad]).

    ``arena_m`` are corners of the geofence, and ``path_m`` points of the reference path, each (x, y).
    """

    episode: int
    t_s: float
    wall_ns: int
    car: str
    reality: Reality
    policy: str
    task: str
    seed: int
    period_s: float
    history_length: int
    goal: tuple[float, float, float] | None = None
    arena_m: tuple[tuple[float, float], ...] = ()
    path_m: tuple[tuple[float, float], ...] = ()
    config_toml: str = ""
    metadata: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Tick:
    """One control tick: observation, requested action and sent action.

    ``features`` (7 + 2 H,) is the encoded observation of the policy (``carlab.core.observation``); ``late_s`` is the
    lateness of the tick; ``policy_s`` is the computing time of the policy; ``safety_state`` is the gate's state after
    the command.
    """

    step: int
    t_s: float
    late_s: float
    observation: Observation
    features: FloatArray
    requested: Action
    sent: Action
    policy_s: float
    safety_state: str


@dataclass(frozen=True, slots=True)
class Transition:
    """One row of experience: the action sent at tick ``step`` and the observation one period later.

    ``features`` and ``next_features`` (7 + 2 H,) are the encoded observations before and after the action.
    """

    step: int
    t_s: float
    features: FloatArray
    action: Action
    reward: float
    next_features: FloatArray
    terminated: bool
    truncated: bool


@dataclass(frozen=True, slots=True)
class SafetyEvent:
    """A change of a command or of its state by the safety gate. ``kind`` is a short id such as ``geofence``."""

    t_s: float
    kind: str
    text: str


@dataclass(frozen=True, slots=True)
class HealthReading:
    """The car's condition, about once a second."""

    t_s: float
    health: Health


@dataclass(frozen=True, slots=True)
class EpisodeEnded:
    """The last document. ``last`` is the observation after the last command, or None."""

    t_s: float
    reason: EndReason
    detail: str
    steps: int
    total_reward: float
    last: Observation | None = None
    statistics: Mapping[str, float] = field(default_factory=dict)


Document = EpisodeStarted | Tick | Transition | SafetyEvent | HealthReading | EpisodeEnded
