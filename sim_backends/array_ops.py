"""Elementary functions for the model's equations, on floats and on NumPy arrays.

The equations are written once, with such a set of functions as an argument: one car on floats (about ten times as fast
as NumPy scalars), or a batch of cars on NumPy arrays or, with ``torch_ops``, on tensors.
"""

from __future__ import annotations

import math
from typing import Any, Protocol, TypeAlias

import numpy as np

Value: TypeAlias = Any
"""A float, a NumPy array or a torch tensor, shape () or (cars,); while equations are traced, a node of their graph."""


class Ops(Protocol):
    """Elementary functions of one array library, element by element: arguments broadcast to the shape of the result.

    Angles are in rad.
    """

    def sin(self, x: Value, /) -> Value: ...  # noqa: D102
    def cos(self, x: Value, /) -> Value: ...  # noqa: D102
    def atan(self, x: Value, /) -> Value: ...  # noqa: D102
    def atan2(self, y: Value, x: Value, /) -> Value: ...  # noqa: D102
    def slope_angle(self, y: Value, x: Value, /) -> Value:
        """``atan2(y, x)`` for positive x, by the fastest function."""

    def tanh(self, x: Value, /) -> Value: ...  # noqa: D102
    def exp(self, x: Value, /) -> Value: ...  # noqa: D102
    def sqrt(self, x: Value, /) -> Value: ...  # noqa: D102
    def hypot(self, x: Value, y: Value, /) -> Value: ...  # noqa: D102
    def pow(self, x: Value, exponent: Value, /) -> Value: ...  # noqa: D102
    def abs(self, x: Value, /) -> Value: ...  # noqa: D102
    def sign(self, x: Value, /) -> Value: ...  # noqa: D102
    def at_least(self, x: Value, low: float, /) -> Value:
        """``max(x, low)`` with a constant."""

    def clip(self, x: Value, low: Value, high: Value, /) -> Value: ...  # noqa: D102
    def where(self, condition: Value, yes: Value, no: Value, /) -> Value: ...  # noqa: D102
    def fma(self, a: Value, b: Value, c: Value, /) -> Value:
        """``a * b + c``."""

    def fms(self, a: Value, b: Value, c: Value, /) -> Value:
        """``c - a * b``."""


class _Products:
    """Products with a sum, by Python's operators."""

    @staticmethod
    def fma(a: Value, b: Value, c: Value) -> Value:
        """``a * b + c``."""
        return a * b + c

    @staticmethod
    def fms(a: Value, b: Value, c: Value) -> Value:
        """``c - a * b``."""
        return c - a * b


class FloatOps(_Products):
    """Python floats and ``math``: one car. All shapes are ()."""

    sin = staticmethod(math.sin)
    cos = staticmethod(math.cos)
    atan = staticmethod(math.atan)
    atan2 = staticmethod(math.atan2)
    tanh = staticmethod(math.tanh)
    exp = staticmethod(math.exp)
    sqrt = staticmethod(math.sqrt)
    hypot = staticmethod(math.hypot)
    pow = staticmethod(math.pow)
    abs = staticmethod(abs)

    @staticmethod
    def slope_angle(y: Value, x: Value) -> Value:
        """``atan2(y, x)`` for positive x."""
        return math.atan(y / x)

    @staticmethod
    def sign(x: Value) -> Value:
        """-1, 0 or 1."""
        return math.copysign(1.0, x) if x else 0.0

    @staticmethod
    def at_least(x: Value, low: float) -> Value:
        """Not below ``low``."""
        return x if x > low else low

    @staticmethod
    def clip(x: Value, low: Value, high: Value) -> Value:
        """Between ``low`` and ``high``."""
        return low if x < low else high if x > high else x

    @staticmethod
    def where(condition: Value, yes: Value, no: Value) -> Value:
        """``yes`` where the condition holds, otherwise ``no``."""
        return yes if condition else no


class NumpyOps(_Products):
    """NumPy arrays: a batch of cars without torch."""

    sin = staticmethod(np.sin)
    cos = staticmethod(np.cos)
    atan = staticmethod(np.arctan)
    atan2 = staticmethod(np.arctan2)
    tanh = staticmethod(np.tanh)
    exp = staticmethod(np.exp)
    sqrt = staticmethod(np.sqrt)
    hypot = staticmethod(np.hypot)
    pow = staticmethod(np.power)
    abs = staticmethod(np.abs)
    sign = staticmethod(np.sign)
    at_least = staticmethod(np.maximum)
    where = staticmethod(np.where)

    @staticmethod
    def slope_angle(y: Value, x: Value) -> Value:
        """``atan2(y, x)`` for positive x."""
        return np.arctan(y / x)

    @staticmethod
    def clip(x: Value, low: Value, high: Value) -> Value:
        """Between ``low`` and ``high``; faster than ``numpy.clip``."""
        return np.minimum(np.maximum(x, low), high)


FLOATS: Ops = FloatOps()
ARRAYS: Ops = NumpyOps()
