"""Inverse of an observation effect by Newton's method, for effects without a closed form."""

from __future__ import annotations

from collections.abc import Callable

from sim_backends.array_ops import Ops, Value

_DIFFERENCE = 1e-4
"""Step of the difference quotients [m, rad, m/s, rad/s]: each iteration shrinks the error by about this factor."""
_ITERATIONS = 6
_MIN_PIVOT = 1e-9


def newton_inverse(
    ops: Ops, observe: Callable[[tuple[Value, ...]], tuple[Value, ...]], measured: tuple[Value, ...]
) -> tuple[Value, ...]:
    """The state that ``observe`` maps to ``measured``, by Newton's method with difference quotients.

    States are x, y [m], yaw [rad], vx, vy [m/s], yaw rate [rad/s], each () or (cars,). The search starts at
    ``measured`` and is done for each car by itself.
    """
    state = measured
    for _ in range(_ITERATIONS):
        seen = observe(state)
        columns = []
        for k in range(len(state)):
            moved = observe((*state[:k], state[k] + _DIFFERENCE, *state[k + 1 :]))
            columns.append([(b - a) * (1.0 / _DIFFERENCE) for a, b in zip(seen, moved, strict=True)])
        rows = [
            [*(column[i] for column in columns), wanted - found]
            for i, (wanted, found) in enumerate(zip(measured, seen, strict=True))
        ]
        state = tuple(s + d for s, d in zip(state, _solved(ops, rows), strict=True))
    return state


def _solved(ops: Ops, rows: list[list[Value]]) -> list[Value]:
    """Solution of linear equations (n rows of n + 1) by elimination with partial pivoting, element by element."""
    count = len(rows)
    for k in range(count):
        for i in range(k + 1, count):
            larger = abs(rows[i][k]) > abs(rows[k][k])
            pairs = list(zip(rows[k], rows[i], strict=True))
            rows[k] = [ops.where(larger, b, a) for a, b in pairs]
            rows[i] = [ops.where(larger, a, b) for a, b in pairs]
        pivot = rows[k][k]
        pivot = ops.where(abs(pivot) > _MIN_PIVOT, pivot, 0.0 * pivot + _MIN_PIVOT)
        rows[k] = [value / pivot for value in rows[k]]
        for i in range(count):
            if i != k:
                rows[i] = [a - rows[i][k] * b for a, b in zip(rows[i], rows[k], strict=True)]
    return [row[count] for row in rows]
