"""A stand-in for CUDA: tensors that say that they are there, and are refused where real ones would be.

Inside ``stand_in()`` whatever is made on or moved to ``cuda`` is an ``Elsewhere``. It holds ordinary numbers, so that
whole fits run with the values and the branches of the CPU, but it meets no tensor of the CPU in an operation (plain
scalars excepted, as on CUDA), becomes no NumPy array, is drawn by no generator of the CPU and is not written to a file.
An index must be there, too, though CUDA would move it. Crossing copies, so that nothing is seen from both sides. The
operations that were used are kept, and torch's own list says which of them CUDA has.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any, NoReturn

import torch
import torchgen
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode

CUDA = torch.device("cuda", 0)
UNDER = torch.device("meta")
"""What torch's own code takes these tensors to be: a device that needs no driver, and that nothing else here uses."""
CPU = torch.device("cpu")
_aten = torch.ops.aten
_NO_SCALARS = {_aten.cat.default, _aten.stack.default, _aten.index.Tensor}


class Elsewhere(Tensor):
    """A tensor on the stand-in; ``inner`` has its numbers."""

    inner: Tensor
    __torch_function__ = torch._C._disabled_torch_function_impl

    @staticmethod
    def __new__(cls, inner: Tensor) -> Elsewhere:
        return Tensor._make_wrapper_subclass(
            cls, inner.shape, strides=inner.stride(), storage_offset=inner.storage_offset(), dtype=inner.dtype,
            device=UNDER,
        )  # fmt: skip

    def __init__(self, inner: Tensor) -> None:
        self.inner = inner

    @property
    def device(self) -> torch.device:
        return CUDA

    is_cuda, is_cpu, is_meta = (property(lambda self, told=told: told) for told in (True, False, False))

    @property
    def data(self) -> Tensor:
        return Elsewhere(self.inner)

    @data.setter
    def data(self, other: Tensor) -> None:
        assert isinstance(other, Elsewhere), "torch refuses data of another device"
        Tensor.data.__set__(self, other)
        self.inner = other.inner

    def tolist(self) -> Any:
        return self.inner.tolist()

    def numpy(self, *args: Any, **kwargs: Any) -> NoReturn:
        raise TypeError("can't convert cuda:0 device type tensor to numpy. Use Tensor.cpu() first.")

    __array__ = numpy

    def __deepcopy__(self, memo: dict[int, Any]) -> Elsewhere:
        return Elsewhere(self.inner.clone())

    def __reduce_ex__(self, protocol: Any) -> NoReturn:
        raise AssertionError("a tensor that is not on the CPU is being written")

    def __repr__(self, **kwargs: Any) -> str:
        return f"Elsewhere({self.inner})"

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        raise AssertionError("a tensor of the stand-in outlives it")


class _Operations(TorchDispatchMode):
    def __init__(self) -> None:
        super().__init__()
        self.used: set[str] = set()

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = dict(kwargs or {})
        tensors = [*_tensors(args), *_tensors(kwargs.values())]
        ours = any(isinstance(t, Elsewhere) for t in tensors)
        to = kwargs.get("device")
        if not ours and to != UNDER:
            return func(*args, **kwargs)
        self.used.add(func._schema.name.removeprefix("aten::") + f".{func._schema.overload_name}".rstrip("."))
        if func is _aten.copy_.default:
            _inner(args[0]).copy_(_inner(args[1]))
            return args[0]
        if to is not None:
            kwargs["device"] = CPU
        if func is _aten._to_copy.default:
            found = func(*_inner(args), **kwargs)
            return Elsewhere(found) if (to == UNDER if to is not None else ours) else found
        if ours:
            _refuse_mixtures(func, tensors)
        if any(isinstance(v, torch.Generator) for v in (*args, *kwargs.values())):
            raise RuntimeError("Expected a 'cuda' device type for generator but found 'cpu'")
        found = func(*_inner(args), **{name: _inner(value) for name, value in kwargs.items()})
        if ours and func._schema.is_mutable:
            return args[0] if isinstance(found, Tensor) else found
        return found if to == CPU else _outer(found)


def _tensors(values: Iterable[Any]) -> Iterator[Tensor]:
    for value in values:
        if isinstance(value, Tensor):
            yield value
        elif isinstance(value, (list, tuple)):
            yield from _tensors(value)


def _inner(value: Any) -> Any:
    if isinstance(value, (list, tuple)):
        return type(value)(map(_inner, value))
    return value.inner if isinstance(value, Elsewhere) else value


def _outer(value: Any) -> Any:
    if isinstance(value, (list, tuple)):
        return type(value)(map(_outer, value))
    return Elsewhere(value) if isinstance(value, Tensor) else value


def _refuse_mixtures(func: Any, tensors: list[Tensor]) -> None:
    for k, tensor in enumerate(tensors):
        written = k == 0 and func._schema.is_mutable
        if not isinstance(tensor, Elsewhere) and (tensor.ndim or written or func in _NO_SCALARS):
            raise RuntimeError(f"Expected all tensors to be on the same device, but found cpu and cuda:0! ({func})")


class _Names(TorchFunctionMode):
    """Makes the stand-in of the name ``cuda`` before torch looks for a driver."""

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = dict(kwargs or {})
        if func is torch.device:
            return func(*args, **kwargs)
        if func is Tensor.cuda:
            return args[0].to(UNDER)
        if func in (torch.tensor, torch.as_tensor, torch.asarray) and _is_cuda(kwargs.get("device")):
            del kwargs["device"]
            return func(*args, **kwargs).to(UNDER)
        args = tuple(UNDER if isinstance(a, (torch.device, str)) and _is_cuda(a) else a for a in args)
        if _is_cuda(kwargs.get("device")):
            kwargs["device"] = UNDER
        return func(*args, **kwargs)


def _is_cuda(device: Any) -> bool:
    try:
        return device is not None and torch.device(device).type == "cuda"
    except (RuntimeError, TypeError):
        return False


@cache
def _kernels() -> dict[str, str]:
    """What torch's list of operations says of each."""
    text = Path(torchgen.__file__).with_name("packaged").joinpath("ATen/native/native_functions.yaml").read_text()
    return {block.split("(")[0]: block for block in text.split("\n- func: ")[1:]}


def without_cuda(used: Iterable[str]) -> list[str]:
    """Those of some operations for which CUDA has nothing."""
    return sorted(name for name in used if not _has_cuda(name))


def _has_cuda(name: str) -> bool:
    block = _kernels()[name]
    if delegate := re.search(r"structured_delegate: (\S+)", block):
        return _has_cuda(delegate[1])
    everywhere = "ufunc_inner_loop" in block or "\n  dispatch:" not in block
    return everywhere or re.search(r"\n    [\w, ]*(\bCUDA\b|Composite)[\w, ]*:", block) is not None


@contextmanager
def stand_in() -> Iterator[_Operations]:
    """``cuda`` is there inside, and is the stand-in."""
    with _Operations() as operations, _Names():
        yield operations
