"""What an effect is: one of three kinds of operator around the base model, with a value at which it does nothing.

    measured = O( integrate f + D, driven by I(command) )

* I, input: acts on the commands before the dynamics (``DelayEffect``, ``ActuatorEffect``).
* D, dynamics: changes a load, a grip, a drive, tyre or body force, or adds a state (``DynamicsEffect``).
* O, observation: acts on what is measured (``ObservationEffect``).

An effect holds no numbers: its parameters come with each call, as floats or as one value per car. So the simulator,
system identification and the prior over simulators treat them like every other parameter.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import ClassVar, Literal

from sim_backends.array_ops import Ops, Value

Parameters = Mapping[str, Value]
Triple = tuple[Value, Value, Value]
"""A signal at the start, the middle and the end of an integration step."""
Kind = Literal["input", "dynamics", "observation"]


@dataclass(frozen=True, slots=True)
class EffectParameter:
    """One number of an effect.

    ``identity`` is the value at which the effect does nothing; None means the car file's own figure for the same
    thing. ``low`` and ``high`` are the physical bounds, ``typical`` a size that a small race car may have.
    """

    name: str
    unit: str
    identity: float | None
    low: float
    high: float
    typical: float


class Effect:
    """Base of all effects; subclasses are stateless and are registered in ``sim_backends.effects.EFFECTS``."""

    id: ClassVar[str]
    kind: ClassVar[Kind]
    sentence: ClassVar[str]
    parameters: ClassVar[tuple[EffectParameter, ...]]
    look_alikes: ClassVar[tuple[str, ...]] = ()
    order: ClassVar[int] = 50
    """Effects of a kind act in ascending order."""


class DelayEffect(Effect):
    """Makes commands act later."""

    kind: ClassVar[Kind] = "input"

    def extra_delays_s(self, values: Parameters) -> tuple[Value, Value]:
        """Seconds added to the delay of steering and of throttle."""
        raise NotImplementedError


class ActuatorEffect(Effect):
    """Stands between the delayed command and the wheel angle [rad] or the throttle [1]."""

    kind: ClassVar[Kind] = "input"
    channel: ClassVar[Literal["steering", "throttle"]]
    has_state: ClassVar[bool] = False

    def apply(self, ops: Ops, command: Value, values: Parameters) -> Value:
        """Output of an effect without memory."""
        raise NotImplementedError

    def step(
        self, ops: Ops, command: Triple, state: Value, duration_s: Value, values: Parameters
    ) -> tuple[Triple, Value]:
        """Output over a step of ``duration_s`` and the state at its end, for an effect with memory.

        ``command[0]`` is the value just after the start. A command that is held has three times the same object.
        """
        raise NotImplementedError

    def settled(self, command: Value) -> Value:
        """State after ``command`` has been held for ever."""
        return command


@dataclass(slots=True)
class Forces:
    """Everything that acts on a car at one instant; dynamics effects read and change it.

    Units: t_s [s] since the start, positions [m], velocities [m/s, rad/s] in the body frame, forces [N] in the body
    frame (side forces in the wheel frame, positive left), moment [N m] about the centre of mass, wheel_angle [rad].
    ``states`` are the extra states of effects by name; an effect puts their time derivatives into ``rates``.
    """

    t_s: Value
    x: Value
    y: Value
    yaw: Value
    vx: Value
    vy: Value
    yaw_rate: Value
    wheel_angle: Value
    throttle: Value
    mass: Value
    front_axle: Value
    rear_axle: Value
    load_front: Value
    load_rear: Value
    grip_front: Value
    grip_rear: Value
    drive: Value = 0.0
    side_front: Value = 0.0
    side_rear: Value = 0.0
    force_x: Value = 0.0
    force_y: Value = 0.0
    moment: Value = 0.0
    states: dict[str, Value] = field(default_factory=dict)
    rates: dict[str, Value] = field(default_factory=dict)


class DynamicsEffect(Effect):
    """Changes the forces. Override the hooks that are needed; the others cost nothing.

    Order of the hooks: ``on_load`` (axle loads), ``on_grip`` (friction coefficients), ``on_drive`` (drive force),
    ``on_tyre`` (side forces of both axles, after the tyre model), ``on_body`` (``force_x``, ``force_y`` and
    ``moment`` are added at the centre of mass).
    """

    kind: ClassVar[Kind] = "dynamics"
    states: ClassVar[tuple[str, ...]] = ()
    needs_position: ClassVar[bool] = False

    def on_load(self, ops: Ops, forces: Forces, values: Parameters) -> None:
        """Change ``load_front`` and ``load_rear``."""

    def on_grip(self, ops: Ops, forces: Forces, values: Parameters) -> None:
        """Change ``grip_front`` and ``grip_rear``."""

    def on_drive(self, ops: Ops, forces: Forces, values: Parameters) -> None:
        """Change ``drive``."""

    def on_tyre(self, ops: Ops, forces: Forces, values: Parameters) -> None:
        """Change ``side_front`` and ``side_rear``."""

    def on_body(self, ops: Ops, forces: Forces, values: Parameters) -> None:
        """Add to ``force_x``, ``force_y`` and ``moment``."""


class ObservationEffect(Effect):
    """Changes what motion capture and the velocity filter say of the true state."""

    kind: ClassVar[Kind] = "observation"

    def observe(self, ops: Ops, state: tuple[Value, ...], values: Parameters) -> tuple[Value, ...]:
        """Measured x, y, yaw, vx, vy, yaw rate of a true state."""
        return state

    def latency_s(self, values: Parameters) -> Value | None:
        """Age of what is measured [s], in place of the car file's; None where the effect leaves it alone."""
        return None

    def velocity_time_constant_s(self, values: Parameters) -> Value | None:
        """Time constant of a first-order filter on the velocities [s]; None where there is none."""
        return None
