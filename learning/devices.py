"""Devices of tensors: the CPU, or a CUDA device.

Random numbers are drawn on the CPU and moved, so that a seed gives the same draws on every device. Files hold CPU
tensors; the policy of a car runs on the CPU.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Literal, get_args

import torch

from carlab.core.errors import ConfigError

DeviceName = Literal["cpu", "cuda"]


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


__all__ = ["DeviceName", "available", "denormals_flushed", "device_name", "synchronise"]
