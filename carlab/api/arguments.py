"""Checks of arguments; messages name the option of the command line, which has the same name."""

from __future__ import annotations

from carlab.core.errors import ConfigError


def above_zero(**values: float | None) -> None:
    """Raise ConfigError for an argument that is not a finite number above zero; None passes."""
    for name, value in values.items():
        if value is not None and not 0.0 < value < float("inf"):
            raise ConfigError(f"--{name.replace('_', '-')} {value:g}: a number above zero.")


def at_least(minimum: int, **values: int | None) -> None:
    """Raise ConfigError for an argument below ``minimum``; None passes."""
    for name, value in values.items():
        if value is not None and value < minimum:
            raise ConfigError(f"--{name.replace('_', '-')} {value}: at least {minimum}.")
