"""Optimisers of PyTorch without its compiler, which takes two seconds to load.

``torch.optim.Optimizer`` loads ``torch._dynamo`` to hide its methods from ``torch.compile``, which carlab does not use.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

from torch.optim import Optimizer

_ATTRIBUTE = "__dynamo_disable"
"""Attribute in which ``torch._disable_dynamo`` keeps the hidden form of a method."""


@contextlib.contextmanager
def uncompiled_optimisers() -> Iterator[None]:
    """While the context is open, making an optimiser does not load ``torch._dynamo``.

    With a version of torch that keeps the hidden form elsewhere the context has no effect.
    """
    method = getattr(Optimizer.add_param_group, "__wrapped__", None)
    if method is None or hasattr(method, _ATTRIBUTE):
        yield
        return
    setattr(method, _ATTRIBUTE, method)
    try:
        yield
    finally:
        delattr(method, _ATTRIBUTE)
