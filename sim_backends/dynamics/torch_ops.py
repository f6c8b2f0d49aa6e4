"""The elementary functions on torch tensors. Importing this module imports torch."""

from __future__ import annotations

from typing import Any, cast

import torch

from sim_backends.array_ops import Ops, Value


class TorchOps:
    """Tensors of one dtype on one device, element by element; every function is differentiable."""

    sin = staticmethod(torch.sin)
    cos = staticmethod(torch.cos)
    tanh = staticmethod(torch.tanh)
    sqrt = staticmethod(torch.sqrt)
    hypot = staticmethod(torch.hypot)
    pow = staticmethod(torch.pow)
    abs = staticmethod(torch.abs)
    sign = staticmethod(torch.sign)
    exp = staticmethod(torch.exp)
    atan2 = staticmethod(torch.atan2)
    slope_angle = staticmethod(torch.atan2)
    at_least = staticmethod(torch.clamp_min)
    clip = staticmethod(torch.clip)
    where = staticmethod(torch.where)

    def __init__(self, like: torch.Tensor) -> None:
        self._ones = torch.ones_like(like)

    def atan(self, x: Value) -> Value:
        """Arc tangent. ``torch.atan`` takes about twice as long as ``torch.atan2`` on CPUs (2.13, float32)."""
        return torch.atan2(x, self._ones)

    @staticmethod
    def fma(a: Value, b: Value, c: Value) -> Value:
        """``a * b + c`` in one pass."""
        return torch.addcmul(c, a, b) if isinstance(a, torch.Tensor) else torch.add(c, b, alpha=a)

    @staticmethod
    def fms(a: Value, b: Value, c: Value) -> Value:
        """``c - a * b`` in one pass."""
        return torch.addcmul(c, a, b, value=-1.0) if isinstance(a, torch.Tensor) else torch.sub(c, b, alpha=a)


def torch_ops(like: torch.Tensor) -> Ops:
    """Functions for tensors of the shape, dtype and device of ``like``."""
    ops: Any = TorchOps(like)
    return cast(Ops, ops)
