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
from typing import ClassVar, Literal, Protocol

from sim_backends.array_ops import Ops, Value

GRAVITY_MPS2 = 9.81

Parameters = Mapping[str, Value]
Triple = tuple[Value, Value, Value]
"""A signal at the start, the middle and the end of an integration step."""
Kind = Literal["input", "dynamics", "observation"]


@dataclass(frozen=True, slots=True)
class EffectParameter:
    """One number of an effect.

    ``identity`` is the value at which the effect does nothing; None means the number of the car file named by
    ``same_as``. ``low`` and ``high`` are the physical bounds (``positive``: above ``low``), ``typical`` a size that a
    small race car may have. A choice among ``choices`` is their position, 0.0 for the first; car files spell it out.
    """

    name: str
    unit: str
    identity: float | None
    low: float
    high: float
    typical: float
    positive: bool = False
    same_as: str = ""
    choices: tuple[str, ...] = ()


class Effect:
    """Base of all effects; subclasses are stateless and are registered in ``sim_backends.effects.EFFECTS``."""

    id: ClassVar[str]
    kind: ClassVar[Kind]
    sentence: ClassVar[str]
    parameters: ClassVar[tuple[EffectParameter, ...]]
    look_alikes: ClassVar[tuple[str, ...]] = ()
    catalogued: ClassVar[bool] = True
    """Whether it has an id of the catalogue, by which a diagnosis may name it."""
    class_statement: ClassVar[str] = ""
    """What a diagnosis says instead of a name that is not in the catalogue."""
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

    Units: t_s [s] since the first row of the recording, positions [m], velocities [m/s, rad/s] in the body frame,
    forces [N] in the body frame (side forces in the wheel frame, positive left), moment [N m] about the centre of
    mass, wheel_angle [rad]. ``drive`` is the motor's force, ``axle_force`` the F_x of the driven axle (drive less
    damping), ``demand`` the same before wheel slip, ``force_x`` all longitudinal forces but the tyres' side forces.
    ``front_per_load`` is the steady side force of the front axle for each newton of its load. ``states`` are the extra
    states of effects by name; an effect puts their time derivatives into ``rates``. ``stiff`` is there within a
    Runge-Kutta step that treats stiff states.
    """

    t_s: Value
    x: Value
    y: Value
    yaw: Value
    vx: Value
    vy: Value
    yaw_rate: Value
    wheel_angle: Value
    wheel_sin: Value
    wheel_cos: Value
    throttle: Value
    mass: Value
    front_axle: Value
    rear_axle: Value
    load_front: Value
    load_rear: Value
    grip_front: Value
    grip_rear: Value
    drive: Value = 0.0
    demand: Value = 0.0
    axle_force: Value = 0.0
    front_per_load: Value = 0.0
    side_front: Value = 0.0
    side_rear: Value = 0.0
    force_x: Value = 0.0
    force_y: Value = 0.0
    moment: Value = 0.0
    states: dict[str, Value] = field(default_factory=dict)
    rates: dict[str, Value] = field(default_factory=dict)
    stiff: StiffValues | None = None


class StiffValues(Protocol):
    """What a Runge-Kutta step with stiff states puts in the place of their differential equations."""

    axle_force: Value | None
    """Mean force of the driven wheels over the step [N]."""

    def lagging_sides(self, vx: Value, steady_front: Value, steady_rear: Value) -> tuple[Value, Value]:
        """Side forces of the axles at a stage [N], from vx and the steady ones of that stage."""


class DynamicsEffect(Effect):
    """Changes the forces. Override the hooks that are needed; the others cost nothing.

    The hooks run in this order: ``on_load`` (axle loads), ``on_grip`` (friction coefficients), ``on_drive`` (the
    motor's force), ``on_traction`` (F_x of the driven axle, after damping), ``on_body`` (``force_x``, ``force_y`` and
    ``moment`` at the centre of mass), ``on_transfer`` (loads that depend on the acceleration), ``on_tyre`` (side forces
    of both axles, after the tyre model), ``on_motion`` (rates of states that depend on the acceleration). Where load
    transfer and a limit of the driven axle depend on one another, ``on_traction`` and ``on_transfer`` are repeated.
    """

    kind: ClassVar[Kind] = "dynamics"
    states: ClassVar[tuple[str, ...]] = ()
    stiff: ClassVar[bool] = False
    """Whether its states are stepped by ``stiff_step`` instead of Runge-Kutta."""
    needs_position: ClassVar[bool] = False

    def on_load(self, ops: Ops, forces: Forces, values: Parameters) -> None:
        """Change ``load_front`` and ``load_rear``."""

    def on_grip(self, ops: Ops, forces: Forces, values: Parameters) -> None:
        """Change ``grip_front`` and ``grip_rear``."""

    def on_drive(self, ops: Ops, forces: Forces, values: Parameters) -> None:
        """Change ``drive``."""

    def on_traction(self, ops: Ops, forces: Forces, values: Parameters) -> None:
        """Change ``axle_force``."""

    def on_body(self, ops: Ops, forces: Forces, values: Parameters) -> None:
        """Add to ``force_x``, ``force_y`` and ``moment``."""

    def on_transfer(self, ops: Ops, forces: Forces, values: Parameters) -> None:
        """Change ``load_front`` and ``load_rear`` by what ``force_x`` and ``front_per_load`` do to them."""

    def on_tyre(self, ops: Ops, forces: Forces, values: Parameters) -> None:
        """Change ``side_front`` and ``side_rear``."""

    def on_motion(self, ops: Ops, forces: Forces, acceleration_mps2: Value, values: Parameters) -> None:
        """Set rates that depend on dvx/dt."""

    def settled(self, ops: Ops, forces: Forces, values: Parameters) -> dict[str, Value]:
        """States after the car has driven on as in ``forces`` (all forces found) for ever, by name."""
        return {}


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
