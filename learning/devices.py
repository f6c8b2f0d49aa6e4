"""Devices of tensors: the CPU, or a CUDA device.

Random numbers are drawn on the CPU and moved, so that a seed gives the same draws on every device. Files hold CPU
tensors; the policy of a car runs on the CPU.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Literal, get_args

import torch
from torch import Tensor

from carlab.core.errors import ConfigError

DeviceName = Literal["cpu", "cuda"]
CALLS_BEFORE_CAPTURE = 3
"""Calls of a function before its operations are captured: the libraries of CUDA allocate their memory in them."""


def available(name: str) -> str:
    """Check that a device is available; returns its name. Raises ConfigError if torch does not find it."""
    if name not in get_args(DeviceName):
        raise ConfigError(f"--device {name}: choose one of {', '.join(get_args(DeviceName))}.")
    if torch.device(name).type == "cuda" and not torch.cuda.is_available():
        built = f"for CUDA {torch.version.cuda}" if torch.version.cuda else "without CUDA"
        raise ConfigError(
            f"--device {name}: torch finds no CUDA device here (torch {torch.__version__}, built {built}); use "
            "--device cpu, or install the driver and a torch with CUDA."
        )
    return name


def device_name(name: str) -> str:
    """Name of the device for reports, with the model of a GPU."""
    return f"{name}: {torch.cuda.get_device_name()}" if torch.device(name).type == "cuda" else name


def synchronise(device: torch.device | str) -> None:
    """Wait until a device has finished, for timing."""
    if torch.device(device).type == "cuda":
        torch.cuda.synchronize()


def can_capture(device: torch.device | str) -> bool:
    """Whether the operations of a function can be captured as a CUDA graph on a device."""
    return torch.device(device).type == "cuda" and torch.cuda.device_count() > 0


@contextmanager
def denormals_flushed() -> Iterator[None]:
    """Flush denormal numbers (below 1.2e-38 in float32) to zero in this context, as CUDA does.

    Adam's moments of inactive units decay to denormal numbers, on which the CPU is six times slower.
    """
    was = not bool(torch.full((1,), 1e-39) * 1.0)
    torch.set_flush_denormal(True)
    try:
        yield
    finally:
        torch.set_flush_denormal(was)


class CapturedFunction:
    """A function of CUDA tensors, captured as a CUDA graph and replayed.

    A replay starts all operations with one launch. For small tensors, one launch for each operation takes most of the
    time of a call. The function may change tensors in place, but must not depend on numbers that change between calls
    or copy to the CPU. See "CUDA Graphs" in the documentation of PyTorch.

    Args:
        function: of tensors of fixed shapes; returns tensors by name.
    """

    def __init__(self, function: Callable[..., dict[str, Tensor]]) -> None:
        self._function = function
        self._calls = 0
        self._graph: torch.cuda.CUDAGraph | None = None
        self._inputs: list[Tensor] = []
        self._outputs: dict[str, Tensor] = {}

    def __call__(self, *inputs: Tensor) -> dict[str, Tensor]:
        """Outputs of the function; the next call overwrites them."""
        self._calls += 1
        if self._calls <= CALLS_BEFORE_CAPTURE:
            return self._on_another_stream(inputs)
        if self._graph is None:
            self._capture(inputs)
        assert self._graph is not None
        for own, given in zip(self._inputs, inputs, strict=True):
            own.copy_(given)
        self._graph.replay()
        return self._outputs

    def _on_another_stream(self, inputs: tuple[Tensor, ...]) -> dict[str, Tensor]:
        """Call the function on another stream than the default one, on which nothing can be captured."""
        stream, current = torch.cuda.Stream(), torch.cuda.current_stream()  # type: ignore[no-untyped-call]
        stream.wait_stream(current)
        with torch.cuda.stream(stream):
            outputs = self._function(*inputs)
        current.wait_stream(stream)
        return outputs

    def _capture(self, inputs: tuple[Tensor, ...]) -> None:
        """Capture the operations, without running them."""
        graph = torch.cuda.CUDAGraph()
        self._inputs = [v.clone() for v in inputs]
        with torch.cuda.graph(graph):
            self._outputs = self._function(*self._inputs)
        self._graph = graph
