"""Delays and lags of each command, and the delays of both commands that resemble them.

An effect that delays both commands names its groups (``Effect.split_into``): the delays and lags of each command.
"""

from __future__ import annotations

from carlab.diagnosis.selection.problem import Model
from sim_backends.effects import EFFECTS


def lag_s(model: Model, name: str) -> float:
    """Delay or time constant of an accepted effect [s], relative to the car file."""
    parameter = f"effects.{name}.{EFFECTS[name].lag_parameter}"
    return next(
        float(f.value(z)) - f.origin for f, z in zip(model.fit.free, model.fit.z, strict=True) if f.name == parameter
    )


def group_lags_s(model: Model, name: str) -> list[float]:
    """Sum of the effect's own delay and of the delays and lags of each group [s], relative to the car file."""
    return [sum(lag_s(model, e) for e in (name, *group) if e in model.effects) for group in EFFECTS[name].split_into]


def effect_of_each_command(model: Model, name: str) -> tuple[str, ...]:
    """The accepted delay or lag of each group of ``name``, the shorter one first.

    Empty if a group has none or several, or if an accepted effect already delays both commands.
    """
    old = [[e for e in group if e in model.effects] for group in EFFECTS[name].split_into]
    if any(len(each) != 1 for each in old) or any(EFFECTS[e].split_into for e in model.effects):
        return ()
    return tuple(sorted((each[0] for each in old), key=lambda e: lag_s(model, e)))


def confusable_shared_delays(model: Model) -> list[tuple[str, str]]:
    """Pairs of an accepted delay or lag of one command and a delay of both commands that may replace it.

    A delay of both commands replaces the shorter of two delays or lags; the longer one becomes shorter by it.
    """
    shared = (name for name, effect in EFFECTS.items() if effect.split_into)
    return [(found[0], name) for name in shared if (found := effect_of_each_command(model, name))]
