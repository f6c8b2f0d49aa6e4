"""Present names of learning methods; saved runs, scripts and command lines may have the former ones."""

from __future__ import annotations

from collections.abc import Sequence

FORMER_METHODS = {"sim-fsvgd-mended": "sim-fsvgd-corrected", "fsvgd-mended": "fsvgd-corrected"}
"""Present name of each renamed method."""
METHOD_OPTIONS = ("--method", "--methods")


def current_method(name: str) -> str:
    """The present name of a method."""
    return FORMER_METHODS.get(name, name)


def with_current_methods(arguments: Sequence[str]) -> list[str]:
    """A command line with the present names of the methods that ``--method`` and ``--methods`` list."""
    option, current = "", []
    for argument in arguments:
        if not argument.startswith("--"):
            current.append(current_method(argument) if option in METHOD_OPTIONS else argument)
            continue
        option, equals, value = argument.partition("=")
        is_method = option in METHOD_OPTIONS
        current.append(f"{option}{equals}{current_method(value)}" if is_method else argument)
    return current
