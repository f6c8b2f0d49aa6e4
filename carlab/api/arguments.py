"""Checks of arguments; messages name the command-line option, which has the same name as the argument."""

from __future__ import annotations

import math
import numbers
from typing import Any

from carlab.core.errors import ConfigError
from carlab.core.seeds import MAX_SEED


def above_zero(**values: Any) -> None:
    """Raise ConfigError for an argument that is not a finite number above zero; None is valid."""
    for name, value in values.items():
        is_number = isinstance(value, numbers.Real)
        if value is not None and not (is_number and 0.0 < float(value) < math.inf):
            text = f"{float(value):g}" if is_number else repr(value)
            raise ConfigError(f"--{name.replace('_', '-')} {text}: give a number above zero.")


def whole_number(**values: Any) -> None:
    """Raise ConfigError for an argument that is no integer; None is valid."""
    for name, value in values.items():
        if value is not None and not isinstance(value, numbers.Integral):
            raise ConfigError(f"--{name.replace('_', '-')} {value!r}: give a whole number.")


def at_least(minimum: int, **values: Any) -> None:
    """Raise ConfigError for an argument that is no integer or below ``minimum``; None is valid."""
    whole_number(**values)
    for name, value in values.items():
        if value is not None and value < minimum:
            raise ConfigError(f"--{name.replace('_', '-')} {value}: give at least {minimum}.")


def valid_seed(**values: Any) -> None:
    """Raise ConfigError for a seed that is no integer from 0 to ``MAX_SEED``; None is valid."""
    at_least(0, **values)
    at_most(MAX_SEED, **values)


def at_most(maximum: int, **values: Any) -> None:
    """Raise ConfigError for an argument that is above ``maximum``; None is valid."""
    for name, value in values.items():
        if value is not None and value > maximum:
            raise ConfigError(f"--{name.replace('_', '-')} {value}: give at most {maximum}.")
