"""Checks of arguments; messages name the command-line option, which has the same name as the argument."""

from __future__ import annotations

from carlab.core.errors import ConfigError


def above_zero(**values: float | None) -> None:
    """Raise ConfigError for an argument that is not a finite number above zero; None is valid."""
    for name, value in values.items():
        if value is not None and not 0.0 < value < float("inf"):
            raise ConfigError(f"--{name.replace('_', '-')} {value:g}: give a number above zero.")


def at_least(minimum: int, **values: int | None) -> None:
    """Raise ConfigError for an argument below ``minimum``; None is valid."""
    for name, value in values.items():
        if value is not None and value < minimum:
            raise ConfigError(f"--{name.replace('_', '-')} {value}: give at least {minimum}.")
