"""Assignment of the names of a report to concealed effects."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Literal, TypeVar

import numpy as np
from scipy.optimize import linear_sum_assignment

Effect = TypeVar("Effect")
Name = TypeVar("Name")
Correctness = Literal["exact", "in set", "wrong"]
WEIGHTS: dict[Correctness, float] = {"exact": 1.1, "in set": 1.0, "wrong": 0.0}


def assigned(
    concealed: Sequence[Effect], named: Sequence[Name], correctness: Callable[[Name, Effect], Correctness]
) -> tuple[list[bool], list[bool]]:
    """Assign each name to at most one concealed effect for which it is correct, as many as possible.

    One name states one effect, so a set that contains two concealed effects finds only one of them.

    Returns:
        Whether each concealed effect has a name, and whether each name has a concealed effect.
    """
    weights = np.zeros((len(concealed), len(named)))
    for k, effect in enumerate(concealed):
        weights[k] = [WEIGHTS[correctness(name, effect)] for name in named]
    rows, columns = linear_sum_assignment(weights, maximize=True)
    pairs = [(k, j) for k, j in zip(rows.tolist(), columns.tolist(), strict=True) if weights[k, j] > 0.0]
    found, right = {k for k, _ in pairs}, {j for _, j in pairs}
    return [k in found for k in range(len(concealed))], [j in right for j in range(len(named))]
