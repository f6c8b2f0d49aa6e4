"""Measured curves: a curve of the base model plus a deviation that recordings determine at fixed knots.

Between knots the deviation is linear, in two dimensions bilinear; beyond the last knot it is constant. All deviations
are 0 for the car file's own curve. A diagnosis fits curves where the effects of the catalogue do not explain a
recording; their roughness is penalised (``MeasuredCurve.roughness``; penalised splines: Eilers and Marx 1996).
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from carlab.core.quantities import FloatArray
from sim_backends.array_ops import Ops, Value
from sim_backends.effects.base import (
    SLIP_FLOOR_MPS,
    ActuatorEffect,
    DynamicsEffect,
    Effect,
    EffectParameter,
    Forces,
    Parameters,
)


@dataclass(frozen=True, slots=True)
class Axis:
    """An input of a curve: name, symbol, unit and knots in ascending order.

    ``anchor`` is a knot at which the deviation is always 0.
    """

    name: str
    unit: str
    knots: tuple[float, ...]
    anchor: float | None = None


class MeasuredCurve(Effect):
    """Base of measured curves. The parameters are the deviations at the knots, ``value_3`` or ``value_3_2``."""

    axes: ClassVar[tuple[Axis, ...]]
    unit: ClassVar[str]
    quantity: ClassVar[str]
    """What the curve gives, a noun phrase."""
    typical: ClassVar[float]
    """Deviation that counts as one unit of the roughness penalty."""
    bound: ClassVar[float]
    """Largest deviation."""
    catalogued: ClassVar[bool] = False
    is_general_rival: ClassVar[bool] = False
    in_fits_of_curves: ClassVar[bool] = True
    """Whether ``--curves`` fits it; otherwise a diagnosis uses it only as a rival of named effects."""

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        if "axes" in cls.__dict__:
            cls.parameters = tuple(
                EffectParameter(_name(place), cls.unit, 0.0, -cls.bound, cls.bound, cls.typical)
                for place in free_knots(cls.axes)
            )

    def numbers(self, values: Mapping[str, Value]) -> dict[str, Value]:
        """Coefficients of ``deviation`` by place, from numbers by dotted name; computed once for a rollout."""
        return self.coefficients({p.name: values[f"effects.{self.id}.{p.name}"] for p in self.parameters})

    def coefficients(self, deviations: Mapping[str, Value]) -> dict[str, Value]:
        """Coefficients of the products of clipped coordinates, from deviations by name.

        In one dimension ``c(x) = a_0 + sum_k s_k clip(x, x_k, x_k+1)`` with the slopes ``s_k`` between knots; in two
        dimensions this holds along each axis in turn. Each term costs one multiplication and addition.
        """
        grid: dict[tuple[int, ...], Value] = {place: deviations[_name(place)] for place in free_knots(self.axes)}
        for axis, description in enumerate(self.axes):
            rows: dict[tuple[int, ...], dict[int, Value]] = {}
            for place, value in grid.items():
                rows.setdefault((*place[:axis], *place[axis + 1 :]), {})[place[axis]] = value
            grid = {
                (*rest[:axis], k, *rest[axis:]): value
                for rest, row in rows.items()
                for k, value in enumerate(_slopes(row, description.knots))
            }
        return {_name(place): value for place, value in grid.items()}

    def deviation(self, ops: Ops, coordinates: Sequence[Value], coefficients: Mapping[str, Value]) -> Value:
        """The deviation in ``unit`` at ``coordinates``, one value () or (cars,) for each axis in its unit."""
        clipped = [
            [ops.clip(x, low, high) for low, high in itertools.pairwise(axis.knots)]
            for x, axis in zip(coordinates, self.axes, strict=True)
        ]
        if len(clipped) == 1:
            return _polynomial(ops, clipped[0], [coefficients[_name((k,))] for k in range(len(clipped[0]) + 1)])
        columns = [
            _polynomial(ops, clipped[0], [coefficients[_name((k, j))] for k in range(len(clipped[0]) + 1)])
            for j in range(len(clipped[1]) + 1)
        ]
        return _polynomial(ops, clipped[1], columns)

    def base_curve(self, values: Mapping[str, float], *coordinates: FloatArray) -> FloatArray:
        """The base model's curve (...) in ``unit`` at ``coordinates``, each (...), from numbers by dotted name."""
        raise NotImplementedError

    def coordinates(self, ops: Ops, forces: Forces) -> tuple[Value, ...]:
        """The inputs of the curve for a state of the car: one value for each axis in its unit."""
        raise NotImplementedError

    def table(self, values: Mapping[str, float]) -> list[Any]:
        """Deviations at all knots as a list, or a list of rows, from numbers by name; 0 at anchors."""
        grid = np.zeros([len(axis.knots) for axis in self.axes])
        for place in free_knots(self.axes):
            grid[place] = values[_name(place)]
        return list(grid.tolist())

    @classmethod
    def numbers_of_table(cls, table: object) -> dict[str, float] | None:
        """Numbers by name from the list of ``table``; None if its shape is wrong or an entry is not a number."""
        try:
            grid = np.array(table, dtype=np.float64)
        except (TypeError, ValueError):
            return None
        if grid.shape != tuple(len(axis.knots) for axis in cls.axes) or not np.isfinite(grid).all():
            return None
        return {_name(place): float(grid[place]) for place in free_knots(cls.axes)}

    @classmethod
    def roughness(cls) -> FloatArray:
        """Rows (r, n) whose products with the n deviations are changes of slope, in units of the deviation.

        A row is ``h ((c_k+1 - c_k) / h_k - (c_k - c_k-1) / h_k-1)`` for neighbouring knots along one axis, with the
        distances h_k between them and their mean h.
        """
        places = {place: k for k, place in enumerate(free_knots(cls.axes))}
        rows = []
        for axis, knots in enumerate(a.knots for a in cls.axes):
            ranges = [range(len(a.knots)) for k, a in enumerate(cls.axes) if k != axis]
            for rest, k in itertools.product(itertools.product(*ranges), range(1, len(knots) - 1)):
                before, after = knots[k] - knots[k - 1], knots[k + 1] - knots[k]
                mean = 0.5 * (before + after)
                row = np.zeros(len(places))
                for j, weight in ((k - 1, 1 / before), (k, -1 / before - 1 / after), (k + 1, 1 / after)):
                    place = (*rest[:axis], j, *rest[axis:])
                    if place in places:  # otherwise the deviation is 0 there
                        row[places[place]] = mean * weight
                rows.append(row)
        return np.array(rows)


def free_knots(axes: Sequence[Axis]) -> list[tuple[int, ...]]:
    """Indices of the knots of a grid, in row-major order, without anchors."""
    ranges = [[k for k, x in enumerate(axis.knots) if x != axis.anchor] for axis in axes]
    return list(itertools.product(*ranges))


def _slopes(row: Mapping[int, Value], knots: Sequence[float]) -> list[Value]:
    """``a_0`` and the slopes of a row of deviations by knot; a missing deviation is 0."""
    values = [row.get(k, 0.0) for k in range(len(knots))]
    slopes = [
        (after - before) * (1.0 / (high - low))
        for (before, after), (low, high) in zip(itertools.pairwise(values), itertools.pairwise(knots), strict=True)
    ]
    first = values[0]
    for slope, low in zip(slopes, knots[:-1], strict=True):
        first = first - slope * low
    return [first, *slopes]


def _polynomial(ops: Ops, clipped: Sequence[Value], coefficients: Sequence[Value]) -> Value:
    """``a_0 + sum_k s_k clipped_k``."""
    total = coefficients[0]
    for x, slope in zip(clipped, coefficients[1:], strict=True):
        total = ops.fma(slope, x, total)
    return total


def weights(ops: Ops, x: Value, knots: Sequence[float]) -> list[Value]:
    """Weights of the knots for linear interpolation at ``x``, constant beyond the last knots; they add up to 1.

    Returns:
        One weight for each knot, in the shape of ``x``.
    """
    shares = [ops.clip((x - low) * (1.0 / (high - low)), 0.0, 1.0) for low, high in itertools.pairwise(knots)]
    return [1.0 - shares[0], *(a - b for a, b in itertools.pairwise(shares)), shares[-1]]


@functools.cache
def _name(place: tuple[int, ...]) -> str:
    return "_".join(("value", *map(str, place)))


class DriveMap(MeasuredCurve, DynamicsEffect):
    """``F_x += m a(throttle, vx)``: the motor's force, per mass of the car, over throttle and speed.

    The base model has ``F_x = drive_gain u - damping vx``. A motor controller that holds a speed, brakes when the
    throttle is released, or saturates has another map.
    """

    id = "drive_map"
    quantity = "acceleration by the motor"
    summary = "The drive acceleration is a measured map over throttle and speed."
    class_statement = "a map of the drive force over throttle and speed"
    command = "throttle"
    order = 25
    unit, typical, bound = "m/s2", 1.0, 40.0
    axes = (
        Axis("throttle", "1", (-1.0, -0.6, -0.35, -0.2, -0.1, -0.04, 0.0, 0.04, 0.1, 0.2, 0.35, 0.6, 1.0)),
        Axis("speed", "m/s", (-4.5, -3.0, -2.0, -1.0, -0.5, 0.0, 0.5, 1.0, 2.0, 3.0, 4.5)),
    )

    def coordinates(self, ops: Ops, forces: Forces) -> tuple[Value, ...]:
        """Throttle [1] and vx [m/s]."""
        return forces.throttle, forces.vx

    def base_curve(self, values: Mapping[str, float], *coordinates: FloatArray) -> FloatArray:
        """Drive force less damping, per mass of the car [m/s2]."""
        throttle, vx = coordinates
        force = values["motor.drive_gain"] * throttle - values["motor.damping"] * vx
        return np.asarray(force / values["vehicle.mass"])

    def on_drive(self, ops: Ops, forces: Forces, values: Parameters) -> None:
        """Add the deviation to the drive force."""
        added = self.deviation(ops, self.coordinates(ops, forces), values)
        forces.drive = forces.drive + forces.mass * added


class _CommandCurve(MeasuredCurve, ActuatorEffect):
    """``c + a(c)`` for a command c, which the base model does not change."""

    def base_curve(self, values: Mapping[str, float], *coordinates: FloatArray) -> FloatArray:
        """The command itself."""
        return np.asarray(coordinates[0])

    def apply(self, ops: Ops, command: Value, values: Parameters) -> Value:
        """Add the deviation to the command."""
        return command + self.deviation(ops, (command,), values)


class ThrottleCurve(_CommandCurve):
    """``u = u_t + a(u_t)``: the throttle at the motor over its command.

    The drive map contains this curve. It has few deviations, so each diagnosis can afford its fit.
    """

    id = "throttle_curve"
    represented_by = (DriveMap.id,)
    in_fits_of_curves = False
    quantity = "throttle at the motor"
    summary = "The throttle at the motor is a measured curve over its command."
    class_statement = "a map of the throttle command: the motor's throttle is a curve over it"
    command = "throttle"
    order = 28
    unit, typical, bound = "1", 0.1, 2.0
    axes = (
        Axis("commanded throttle", "1", (-1.0, -0.6, -0.35, -0.2, -0.1, 0.0, 0.1, 0.2, 0.35, 0.6, 1.0), anchor=0.0),
    )

    def coordinates(self, ops: Ops, forces: Forces) -> tuple[Value, ...]:
        """The throttle [1]."""
        return (forces.throttle,)


class SteeringCurve(_CommandCurve):
    """``d = d_cmd + a(d_cmd)`` with the wheel angle ``d_cmd = max_angle command`` of the base model."""

    id = "steering_curve"
    quantity = "wheel angle"
    summary = "The wheel angle is a measured curve over its command."
    class_statement = "a map of the steering command: the wheel angle is a curve over it"
    command = "steering"
    order = 65
    unit, typical, bound = "rad", 0.03, 0.6
    axes = (Axis("commanded angle", "rad", (-0.5, -0.35, -0.2, -0.1, 0.0, 0.1, 0.2, 0.35, 0.5), anchor=0.0),)

    def coordinates(self, ops: Ops, forces: Forces) -> tuple[Value, ...]:
        """The commanded wheel angle [rad]."""
        return (forces.wheel_angle,)


class _SideForceMap(MeasuredCurve, DynamicsEffect):
    """Side force of one axle per load over longitudinal force and slip angle, odd in the slip angle.

    The longitudinal force F_x is that of the driven axle. On the driven axle it uses up grip (friction ellipse: Pacejka
    2012, ch. 1); on the other axle it changes the load, or the car drives and brakes with all wheels.
    """

    axle: ClassVar[str]
    order = 5
    base_models = ("dynamic", "linear_tyre", "blend")
    unit, typical, bound = "1", 0.1, 3.0

    def slip_rad(self, ops: Ops, forces: Forces) -> Value:
        """Slip angle of the axle's wheels, positive where the force is to the right."""
        raise NotImplementedError

    def coordinates(self, ops: Ops, forces: Forces) -> tuple[Value, ...]:
        """F_x per mass of the car [m/s2], and size of the slip angle [rad]."""
        return self._at(ops, forces, self.slip_rad(ops, forces))

    def _at(self, ops: Ops, forces: Forces, slip_rad: Value) -> tuple[Value, ...]:
        return forces.axle_force / forces.mass, ops.abs(slip_rad)

    def base_curve(self, values: Mapping[str, float], *coordinates: FloatArray) -> FloatArray:
        """Pacejka's curve ``mu sin(C atan(B a))`` [1]."""
        mu, b, c = (values[f"tyre.{self.axle}.{k}"] for k in ("mu", "B", "C"))
        return np.asarray(mu * np.sin(c * np.arctan(b * coordinates[-1])))

    def added(self, ops: Ops, forces: Forces, values: Parameters) -> Value:
        """Deviation of the side force per load [1], positive left."""
        slip = self.slip_rad(ops, forces)
        return -ops.sign(slip) * self.deviation(ops, self._at(ops, forces, slip), values)


_FORCE_NAME, _FORCE_UNIT = "longitudinal force per mass", "m/s2"
_SLIP_AXIS = Axis("slip angle", "rad", (0.0, 0.04, 0.1, 0.2, 0.4, 0.8), anchor=0.0)


def front_slip_rad(ops: Ops, forces: Forces) -> Value:
    """Slip angle of the front wheels (cars,) [rad] in the base model, positive where the tyres push to the right."""
    front = forces.vy + forces.front_axle * forces.yaw_rate
    along = forces.vx * forces.wheel_cos + front * forces.wheel_sin
    across = front * forces.wheel_cos - forces.vx * forces.wheel_sin
    return ops.slope_angle(across, ops.at_least(ops.abs(along), SLIP_FLOOR_MPS))


class FrontTyreMap(_SideForceMap):
    """``F_y,front -= F_z a(F_x / m, |slip|) sign(slip)`` in the front wheels' frame."""

    id = "front_tyre_map"
    axle = "front"
    quantity = "side force of the front axle per load"
    summary = "The front side force is a measured map over longitudinal force and slip angle."
    class_statement = "a map of the front side force over longitudinal force and slip angle"
    axes = (Axis(_FORCE_NAME, _FORCE_UNIT, (-6.0, -3.0, 0.0, 3.0, 6.0)), _SLIP_AXIS)

    def slip_rad(self, ops: Ops, forces: Forces) -> Value:
        """As in the base model."""
        return front_slip_rad(ops, forces)

    def on_tyre(self, ops: Ops, forces: Forces, values: Parameters) -> None:
        """Add the deviation to the side force of the front axle."""
        forces.side_front = forces.side_front + forces.load_front * self.added(ops, forces, values)


class RearTyreMap(_SideForceMap):
    """``F_y,rear -= F_z a(F_x / m, |slip|) sign(slip)``."""

    id = "rear_tyre_map"
    axle = "rear"
    quantity = "side force of the rear axle per load"
    summary = "The rear side force is a measured map over longitudinal force and slip angle."
    class_statement = "a map of the rear side force over longitudinal force and slip angle"
    axes = (Axis(_FORCE_NAME, _FORCE_UNIT, (-8.0, -5.0, -2.5, 0.0, 2.5, 5.0, 8.0)), _SLIP_AXIS)

    def slip_rad(self, ops: Ops, forces: Forces) -> Value:
        """As in the base model."""
        rear = forces.vy - forces.rear_axle * forces.yaw_rate
        return ops.slope_angle(rear, ops.at_least(ops.abs(forces.vx), SLIP_FLOOR_MPS))

    def on_tyre(self, ops: Ops, forces: Forces, values: Parameters) -> None:
        """Add the deviation to the side force of the rear axle."""
        forces.side_rear = forces.side_rear + forces.load_rear * self.added(ops, forces, values)
