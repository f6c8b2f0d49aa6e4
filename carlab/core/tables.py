"""Strict reading of configuration tables into dataclasses; an unknown key is an error that names the nearest key."""

from __future__ import annotations

import dataclasses
import difflib
import math
import types
import typing
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, TypeVar

from carlab.core.errors import ConfigError

T = TypeVar("T")
MAX_LISTED_NAMES, N_NEAREST_NAMES = 60, 5
"""A message lists all known names up to the first number (more than the effects of the catalogue), else the nearest."""


def check_keys(table: Mapping[str, Any], known: Iterable[str], where: str) -> None:
    """Raise ConfigError for the first key of ``table`` that is not in ``known``."""
    names = sorted(known)
    for key in table:
        if key not in names:
            raise ConfigError(f"Unknown key '{key}' in {where}; {nearest_name(key, names, 'known keys:')}")


def nearest_name(name: str, known: Sequence[str], otherwise: str = "choose among") -> str:
    """End of a message about an unknown name: the nearest known name, or ``otherwise`` and all of them.

    Of more than ``MAX_LISTED_NAMES`` names, only the nearest ones are listed.
    """
    near = difflib.get_close_matches(name, known, n=1, cutoff=0.5)
    if near:
        return f"did you mean '{near[0]}'?"
    if len(known) <= MAX_LISTED_NAMES:
        return f"{otherwise} {', '.join(known)}."
    nearest = difflib.get_close_matches(name, known, n=N_NEAREST_NAMES, cutoff=0.0)
    return f"the nearest of {len(known)} names are {', '.join(nearest)}."


def from_table(cls: type[T], table: Mapping[str, Any], where: str) -> T:
    """Build dataclass ``cls`` from a TOML table. Nested dataclasses take nested tables; lists become tuples.

    ``where`` names the table in messages, for example ``[mocap] of car.toml``. Raises ConfigError for an unknown
    key, a missing one, a value of the wrong type or NaN, and what ``cls`` refuses.
    """
    if not isinstance(table, Mapping):
        raise ConfigError(f"{where} must be a table, not {table!r}.")
    fields = {f.name: f for f in dataclasses.fields(cls) if f.init}  # type: ignore[arg-type]
    check_keys(table, fields, where)
    hints = typing.get_type_hints(cls)
    values = {}
    for name, f in fields.items():
        if name in table:
            values[name] = _convert(hints[name], table[name], f"'{name}' in {where}")
        elif f.default is dataclasses.MISSING and f.default_factory is dataclasses.MISSING:
            raise ConfigError(f"'{name}' is missing in {where}; add it.")
    try:
        return cls(**values)
    except ConfigError as error:
        raise ConfigError(f"{where}: {error}") from error


def number(value: Any, where: str) -> float:
    """Return ``value`` as a float, which may be NaN or infinite.

    Raises ConfigError if it is no number or too large for a float.
    """
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise ConfigError(f"{where} must be a number, not {value!r}.")
    try:
        return float(value)
    except OverflowError as error:
        raise ConfigError(f"{where} is too large; give a number below 1e308.") from error


def _convert(hint: Any, value: Any, where: str) -> Any:
    origin = typing.get_origin(hint)
    if origin in (typing.Union, types.UnionType):
        options = [h for h in typing.get_args(hint) if h is not type(None)]
        return None if value is None else _convert(options[0], value, where)
    if origin is typing.Literal:
        return _choice(typing.get_args(hint), value, where)
    if origin is tuple:
        return _tuple(typing.get_args(hint), value, where)
    if origin in (dict, Mapping) or hint in (dict, Mapping):
        if not isinstance(value, Mapping):
            raise ConfigError(f"{where} must be a table, not {value!r}.")
        return dict(value)
    if dataclasses.is_dataclass(hint):
        return from_table(typing.cast(type, hint), value, where)
    return _plain(hint, value, where)


def _choice(choices: tuple[Any, ...], value: Any, where: str) -> Any:
    if not isinstance(value, (str, int, float)) or value not in choices:
        raise ConfigError(f"{where} is {value!r}; it must be one of {', '.join(map(repr, choices))}.")
    return value


def _tuple(items: tuple[Any, ...], value: Any, where: str) -> tuple[Any, ...]:
    if not isinstance(value, (list, tuple)):
        raise ConfigError(f"{where} must be a list, not {value!r}.")
    if len(items) == 2 and items[1] is Ellipsis:
        return tuple(_convert(items[0], v, where) for v in value)
    if len(value) != len(items):
        raise ConfigError(f"{where} must have {len(items)} entries, not {len(value)}.")
    return tuple(_convert(h, v, where) for h, v in zip(items, value, strict=True))


def _plain(hint: Any, value: Any, where: str) -> Any:
    if hint is float:
        value = number(value, where)
        if math.isnan(value):
            raise ConfigError(f"{where} is NaN; give a number.")
    elif hint is int and (isinstance(value, bool) or not isinstance(value, int)):
        raise ConfigError(f"{where} must be a whole number, not {value!r}.")
    elif hint in (str, bool) and not isinstance(value, hint):
        raise ConfigError(f"{where} must be {'text' if hint is str else 'true or false'}, not {value!r}.")
    return value
