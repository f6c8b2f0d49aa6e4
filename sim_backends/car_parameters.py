"""The parameters of a simulated car, and their car file (TOML)."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from importlib import resources
from pathlib import Path
from typing import Any, Self

from carlab.core.errors import ConfigError
from carlab.core.tables import check_keys, number
from sim_backends.array_ops import FLOATS
from sim_backends.effects import EFFECTS, MeasuredCurve, axle_distances_m, delays_s
from sim_backends.effects.base import MODEL_KINDS, ModelKind
from sim_backends.measurement import LATENCY, MeasurementModel
from sim_backends.registry import REGISTRY, ParameterInfo, section

TABLES = ("vehicle", "tyre", "motor", "steering", "timing", "model", "mocap", "effects")
"""Tables of a car file with the simulator's parameters, without ``[hardware]``."""
_FIELD_OF = {info.name: info.field for info in REGISTRY.values() if info.field}


@dataclass(frozen=True, slots=True)
class CarParameters:
    """Parameters of the single-track model. ``b``, ``c``, ``mu`` are Pacejka's B, C and D/F_z of each axle [1]."""

    mass_kg: float = 1.65
    yaw_inertia_kgm2: float = 0.06
    front_axle_m: float = 0.13
    rear_axle_m: float = 0.17
    front_b: float = 2.75
    front_c: float = 1.45
    front_mu: float = 0.43
    rear_b: float = 5.0
    rear_c: float = 1.3
    rear_mu: float = 0.42
    drive_gain_n: float = 8.2
    damping_nspm: float = 1.56
    max_angle_rad: float = 0.6

    @property
    def wheelbase_m(self) -> float:
        """Distance of the axles [m]."""
        return self.front_axle_m + self.rear_axle_m


@dataclass(frozen=True, slots=True)
class MocapParameters:
    """Parameters of the motion capture of a simulated car. ``dropout`` is the share of lost frames [1]."""

    rate_hz: float = 120.0
    position_std_m: float = 0.0003
    yaw_std_rad: float = 0.002
    latency_s: float = 0.008
    dropout: float = 0.0


@dataclass(frozen=True, slots=True)
class SimulatorConfig:
    """Configuration of a simulator: parameters, timing, kind of model, motion capture, effects, and prior knowledge.

    ``effects`` maps ids of the catalogue to all their parameters in SI units; a choice may be given by its word and is
    stored as its position. ``priors`` maps dotted names to the ranges (low, high) of the car file, ``parameter_std``
    to the standard deviations, as in the model file of a diagnosis. ``unknown`` holds ``mocap.latency`` if the car file
    does not state it; then its value is a default, and a diagnosis estimates it. Construction raises ConfigError for
    invalid values.
    """

    parameters: CarParameters = CarParameters()
    control_period_s: float = 0.0333333333
    command_delay_s: float = 0.08
    kind: ModelKind = "dynamic"
    mocap: MocapParameters = MocapParameters()
    effects: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    priors: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    parameter_std: Mapping[str, float] = field(default_factory=dict)
    unknown: frozenset[str] = field(default=frozenset(), compare=False)

    def __post_init__(self) -> None:
        if self.kind not in MODEL_KINDS:
            raise ConfigError(f"kind is {self.kind!r} in [model]; it must be one of {', '.join(MODEL_KINDS)}.")
        _check_effects(self.effects, "[effects]")
        check_keys(self.priors, REGISTRY, "the priors")
        complete = {}
        for effect_id, given in self.effects.items():
            known = section(f"effects.{effect_id}")
            check_keys(given, known, f"[effects.{effect_id}]")
            complete[effect_id] = {
                name: info.number(given[name]) if name in given else self._default_of(info)
                for name, info in known.items()
            }
        object.__setattr__(self, "effects", complete)
        values = self.values()
        for name, value in values.items():
            if problem := REGISTRY[name].problem(value):
                raise ConfigError(problem)
        for name, (low, high) in self.priors.items():
            if not low <= values[name] <= high:
                raise ConfigError(f"{name} = {values[name]:g} lies outside its range {low:g} to {high:g}.")
        check_keys(self.parameter_std, REGISTRY, "the standard deviations")
        for name, std in self.parameter_std.items():
            if not 0.0 < std < float("inf") or REGISTRY[name].choices:
                raise ConfigError(f"The std of {name} is {std:g}; it must be above zero, and a choice has none.")
        for channel, delay_s in zip(("steering", "throttle"), self.delays_s(), strict=True):
            if delay_s < 0.0:
                raise ConfigError(f"The delay of {channel} adds up to {delay_s:g} s; raise command_delay to 0 or more.")
        self._check_ranges_of_effects(values)

    def _check_ranges_of_effects(self, values: Mapping[str, float]) -> None:
        """Raise ConfigError for a number of an effect that other numbers of the car file exclude."""
        for effect_id in self.effects:
            for parameter, (low, high) in EFFECTS[effect_id].ranges(values).items():
                name = f"effects.{effect_id}.{parameter}"
                if not low <= values[name] <= high:
                    raise ConfigError(
                        f"{name} is {values[name]:g} {REGISTRY[name].unit}; in this car it must be between {low:.3g} "
                        f"and {high:.3g}."
                    )

    def _default_of(self, info: ParameterInfo) -> float:
        if info.default is not None:
            return info.default
        return float(getattr(self._owner(info.same_as), _FIELD_OF[info.same_as]))

    def values(self) -> dict[str, float]:
        """All numbers of this simulator by dotted name: base parameters and those of its effects."""
        found = {name: float(getattr(self._owner(name), attribute)) for name, attribute in _FIELD_OF.items()}
        for effect_id, given in self.effects.items():
            found |= {f"effects.{effect_id}.{name}": value for name, value in given.items()}
        return found

    def _owner(self, name: str) -> Any:
        table = name.partition(".")[0]
        return self if table == "timing" else self.mocap if table == "mocap" else self.parameters

    def with_values(self, changes: Mapping[str, float]) -> Self:
        """Copy with changed numbers by dotted name; an effect with a number is added.

        Raises:
            ConfigError: an unknown name, or an impossible value.
        """
        _check_names(changes)
        grouped: dict[str, dict[str, Any]] = {"parameters": {}, "mocap": {}, "timing": {}}
        effects = {effect_id: dict(given) for effect_id, given in self.effects.items()}
        for name, value in changes.items():
            table, _, rest = name.partition(".")
            if table == "effects":
                effect_id, _, parameter = rest.partition(".")
                effects.setdefault(effect_id, {})[parameter] = float(value)
            else:
                grouped[table if table in grouped else "parameters"][_FIELD_OF[name]] = float(value)
        return replace(
            self,
            parameters=replace(self.parameters, **grouped["parameters"]),
            mocap=replace(self.mocap, **grouped["mocap"]),
            effects=effects,
            unknown=self.unknown - changes.keys(),
            **grouped["timing"],
        )

    def delays_s(self) -> tuple[float, float]:
        """Total delay of steering and of throttle with all effects [s]."""
        return delays_s(self.command_delay_s, self.values(), self.effects)

    def latency_s(self) -> float:
        """Latency of motion capture with all effects [s]."""
        return float(MeasurementModel(FLOATS, self.values(), self.effects).latency_s)

    def axle_distances_m(self) -> tuple[float, float]:
        """Distances of the front and of the rear axle from the centre of mass with all effects [m]."""
        front_m, rear_m = axle_distances_m(FLOATS, self.values(), self.effects)
        return float(front_m), float(rear_m)

    @classmethod
    def from_tables(cls, tables: Mapping[str, Any], where: str = "the car file") -> Self:
        """Read the tables of a car file (``tomllib.load``; without ``[hardware]``). Absent tables mean the defaults.

        A number may be ``{value = 8.2, low = 6.0, high = 10.0, std = 0.5}``, with range, std or both. Raises
        ConfigError for unknown keys, wrong types and impossible values; ``where`` names the file in messages.
        """
        check_keys(tables, TABLES, where)
        values: dict[str, float] = {}
        priors: dict[str, tuple[float, float]] = {}
        parameter_std: dict[str, float] = {}
        model = _table(tables, "model", where)
        check_keys(model, ("kind",), f"[model] of {where}")
        for prefix, table in _sections(tables, where):
            known = section(prefix)
            check_keys(table, known, f"[{prefix}] of {where}")
            for key, entry in table.items():
                if known[key].choices:
                    entry = known[key].number(entry, where)
                values[f"{prefix}.{key}"], prior, std = _number(entry, f"'{key}' in [{prefix}] of {where}")
                if prior is not None:
                    priors[f"{prefix}.{key}"] = prior
                if std is not None:
                    parameter_std[f"{prefix}.{key}"] = std
        effects: dict[str, dict[str, float]] = {name: {} for name in _table(tables, "effects", where)}
        try:
            plain = cls(kind=model.get("kind", "dynamic")).with_values(
                {name: value for name, value in values.items() if not name.startswith("effects.")}
            )
            with_effects = replace(plain, effects=effects).with_values(values) if effects else plain
            stated = {*values, *(p.same_as for name in effects for p in EFFECTS[name].parameters)}
            return replace(
                with_effects, priors=priors, parameter_std=parameter_std, unknown=frozenset({LATENCY}) - stated
            )
        except ConfigError as error:
            raise ConfigError(f"{where}: {error}") from None

    def to_tables(self) -> dict[str, Any]:
        """Tables for TOML, without unknown values; the inverse of ``from_tables``."""
        tables: dict[str, Any] = {}
        for name, value in self.values().items():
            *path, key = name.split(".")
            if name in self.unknown or (path[0] == "effects" and isinstance(EFFECTS[path[1]], MeasuredCurve)):
                continue
            table = tables
            for part in path:
                table = table.setdefault(part, {})
            if name in self.priors or name in self.parameter_std:
                table[key] = {"value": value}
                if name in self.priors:
                    table[key] |= dict(zip(("low", "high"), self.priors[name], strict=True))
                if name in self.parameter_std:
                    table[key]["std"] = self.parameter_std[name]
            elif choices := REGISTRY[name].choices:
                table[key] = choices[int(value)]
            else:
                table[key] = value
        for effect_id in self.effects:
            if isinstance(curve := EFFECTS[effect_id], MeasuredCurve):
                tables.setdefault("effects", {})[effect_id] = self._curve_table(curve)
        tables["model"] = {"kind": self.kind}
        return tables

    def _curve_table(self, curve: MeasuredCurve) -> dict[str, Any]:
        values, own = self.values(), f"effects.{curve.id}."
        table = {"values": curve.table({p.name: values[own + p.name] for p in curve.parameters})}
        if any(name.startswith(own) for name in self.parameter_std):
            table["std"] = curve.table({p.name: self.parameter_std.get(own + p.name, 0.0) for p in curve.parameters})
        return table

    @classmethod
    def from_preset(cls, name: str = "rc_car") -> Self:
        """Create a preset of the package, see ``preset_names``. Raises ConfigError for another name."""
        if name not in preset_names():
            raise ConfigError(f"There is no preset '{name}'; choose one of {', '.join(preset_names())}.")
        text = (resources.files("sim_backends") / "presets" / f"{name}.toml").read_text(encoding="utf-8")
        return cls.from_tables(tomllib.loads(text), f"preset {name}")


def preset_names() -> tuple[str, ...]:
    """Names of the presets of the package."""
    folder = resources.files("sim_backends") / "presets"
    return tuple(sorted(Path(str(f)).stem for f in folder.iterdir() if f.name.endswith(".toml")))


def _table(tables: Mapping[str, Any], name: str, where: str) -> Mapping[str, Any]:
    table = tables.get(name, {})
    if not isinstance(table, Mapping):
        raise ConfigError(f"[{name}] of {where} must be a table, not {table!r}.")
    return table


def _check_effects(effects: Mapping[str, Any], where: str) -> None:
    """Raise ConfigError for the first effect that is not registered in this process."""
    try:
        check_keys(effects, EFFECTS, where)
    except ConfigError as error:
        raise ConfigError(f"{error} Register an effect of your own at the top level of your script.") from None


def _check_names(changes: Mapping[str, Any]) -> None:
    """Raise ConfigError for the first unknown dotted name, with the nearest name of the same table."""
    for name in changes:
        table, _, key = name.rpartition(".")
        if known := section(table):
            check_keys({key: None}, known, f"[{table}]")
        else:
            inside = [other for other in REGISTRY if other.startswith(f"{name}.")]
            check_keys({name: None}, inside or REGISTRY, "the parameters")


def _sections(tables: Mapping[str, Any], where: str) -> Iterator[tuple[str, Mapping[str, Any]]]:
    for name in ("vehicle", "motor", "steering", "timing", "mocap"):
        yield name, _table(tables, name, where)
    tyre = _table(tables, "tyre", where)
    check_keys(tyre, ("front", "rear"), f"[tyre] of {where}")
    for axle in tyre:
        yield f"tyre.{axle}", _table(tyre, axle, f"[tyre] of {where}")
    effects = _table(tables, "effects", where)
    _check_effects(effects, f"[effects] of {where}")
    for effect_id in effects:
        table = _table(effects, effect_id, f"[effects] of {where}")
        effect = EFFECTS[effect_id]
        yield f"effects.{effect_id}", _curve(effect, table, where) if isinstance(effect, MeasuredCurve) else table


def _curve(curve: MeasuredCurve, table: Mapping[str, Any], where: str) -> dict[str, Any]:
    """Entries by number of the table of a measured curve: lists ``values`` and ``std`` over its knots."""
    place = f"[effects.{curve.id}] of {where}"
    check_keys(table, ("values", "std"), place)
    entries: dict[str, Any] = {}
    for key, entry in (("values", "value"), ("std", "std")):
        if key not in table:
            continue
        numbers = curve.numbers_of_table(table[key])
        if numbers is None:
            shape = " lists of ".join(str(len(axis.knots)) for axis in curve.axes)
            raise ConfigError(f"'{key}' in {place} must be a list of {shape} finite numbers, one for each knot.")
        for name, value in numbers.items():
            if key == "values" or value != 0.0:  # a standard deviation of 0 means that it is unknown
                entries.setdefault(name, {"value": 0.0})[entry] = value
    return {name: e if "std" in e else e["value"] for name, e in entries.items()}


def _number(entry: Any, where: str) -> tuple[float, tuple[float, float] | None, float | None]:
    if isinstance(entry, Mapping):
        check_keys(entry, ("value", "low", "high", "std"), where)
        ranged = "low" in entry or "high" in entry or "std" not in entry
        for key in ("value", "low", "high") if ranged else ("value",):
            if key not in entry:
                raise ConfigError(f"'{key}' is missing in {where}; write {{value = 1.0, low = 0.5, high = 2.0}}.")
        given = {key: _number(entry[key], f"'{key}' of {where}")[0] for key in entry}
        if ranged and not given["low"] <= given["value"] <= given["high"]:
            raise ConfigError(
                f"{where}: value {given['value']:g} must lie between low {given['low']:g} and high {given['high']:g}."
            )
        return given["value"], (given["low"], given["high"]) if ranged else None, given.get("std")
    return number(entry, where), None, None
