"""Base classes of effects: three kinds of operators around the base model, each with an identity value.

    measured = O( integrate f + D, driven by I(command) )

* I, input: acts on the commands before the dynamics (``DelayEffect``, ``ActuatorEffect``).
* D, dynamics: changes a load, a grip, a drive, tyre or body force, or adds a state (``DynamicsEffect``).
* O, observation: acts on what is measured (``ObservationEffect``).

An effect stores no numbers: its parameters are arguments of each call, as floats or as one value per car. So simulator,
system identification and the prior over simulators treat them like every other parameter. Each value has the shape ()
or (cars,), and every method acts element by element.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal, Protocol, get_args

from carlab.core.quantities import FloatArray
from sim_backends.array_ops import Ops, Value
from sim_backends.effects.inverse import newton_inverse

GRAVITY_MPS2 = 9.81
SLIP_FLOOR_MPS = 0.3
"""Minimum speed in the denominator of a slip or a slip angle [m/s]."""

Parameters = Mapping[str, Value]
"""Numbers of an effect by name, in the unit of each ``EffectParameter``."""
Triple = tuple[Value, Value, Value]
"""A signal at the start, the middle and the end of an integration step."""
Kind = Literal["input", "dynamics", "observation"]
Dependency = Literal["time", "place", "heading"]
ModelKind = Literal["dynamic", "linear_tyre", "kinematic", "blend"]
MODEL_KINDS: tuple[ModelKind, ...] = get_args(ModelKind)


@dataclass(frozen=True, slots=True)
class EffectParameter:
    """One number of an effect.

    Attributes:
        name: Within the effect.
        unit: SI; "1" for none.
        identity: The value at which the effect does nothing; None means the number of the car file ``same_as``.
        low: Lower physical bound; with ``positive`` the number is above it.
        high: Upper physical bound.
        typical: A typical value for a small race car.
        positive: Whether ``low`` itself is not allowed.
        same_as: Dotted name of the car file's number that replaces a missing value.
        choices: Words of a choice; its number is the position, 0.0 for the first; car files have the word.
        reduces: Dotted name of the car file's number that a negative value reduces, at most to 0.
        is_delay: Whether it delays commands or measurements.
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
    reduces: str = ""
    is_delay: bool = False


@dataclass(frozen=True, slots=True)
class Confusable:
    """A confusable effect and the manoeuvre that separates both.

    Attributes:
        effect: Its id.
        drive: Manoeuvre that separates both effects; "" if there is none.
        reason: Why it separates them, a clause; without a manoeuvre, what to do instead, in sentences.
    """

    effect: str
    drive: str = ""
    reason: str = ""


class ScreeningProbe(Protocol):
    """Data of the recording and the fitted simulator for the choice of screening points."""

    @property
    def values(self) -> Mapping[str, float]:
        """Numbers of the fitted simulator without the effect, by dotted name."""

    @property
    def path_m(self) -> FloatArray:
        """Recorded positions (N, 2) [m]."""

    def points(self, rows: Iterable[Mapping[str, float]]) -> FloatArray:
        """Coordinates (P, n) of P sets of the effect's numbers."""

    def sized(self, directions: Iterable[Mapping[str, float]], held: Sequence[str] = ()) -> list[dict[str, float]]:
        """Sets of numbers along directions from the identity, at sizes that change the prediction errors noticeably.

        A direction has a step for each number in units of its typical size; numbers in ``held`` have their value there.
        """


class Effect:
    """Base of all effects: equation, parameters, dependencies and texts.

    Subclasses are stateless. ``sim_backends.registry.register`` adds an effect to all engines, to the diagnosis and to
    the prior of learning; no other code contains effect ids.
    """

    id: ClassVar[str]
    kind: ClassVar[Kind]
    parameters: ClassVar[tuple[EffectParameter, ...]]
    order: ClassVar[int] = 50
    """Effects of a kind act in ascending order, then by id."""
    depends_on: ClassVar[frozenset[Dependency]] = frozenset()
    """Dependencies besides the body-frame state: time since the first row, place in the world, heading in the world."""
    lag_parameter: ClassVar[str] = ""
    """The parameter that is the delay or time constant of the effect [s]."""
    command: ClassVar[Literal["steering", "throttle"]] = "steering"
    """The command that the effect acts on, or whose changes excite it most."""
    disc_parameters: ClassVar[tuple[str, ...]] = ()
    """The parameters x, y and radius [m] of the disc in which the effect acts."""
    base_models: ClassVar[tuple[ModelKind, ...]] = MODEL_KINDS
    """Kinds of the base model for which the effect is identifiable."""
    confusable: ClassVar[tuple[Confusable, ...]] = ()
    """Confusable effects; each pair is listed at one of both effects."""
    split_into: ClassVar[tuple[tuple[str, ...], ...]] = ()
    """Groups of effects; one effect of each group, together, resembles this effect if their lags are similar."""

    name: ClassVar[str] = ""
    """A noun phrase with its article."""
    summary: ClassVar[str]
    """One sentence without numbers."""
    sentence: ClassVar[str] = ""
    """Clause with the numbers: a template over the parameters, see ``carlab.diagnosis.report.sentences``."""
    refuted_if: ClassVar[str] = ""
    """Observation that would refute the effect, a clause after "if"."""
    catalogued: ClassVar[bool] = True
    """Whether a diagnosis may name the effect; otherwise it is rival physics, described by ``class_statement``."""
    is_general_rival: ClassVar[bool] = True
    """Whether uncatalogued physics is a rival of all effects, and not of a few (``carlab.diagnosis.curves``)."""
    class_statement: ClassVar[str] = ""
    represented_by: ClassVar[tuple[str, ...]] = ()
    """Ids of measured curves that contain the effect; a fit of such a curve omits the effect."""
    fitted_with_curves: ClassVar[bool] = False
    """Whether a fit of measured curves always includes the effect: timing and mounting, which no curve represents."""

    screening_scaled: ClassVar[tuple[str, ...] | None] = None
    """Parameters that screening scales along the direction of the best point; None means all additive ones."""

    def screening_points(self, probe: ScreeningProbe) -> FloatArray | None:
        """Screening points (P, n) of the effect; None for the general rule.

        The general rule varies one number in both directions from its identity, at three sizes of the change in the
        prediction; several numbers are on a grid around their typical values.
        """
        return None

    def ranges(self, values: Mapping[str, float]) -> Mapping[str, tuple[float, float]]:
        """Ranges (low, high) by parameter that depend on numbers of the car file, ``values`` by dotted name."""
        return {}

    def required_method(self) -> str:
        """Name of the method that a subclass has to define; "" without one. ``register`` refuses an effect without."""
        return ""

    def numbers(self, values: Mapping[str, Value]) -> dict[str, Value]:
        """The effect's parameters by name, from numbers by dotted name."""
        return {p.name: values[f"effects.{self.id}.{p.name}"] for p in self.parameters}


class DelayEffect(Effect):
    """A delay of commands."""

    kind: ClassVar[Kind] = "input"

    def required_method(self) -> str:
        """See ``Effect``."""
        return "extra_delays_s"

    def extra_delays_s(self, values: Parameters) -> tuple[Value, Value]:
        """Additional delay of steering and of throttle [s]."""
        raise NotImplementedError


class ActuatorEffect(Effect):
    """An effect between the delayed command and the wheel angle [rad] or the throttle [1]."""

    kind: ClassVar[Kind] = "input"
    has_state: ClassVar[bool] = False

    def required_method(self) -> str:
        """See ``Effect``."""
        return "step" if self.has_state else "apply"

    def apply(self, ops: Ops, command: Value, values: Parameters) -> Value:
        """Output of an effect without memory, in the unit of the command: wheel angle [rad] or throttle [1]."""
        raise NotImplementedError

    def step_numbers(self, ops: Ops, duration_s: Value, values: Parameters) -> Parameters:
        """The numbers that ``step`` gets for steps of ``duration_s`` [s], computed once for each length.

        They are the effect's parameters. Override it to add what depends on parameters and length alone.
        """
        return values

    def step(
        self, ops: Ops, command: Triple, state: Value, duration_s: Value, values: Parameters
    ) -> tuple[Triple, Value]:
        """Output over a step of ``duration_s`` [s] and the state at its end, for an effect with memory.

        Output and state are in the unit of the command: wheel angle [rad] or throttle [1]. ``values`` are those of
        ``step_numbers``. ``command[0]`` is the value just after the start. A held command has the same object three
        times.
        """
        raise NotImplementedError

    def settled(self, command: Value) -> Value:
        """Steady state for a constant ``command``, in the unit of the command."""
        return command


@dataclass(slots=True)
class Forces:
    """Forces on a car at one instant with their inputs; dynamics effects read and change them.

    Units: t_s [s] since the first row of the recording, positions [m], velocities [m/s, rad/s] in the body frame,
    forces [N] in the body frame (side forces in the wheel frame, positive left), moment [N m] about the centre of mass,
    wheel_angle [rad], throttle [1], mass [kg], loads of the axles [N], friction coefficients ``grip_front`` and
    ``grip_rear`` [1]. ``front_axle`` and ``rear_axle`` are distances from the centre of mass [m]. ``full_drive`` is the
    car file's motor force at full throttle, ``damping`` its decrease per speed [N s/m], ``rear_stiffness`` the slope of
    the rear tyre curve, B C [1/rad], ``drive`` the motor's force, ``axle_force`` the F_x of the driven axle
    (drive less damping), ``demand`` the same before wheel slip, ``front_force`` the part of ``axle_force`` at the front
    wheels, along them (None: rear-wheel drive), ``force_x`` all longitudinal forces but the tyres' side forces.
    ``front_per_load`` is the steady side force of the front axle for each newton of its load. ``states`` are the extra
    states of effects by name; an effect puts their time derivatives into ``rates``. ``stiff`` has, within a Runge-Kutta
    step, the ``StiffStep`` of each effect with stiff states, by effect id.
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
    full_drive: Value
    damping: Value
    rear_stiffness: Value
    drive: Value = 0.0
    demand: Value = 0.0
    axle_force: Value = 0.0
    front_force: Value | None = None
    front_per_load: Value = 0.0
    side_front: Value = 0.0
    side_rear: Value = 0.0
    force_x: Value = 0.0
    force_y: Value = 0.0
    moment: Value = 0.0
    states: dict[str, Value] = field(default_factory=dict)
    rates: dict[str, Value] = field(default_factory=dict)
    stiff: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class StepStart:
    """The start of a Runge-Kutta step of length ``step_s`` [s], for effects with stiff states.

    ``states`` are the extra states by name; ``forces`` evaluates the model there, with the mean throttle of the step:
    all forces, and dvx/dt [m/s2]. ``damping`` is the motor's [N s/m].
    """

    states: Mapping[str, Value]
    step_s: Value
    damping: Value
    forces: Callable[[], tuple[Forces, Value]]


class StiffStep(Protocol):
    """One Runge-Kutta step of an effect's stiff states; its effect's hooks find it in ``Forces.stiff``."""

    def finish(self) -> dict[str, Value]:
        """The stiff states at the end of the step by name, each () or (cars,)."""


class DynamicsEffect(Effect):
    """Changes the forces. Override the hooks that are needed; the others cost nothing.

    The hooks run in this order: ``front_slip`` (slip angle of the front wheels), ``on_load`` (axle loads), ``on_grip``
    (friction coefficients), ``on_drive`` (the motor's force), ``on_traction`` (F_x of the driven axle, after damping),
    ``on_body`` (``force_x``, ``force_y`` and ``moment`` at the centre of mass), ``on_transfer`` (loads that depend on
    the acceleration), ``on_tyre`` (side forces of both axles, after the tyre model), ``on_motion`` (rates of states
    that depend on the acceleration). Where load transfer and a limit of the driven axle depend on one another,
    ``on_traction`` and ``on_transfer`` are repeated.
    """

    kind: ClassVar[Kind] = "dynamics"
    states: ClassVar[tuple[str, ...]] = ()
    stiff: ClassVar[bool] = False
    """Whether its states are too fast for Runge-Kutta steps and are stepped by ``stiff_step``."""

    def base_model(
        self, kind: ModelKind, tyre: Mapping[str, Value], values: Parameters
    ) -> tuple[ModelKind, Mapping[str, Value]]:
        """Change the form of the base model and its tyre parameters (``front.mu`` [1], ``rear.B`` [1/rad] ...)."""
        return kind, tyre

    def axle_distances_m(self, ops: Ops, front_m: Value, rear_m: Value, values: Parameters) -> tuple[Value, Value]:
        """Change the distances of the front and of the rear axle from the centre of mass [m]."""
        return front_m, rear_m

    def required_method(self) -> str:
        """See ``Effect``."""
        return "stiff_step" if self.stiff else ""

    def stiff_step(self, ops: Ops, start: StepStart, values: Parameters) -> StiffStep:
        """Begin a step of the stiff states."""
        raise NotImplementedError

    def front_slip(self, ops: Ops, slip_rad: Value, values: Parameters) -> Value:
        """Slip angle of the front tyres [rad] from that of wheels at the servo's angle.

        It is positive where the force is to the right.
        """
        return slip_rad

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
        """Change ``side_front`` and ``side_rear``; add to ``moment`` what depends on the final ``axle_force``."""

    def on_motion(self, ops: Ops, forces: Forces, acceleration_mps2: Value, values: Parameters) -> None:
        """Set rates that depend on dvx/dt [m/s2]."""

    def settled(self, ops: Ops, forces: Forces, values: Parameters) -> dict[str, Value]:
        """Steady states for constant ``forces`` (all forces evaluated), by name."""
        return {}


class ObservationEffect(Effect):
    """Changes the measurement of the true state by motion capture and velocity filter.

    An effect on poses also changes the velocities, which are computed from the poses; ``observe`` changes both.
    """

    kind: ClassVar[Kind] = "observation"
    velocities_only: ClassVar[bool] = False
    """Whether ``observe`` changes the velocity columns alone, so that velocities from measured poses are true."""

    def observe(self, ops: Ops, state: tuple[Value, ...], values: Parameters) -> tuple[Value, ...]:
        """Measured x, y [m], yaw [rad], vx, vy [m/s], yaw rate [rad/s] of a true state in the same order."""
        return state

    def invert(self, ops: Ops, measured: tuple[Value, ...], values: Parameters) -> tuple[Value, ...]:
        """The true state that is measured as ``measured``: the inverse of ``observe``, by Newton's method.

        Override it if there is a closed form.
        """
        return newton_inverse(ops, lambda state: self.observe(ops, state, values), measured)

    def latency_s(self, values: Parameters) -> Value | None:
        """Latency of the measurement [s], replacing the car file's; None if the effect does not change it."""
        return None

    def velocity_time_constant_s(self, values: Parameters) -> Value | None:
        """Time constant of a first-order filter on the velocities [s]; None without a filter."""
        return None
