"""Functions of rows of NumPy arrays with SIMD instructions on every processor.

NumPy has no SIMD code for ``hypot``, and for ``arctan`` and ``arctan2`` only with AVX-512. Torch has it for all three
with AVX2, and computes on the memory of the arrays. NumPy remains faster for short rows, because a call of torch costs
a few microseconds.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from numpy.lib import introspect
from numpy.typing import NDArray

from sim_backends.array_ops import NumpyOps, Ops, Value

Row = NDArray[np.floating[Any]]
OF_TENSORS: dict[str, Callable[..., torch.Tensor]] = {
    "arctan": torch.atan,
    "arctan2": torch.atan2,
    "hypot": torch.hypot,
}
"""The functions of torch by the names in NumPy."""
MIN_LENGTH = {"arctan": 768, "arctan2": 384, "hypot": 1280}
"""Length of a row from which torch is faster: where the times of float32 are equal on one core with AVX2 (torch 2.13,
NumPy 2.4: 9, 10 and 12 microseconds)."""


@functools.cache
def has_simd(function: str, dtype: np.dtype[Any]) -> bool:
    """Whether NumPy has SIMD code of a function of this type for this processor."""
    found = introspect.opt_func_info(func_name=f"^{function}$").get(function, {})
    types = dtype.char * (getattr(np, function).nin + 1)
    target = found.get(types, {}).get("current", "baseline")
    return not str(target).startswith("baseline")


@functools.lru_cache(maxsize=1024)
def faster_in_torch(length: int, dtype: np.dtype[Any]) -> frozenset[str]:
    """Functions that torch computes faster than NumPy, for rows of this length and type."""
    return frozenset(f for f, shortest in MIN_LENGTH.items() if length >= shortest and not has_simd(f, dtype))


def _is_for_torch(function: str, x: Value) -> bool:
    """Whether torch computes the function of ``x`` faster than NumPy, and can read its memory."""
    if not isinstance(x, np.ndarray) or x.ndim != 1 or function not in faster_in_torch(len(x), x.dtype):
        return False
    return x.flags.c_contiguous and x.flags.writeable


def _unary(function: str) -> Callable[..., Value]:
    of_array, of_tensor = getattr(np, function), OF_TENSORS[function]

    def call(x: Value, out: Row | None = None) -> Value:
        if not _is_for_torch(function, x):
            return of_array(x, out)
        if out is None:
            return of_tensor(torch.from_numpy(x)).numpy()
        of_tensor(torch.from_numpy(x), out=torch.from_numpy(out))
        return out

    return call


def _binary(function: str) -> Callable[..., Value]:
    of_arrays, of_tensors = getattr(np, function), OF_TENSORS[function]

    def call(a: Value, b: Value, out: Row | None = None) -> Value:
        if not (_is_for_torch(function, a) and _is_for_torch(function, b)):
            return of_arrays(a, b, out)
        if out is None:
            return of_tensors(torch.from_numpy(a), torch.from_numpy(b)).numpy()
        of_tensors(torch.from_numpy(a), torch.from_numpy(b), out=torch.from_numpy(out))
        return out

    return call


arctan = _unary("arctan")
"""``numpy.arctan``."""
arctan2 = _binary("arctan2")
"""``numpy.arctan2``."""
hypot = _binary("hypot")
"""``numpy.hypot``."""
OF_ROWS: dict[str, Callable[..., Value]] = {"arctan": arctan, "arctan2": arctan2, "hypot": hypot}
"""The functions of this module by their names in NumPy."""


class RowOps(NumpyOps):
    """NumPy arrays with the functions of this module: a batch of cars in rows."""

    atan = staticmethod(arctan)
    atan2 = staticmethod(arctan2)
    hypot = staticmethod(hypot)

    @staticmethod
    def slope_angle(y: Value, x: Value) -> Value:
        """``atan2(y, x)`` for positive x."""
        return arctan(y / x)


ROWS: Ops = RowOps()

__all__ = ["OF_ROWS", "OF_TENSORS", "ROWS", "arctan", "arctan2", "faster_in_torch", "has_simd", "hypot"]
