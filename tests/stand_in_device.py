"""A stand-in for CUDA: tensors that report the device ``cuda`` and raise the errors of real CUDA tensors.

Inside ``stand_in()`` each tensor created on or moved to ``cuda`` is a ``StandInTensor``. It wraps a CPU tensor, so fits
run with the values of the CPU. Like a CUDA tensor it raises an error in an operation with a CPU tensor (scalars
excepted), on conversion to NumPy and with a CPU generator. In addition it refuses to be saved, and an index must be on
the stand-in too, although CUDA would move it. A transfer copies. The operations used are recorded; torch's operator
list states which of them CUDA supports.
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
INTERNAL_DEVICE = torch.device("meta")
"""The device that torch assigns internally: it needs no driver and is not used elsewhere in the tests."""
CPU = torch.device("cpu")
_aten = torch.ops.aten
_NO_SCALARS = {_aten.cat.default, _aten.stack.default, _aten.index.Tensor}


class StandInTensor(Tensor):
    """A tensor on the stand-in; ``inner`` is the CPU tensor with its values."""

    inner: Tensor
    __torch_function__ = torch._C._disabled_torch_function_impl

    @staticmethod
    def __new__(cls, inner: Tensor) -> StandInTensor:
        return Tensor._make_wrapper_subclass(
            cls, inner.shape, strides=inner.stride(), storage_offset=inner.storage_offset(), dtype=inner.dtype,
            device=INTERNAL_DEVICE,
        )  # fmt: skip

    def __init__(self, inner: Tensor) -> None:
        self.inner = inner

    @property
    def device(self) -> torch.device:
        return CUDA

    is_cuda, is_cpu, is_meta = (property(lambda self, value=value: value) for value in (True, False, False))

    @property
    def data(self) -> Tensor:
        return StandInTensor(self.inner)

    @data.setter
    def data(self, other: Tensor) -> None:
        assert isinstance(other, StandInTensor), "torch refuses data of another device"
        Tensor.data.__set__(self, other)
        self.inner = other.inner

    def tolist(self) -> Any:
        return self.inner.tolist()

    def numpy(self, *args: Any, **kwargs: Any) -> NoReturn:
        raise TypeError("can't convert cuda:0 device type tensor to numpy. Use Tensor.cpu() first.")

    __array__ = numpy

    def __deepcopy__(self, memo: dict[int, Any]) -> StandInTensor:
        return StandInTensor(self.inner.clone())

    def __reduce_ex__(self, protocol: Any) -> NoReturn:
        raise AssertionError("a tensor that is not on the CPU must not be saved")

    def __repr__(self, **kwargs: Any) -> str:
        return f"StandInTensor({self.inner})"

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        raise AssertionError("a tensor of the stand-in is used outside of stand_in()")


class _Operations(TorchDispatchMode):
    def __init__(self) -> None:
        super().__init__()
        self.used: set[str] = set()

    @classmethod
    def _should_skip_dynamo(cls) -> bool:
        """Return that torch's compiler need not be excluded from each operation, which takes half of the time."""
        return False

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        with torch._C.DisableTorchFunction():  # device names are replaced already
            return self._dispatched(func, args, dict(kwargs or {}))

    def _dispatched(self, func: Any, args: Any, kwargs: dict[str, Any]) -> Any:
        tensors = [*_tensors(args), *_tensors(kwargs.values())]
        on_stand_in = any(isinstance(t, StandInTensor) for t in tensors)
        to = kwargs.get("device")
        if not on_stand_in and to != INTERNAL_DEVICE:
            return func(*args, **kwargs)
        self.used.add(_name(func))
        if func is _aten.copy_.default:
            _inner(args[0]).copy_(_inner(args[1]))
            return args[0]
        if to is not None:
            kwargs["device"] = CPU
        if func is _aten._to_copy.default:
            result = func(*_inner(args), **kwargs)
            return StandInTensor(result) if (to == INTERNAL_DEVICE if to is not None else on_stand_in) else result
        if on_stand_in:
            _refuse_mixed_devices(func, tensors)
        if any(isinstance(v, torch.Generator) for v in (*args, *kwargs.values())):
            raise RuntimeError("Expected a 'cuda' device type for generator but found 'cpu'")
        result = func(*_inner(args), **{name: _inner(value) for name, value in kwargs.items()})
        if on_stand_in and _is_mutable(func):
            return args[0] if isinstance(result, Tensor) else result
        return result if to == CPU else _outer(result)


@cache
def _name(func: Any) -> str:
    """Return the name of an operation in torch's operator list."""
    return str(func._schema.name.removeprefix("aten::") + f".{func._schema.overload_name}".rstrip("."))


@cache
def _is_mutable(func: Any) -> bool:
    return bool(func._schema.is_mutable)


def _tensors(values: Iterable[Any]) -> Iterator[Tensor]:
    for value in values:
        if isinstance(value, Tensor):
            yield value
        elif isinstance(value, (list, tuple)):
            yield from _tensors(value)


def _inner(value: Any) -> Any:
    if isinstance(value, (list, tuple)):
        return type(value)(map(_inner, value))
    return value.inner if isinstance(value, StandInTensor) else value


def _outer(value: Any) -> Any:
    if isinstance(value, (list, tuple)):
        return type(value)(map(_outer, value))
    return StandInTensor(value) if isinstance(value, Tensor) else value


def _refuse_mixed_devices(func: Any, tensors: list[Tensor]) -> None:
    for k, tensor in enumerate(tensors):
        written = k == 0 and _is_mutable(func)
        if not isinstance(tensor, StandInTensor) and (tensor.ndim or written or func in _NO_SCALARS):
            raise RuntimeError(f"Expected all tensors to be on the same device, but found cpu and cuda:0! ({func})")


class _DeviceNames(TorchFunctionMode):
    """Replace the device name ``cuda`` by the stand-in before torch looks for a driver."""

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = dict(kwargs or {})
        if func is torch.device:
            return func(*args, **kwargs)
        if func is Tensor.cuda:
            return args[0].to(INTERNAL_DEVICE)
        if func in (torch.tensor, torch.as_tensor, torch.asarray) and _is_cuda(kwargs.get("device")):
            del kwargs["device"]
            return func(*args, **kwargs).to(INTERNAL_DEVICE)
        args = tuple(INTERNAL_DEVICE if isinstance(a, (torch.device, str)) and _is_cuda(a) else a for a in args)
        if _is_cuda(kwargs.get("device")):
            kwargs["device"] = INTERNAL_DEVICE
        return func(*args, **kwargs)


def _is_cuda(device: Any) -> bool:
    try:
        return device is not None and torch.device(device).type == "cuda"
    except (RuntimeError, TypeError):
        return False


@cache
def _kernels() -> dict[str, str]:
    """Return the entry of each operation in torch's operator list."""
    text = Path(torchgen.__file__).with_name("packaged").joinpath("ATen/native/native_functions.yaml").read_text()
    return {block.split("(")[0]: block for block in text.split("\n- func: ")[1:]}


def without_cuda(used: Iterable[str]) -> list[str]:
    """Return the operations that CUDA does not support."""
    return sorted(name for name in used if not _has_cuda(name))


def _has_cuda(name: str) -> bool:
    block = _kernels()[name]
    if delegate := re.search(r"structured_delegate: (\S+)", block):
        return _has_cuda(delegate[1])
    has_generic_kernel = "ufunc_inner_loop" in block or "\n  dispatch:" not in block
    return has_generic_kernel or re.search(r"\n    [\w, ]*(\bCUDA\b|Composite)[\w, ]*:", block) is not None


@contextmanager
def stand_in() -> Iterator[_Operations]:
    """Make ``cuda`` available inside the context, as the stand-in."""
    with _Operations() as operations, _DeviceNames():
        yield operations
