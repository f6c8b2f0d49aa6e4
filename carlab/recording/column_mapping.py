"""What the columns of a foreign table mean: declared in TOML, or known from the header of a CSV.

A mapping declares; the audit (``carlab.recording.audit``) detects. Only what is declared is converted.
"""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from carlab.core.errors import ConfigError
from carlab.core.quantities import FloatArray
from carlab.core.tables import check_keys, from_table
from carlab.core.toml_files import read_toml

CHANNELS = ("t", "x", "y", "yaw", "vx", "vy", "yaw_rate", "steering", "throttle")
POSE_CHANNELS = ("x", "y", "yaw")
VELOCITY_CHANNELS = ("vx", "vy", "yaw_rate")
COMMAND_CHANNELS = ("steering", "throttle")

_TIME = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
_LENGTH = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}
_ANGLE = {"rad": 1.0, "deg": 3.141592653589793 / 180.0}
_SPEED = {"m/s": 1.0, "cm/s": 1e-2, "mm/s": 1e-3, "km/h": 1.0 / 3.6}
_RATE = {"rad/s": 1.0, "deg/s": 3.141592653589793 / 180.0}
_SHARE = {"1": 1.0, "%": 1e-2}
UNITS: Mapping[str, Mapping[str, float]] = {
    "t": _TIME,
    "x": _LENGTH,
    "y": _LENGTH,
    "yaw": _ANGLE,
    "vx": _SPEED,
    "vy": _SPEED,
    "yaw_rate": _RATE,
    "steering": _SHARE,
    "throttle": _SHARE,
}
"""Factor to the SI unit of each unit that a channel may come in; the first of each is the SI unit."""
MIN_PERIOD_S = 1e-5
"""[s] No sensor of a car samples faster than 100 kHz. Stamps that are closer have another unit (hours, days)."""
MAX_LAG_S = 1.0
"""[s] A declared lag of velocities or commands is at most this long; longer ones are in milliseconds. The slowest known
logger lags 0.1 s behind."""
MAX_LAG_SHARE = 0.1
"""Share of a recording. A shift by a longer lag replaces more commands than this by the first or last one."""


@dataclass(frozen=True, slots=True)
class ColumnSource:
    """Where one channel comes from: value = sign * scale * (factor of ``unit``) * (column - ``neutral``)."""

    name: str
    """Column name in the file's header. In a ROS bag: topic and field, as in ``/drive/drive/steering_angle``."""
    unit: str | None = None
    """Unit in the file; left out, the SI unit is taken and the audit refuses what plainly is not SI."""
    sign: Literal[1, -1] = 1
    """-1 where the file counts the other way (yaw clockwise, steering positive to the right)."""
    scale: float = 1.0
    """Any further factor, for example 0.04 for steering in [-25, 25]."""
    neutral: float = 0.0
    """Value in the column at the command 0, for example 1500 for pulse widths in microseconds."""

    def values(self, channel: str, column: FloatArray) -> FloatArray:
        """The channel in SI units (N,) from its column (N,)."""
        return (column - self.neutral) * self.factor(channel)

    def factor(self, channel: str) -> float:
        """Factor from the column to the channel's SI unit. Raises ConfigError for an unknown unit or a scale of 0."""
        units = UNITS[channel]
        if not (math.isfinite(self.scale) and self.scale != 0.0):
            raise ConfigError(f"The scale of {channel} is {self.scale:g}; give a finite number other than 0.")
        if self.unit is None:
            return self.sign * self.scale
        if self.unit not in units:
            raise ConfigError(f"Unit '{self.unit}' of {channel} is not known; use one of {', '.join(units)}.")
        return self.sign * self.scale * units[self.unit]


@dataclass(frozen=True, slots=True)
class ColumnMapping:
    """How the columns of a CSV or a ROS bag become an episode.

    ``columns`` names the source of each channel in ``CHANNELS``.

    Raises:
        ConfigError: an unknown channel or unit, a scale, rate or lag that is out of range, one column for two
            channels, a reference that is no channel, or ``swap_xy`` without a pose.
    """

    columns: Mapping[str, ColumnSource]
    layout: str = "custom"
    """Name of the layout, for messages and metadata."""
    velocity_frame: Literal["body", "world"] = "body"
    """Frame of the vx, vy columns."""
    velocity_lag_s: float = 0.0
    """Known delay of the velocity columns behind the pose [s]; world velocities are rotated by the yaw of that
    moment."""
    velocities: Literal["columns", "pose"] = "columns"
    """Take velocities from their ``columns``, or estimate them from the ``pose``, centred, without delay; their columns
    stay extra columns."""
    swap_xy: bool = False
    """Exchange x and y (and vx and vy in the world frame)."""
    yaw_offset_rad: float = 0.0
    """Added to yaw [rad] after unit and sign."""
    repair_yaw_rate: bool = False
    """Replace spikes of a wrapped-angle difference in the yaw rate by the yaw rate of the pose."""
    throttle_gate: str | None = None
    """Column that multiplied the throttle on the car: ``requested`` keeps the column, ``sent`` is the product."""
    references: Mapping[str, str] = field(default_factory=dict)
    """Further sensor columns that measure vx, vy or yaw_rate again, for example ``{"vel encoder" = "vx"}``; they are
    only compared with it."""
    dead_reckoning: bool = False
    """There is no pose: integrate vx and yaw_rate from the origin, with vy = 0."""
    clock: Literal["column", "velocity", "even"] = "column"
    """``column``: times of the time column. ``velocity``: each period from distance over speed, for a time column that
    was constructed afterwards. ``even``: equal periods, for frames of constant rate with times of arrival."""
    command_lag_s: float = 0.0
    """Known delay of the command columns behind the moment at which the commands were sent [s]."""
    rate_hz: float | None = None
    """Row rate [Hz] of a file without a time column."""
    missing: Literal["error", "drop", "hold"] = "error"
    """Rows with a missing value: ``error``, ``drop`` them (the command before is then held across them), or ``hold``
    the newest value of each other column in the rows with a pose, for tables of several topics."""
    gaps: Literal["error", "split", "keep"] = "error"
    """Gaps in time: ``error``, ``split`` into episodes there and where the pose jumps, or ``keep`` one episode."""
    stamps: Literal["error", "drop"] = "error"
    """Time stamps that do not increase: ``error``, or ``drop`` those rows."""
    message_times: Literal["auto", "header", "received"] = "auto"
    """Times of the messages of a ROS bag: of their ``header``, or at which the recorder ``received`` them. ``auto``: of
    the header, except for topics without a header or whose headers have another clock, as in a simulation."""

    def __post_init__(self) -> None:
        check_keys(self.columns, CHANNELS, f"the columns of mapping '{self.layout}'")
        max_rate_hz = 1.0 / MIN_PERIOD_S
        if self.rate_hz is not None and not 0.0 < self.rate_hz <= max_rate_hz:
            raise ConfigError(
                f"The rate of the rows is {self.rate_hz:g} Hz; give a number above zero, at most {max_rate_hz:g}."
            )
        if self.rate_hz is not None and self.missing == "hold":
            raise ConfigError("Held values need times, so a file without a time column cannot have missing = hold.")
        self._check_dead_reckoning()
        _check_lag("velocity_lag", self.velocity_lag_s)
        _check_lag("command_lag", self.command_lag_s)
        for channel, source in self.columns.items():
            source.factor(channel)
            if source.neutral != 0.0 and channel not in COMMAND_CHANNELS:
                raise ConfigError(f"{channel} has no neutral value; only steering and throttle have one.")
        self._check_distinct_columns()
        for name, channel in self.references.items():
            if not isinstance(channel, str):
                raise ConfigError(
                    f"The reference '{name}' of mapping '{self.layout}' is {channel!r}; name the channel that the "
                    'column measures, for example "vx".'
                )
        references = dict.fromkeys(self.references.values())
        check_keys(references, VELOCITY_CHANNELS, f"the references of mapping '{self.layout}'")

    def _check_dead_reckoning(self) -> None:
        """Raise ConfigError if an option that needs a pose is set without one."""
        needs_pose = ("swap_xy", "yaw_offset_rad", "velocity_frame", "velocity_lag_s", "velocities", "repair_yaw_rate")
        defaults = {f.name: f.default for f in dataclasses.fields(self)}
        for option in needs_pose if self.dead_reckoning else ():
            if getattr(self, option) != defaults[option]:
                raise ConfigError(f"Mapping '{self.layout}' has no pose, so {option} has no effect; remove {option}.")

    def velocity_columns(self, channels: Container[str]) -> tuple[str, ...]:
        """Velocity channels of the state that are columns, of a file with columns for ``channels``.

        vx and vy are taken together or not at all; dead reckoning needs vx only.
        """
        if self.dead_reckoning:
            return "vx", "yaw_rate"
        if self.velocities == "pose":
            return ()
        planar = ("vx", "vy") if "vx" in channels and "vy" in channels else ()
        return (*planar, "yaw_rate") if "yaw_rate" in channels else planar

    def _check_distinct_columns(self) -> None:
        """Raise ConfigError if two channels, or a channel and the throttle gate, have the same column."""
        channels: dict[str, str] = {}
        for channel, source in self.columns.items():
            if source.name in channels:
                raise ConfigError(
                    f"Mapping '{self.layout}' takes {channels[source.name]} and {channel} from the same column "
                    f"'{source.name}'; correct one of them."
                )
            channels[source.name] = channel
        if self.throttle_gate in channels:
            raise ConfigError(
                f"Mapping '{self.layout}' takes {channels[self.throttle_gate]} and throttle_gate from the same column "
                f"'{self.throttle_gate}'; correct one of them."
            )

    def with_options(self, *, columns: Mapping[str, Mapping[str, Any]] | None = None, **options: Any) -> ColumnMapping:
        """Return a copy with other options; ``columns={"steering": {"sign": -1}}`` changes parts of a source.

        Raises ConfigError for a channel, an option or a unit that does not exist.
        """
        known = [f.name for f in dataclasses.fields(self) if f.name != "columns"]
        check_keys(options, known, "the mapping's options")
        checked = from_table(ColumnMapping, {"columns": {}, **options}, "the mapping's options")
        sources = dict(self.columns)
        for channel, changes in (columns or {}).items():
            check_keys({channel: None}, CHANNELS, "the mapping's columns")
            source = dataclasses.asdict(sources.get(channel, ColumnSource(channel)))
            sources[channel] = from_table(ColumnSource, {**source, **changes}, f"the changes to {channel}")
        return dataclasses.replace(self, columns=sources, **{name: getattr(checked, name) for name in options})

    def combined(self, option: str) -> str:
        """An option of ``carlab import`` that corrects a recording in addition to this mapping.

        An option replaces a declared sign, scale, unit or swap, so it has to contain the declared one.
        """
        if option == "--swap-xy" and self.swap_xy:
            return "--no-swap-xy"
        return _PART_OPTION.sub(self._combined_part, option)

    def _combined_part(self, match: re.Match[str]) -> str:
        flag, part, value = match.groups()
        channel = flag.replace("-", "_")
        source = self.columns.get(channel, ColumnSource(channel))
        if part == "sign":
            return f"--{flag}-sign {source.sign * int(value)}"
        if part == "unit":
            if source.unit is None or UNITS[channel][source.unit] == 1.0 or channel not in VELOCITY_CHANNELS:
                return match[0]  # A pose has no option for its scale.
            value = str(UNITS[channel][value])
        elif source.scale == 1.0:
            return match[0]
        return f"--{flag}-scale {source.scale * float(value):.4g}"


_PART_OPTION = re.compile(r"--([a-z-]+)-(sign|scale|unit) (\S+)")
"""Option that changes a part of a ``ColumnSource``."""


def _check_lag(option: str, lag_s: float) -> None:
    """Raise ConfigError for a lag [s] that no logger has."""
    if not abs(lag_s) <= MAX_LAG_S:
        raise ConfigError(
            f"{option} is {lag_s:g} s, but a lag is at most {MAX_LAG_S:g} s; give it in seconds, for "
            "example 0.05 for 50 ms."
        )


def load_mapping(path: Path | str) -> ColumnMapping:
    """Read a mapping from TOML: options of ColumnMapping at the top, one table ``[columns.CHANNEL]`` a channel.

    Raises ConfigError for a file that is not TOML, an unknown key or an unknown unit.
    """
    path = Path(path)
    _, table = read_toml(path, "a mapping")
    columns = table.pop("columns", None)
    if not isinstance(columns, dict) or not columns:
        raise ConfigError(f'{path} names no columns; add tables such as [columns.x] with name = "pos_x".')
    check_keys(columns, CHANNELS, f"[columns] of {path}")
    sources = {
        channel: from_table(
            ColumnSource, {"name": entry} if isinstance(entry, str) else entry, f"[columns.{channel}] of {path}"
        )
        for channel, entry in columns.items()
    }
    return dataclasses.replace(from_table(ColumnMapping, {"columns": {}, **table}, str(path)), columns=sources)


def missing_columns(mapping: ColumnMapping, header: Sequence[str]) -> list[str]:
    """Columns that ``mapping`` needs and ``header`` lacks, as texts ``channel 'column'``."""
    needed = ["t", *COMMAND_CHANNELS]
    needed += ["vx", "yaw_rate"] if mapping.dead_reckoning else list(POSE_CHANNELS)
    if mapping.rate_hz is not None:
        needed.remove("t")
    lacking = []
    for channel in needed:
        source = mapping.columns.get(channel)
        if source is None:
            lacking.append(f"{channel} (not mapped)")
        elif source.name not in header:
            lacking.append(source.name if source.name == channel else f"{source.name} (for {channel})")
    named = [mapping.throttle_gate] if mapping.throttle_gate else []
    return lacking + [name for name in named if name not in header]


def conversions(mapping: ColumnMapping) -> str:
    """The conversions that a mapping declares, as a list in words."""
    texts = []
    for channel, source in mapping.columns.items():
        factor = source.factor(channel)
        if factor != 1.0 or source.neutral or source.name != channel:
            column = f"'{source.name}'" if not source.neutral else f"('{source.name}' - {source.neutral:g})"
            texts.append(f"{channel} from {column}" + ("" if factor == 1.0 else f" times {factor:.6g}"))
    if mapping.velocity_frame == "world":
        texts.append("velocities rotated from the world into the body frame")
    if mapping.swap_xy:
        texts.append("x and y swapped")
    if mapping.yaw_offset_rad:
        texts.append(f"yaw plus {mapping.yaw_offset_rad:.4f} rad")
    if mapping.repair_yaw_rate:
        texts.append("wrap spikes of yaw_rate repaired from the pose")
    if mapping.throttle_gate:
        texts.append(f"throttle sent = throttle times '{mapping.throttle_gate}'")
    if mapping.command_lag_s:
        texts.append(f"commands shifted {mapping.command_lag_s * 1e3:.0f} ms earlier")
    if mapping.clock == "even":
        texts.append("stamps of an even clock in place of the recorded ones")
    if mapping.dead_reckoning:
        texts.append("pose integrated from speed and turn rate")
    return ", ".join(texts) if texts else "nothing needed conversion"
