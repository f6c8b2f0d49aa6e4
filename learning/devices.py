"""Where tensors are: on the CPU, or on a CUDA device where there is one.

Random numbers are drawn on the CPU and moved, so that a seed means the same draws everywhere; files hold tensors of the
CPU, and what drives a car runs there.
"""

from __future__ import annotations

from typing import Literal

import torch

from carlab.core.errors import ConfigError

DeviceName = Literal["cpu", "cuda"]


def available(name: str) -> str:
    """The name, where torch finds such a device. Raises ConfigError otherwise."""
    if torch.device(name).type == "cuda" and not torch.cuda.is_available():
        built = f"for CUDA {torch.version.cuda}" if torch.version.cuda else "without CUDA"
        raise ConfigError(
            f"--device {name}: torch finds no CUDA device here (torch {torch.__version__}, built {built}); use "
            "--device cpu, or install the driver and a torch with CUDA."
        )
    return name


def described(name: str) -> str:
    """The device for a file of figures."""
    return f"{name}: {torch.cuda.get_device_name()}" if torch.device(name).type == "cuda" else name


def settle(device: torch.device | str) -> None:
    """Wait until a device has done what it was given, for taking times."""
    if torch.device(device).type == "cuda":
        torch.cuda.synchronize()


__all__ = ["DeviceName", "available", "described", "settle"]
