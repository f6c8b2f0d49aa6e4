"""Named arrays in one file of numbers: NumPy's ``.npz``, read without pickle.

An untrusted file must not run code. ``torch.load`` and stable-baselines3 unpickle their files, which may run code.
"""

from __future__ import annotations

import io
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from carlab.core.errors import DataError, first_line

MAX_BYTES = 256_000_000
"""Maximum size of the arrays of one file; a policy or a learned car has some hundred kilobytes."""
TOO_LARGE = f"it holds more than {MAX_BYTES / 1e6:.0f} MB"
UNREADABLE = (
    *(OSError, ValueError, LookupError, TypeError, EOFError, MemoryError, RuntimeError, ArithmeticError, SyntaxError),
    *(struct.error, tokenize.TokenError, zipfile.BadZipFile, zipfile.LargeZipFile, zlib.error),
)
"""Errors of reading a damaged file."""


def write_arrays(path: Path, arrays: Mapping[str, Tensor | int]) -> None:
    """Write tensors of any device and shape, and integers. Raises OSError if the disk is full."""
    content = io.BytesIO()
    np.savez(content, **{k: v.detach().cpu().numpy() if isinstance(v, Tensor) else v for k, v in arrays.items()})  # type: ignore[arg-type]
    path.write_bytes(content.getvalue())


def read_arrays(path: Path) -> dict[str, NDArray[np.generic]]:
    """Read all arrays of a file by name, of any shape.

    Raises:
        DataError: the file cannot be read, or holds more than ``MAX_BYTES`` or values other than numbers. The message
            is a clause without a remedy.
    """
    try:
        check_archive(path)
        with np.load(path, allow_pickle=False) as opened:
            arrays = {name: opened[name] for name in opened.files}
    except UNREADABLE as error:
        raise DataError(first_line(error)) from error
    for name, array in arrays.items():
        if not isinstance(array, np.ndarray) or array.dtype.kind not in "fiu":
            raise DataError(f"{name} holds no numbers")
    return arrays


def check_archive(path: Path) -> None:
    """Raise DataError (a clause) if the members of a ZIP file have more than ``MAX_BYTES``, BadZipFile if it is none.

    Raises:
        OSError: the file cannot be read.
    """
    with zipfile.ZipFile(path) as archive:
        if sum(member.file_size for member in archive.infolist()) > MAX_BYTES:
            raise DataError(TOO_LARGE)


def checked_tensor(arrays: Mapping[str, NDArray[np.generic]], name: str, shape: tuple[int, ...]) -> Tensor:
    """One array as a float32 tensor. Raises DataError if it is missing, not finite or of another shape or type."""
    if name not in arrays:
        raise DataError(f"{name} is missing")
    array = arrays[name]
    if array.dtype != np.float32 or array.shape != shape:
        raise DataError(f"{name} is {array.dtype} of shape {array.shape}, not float32 of shape {shape}")
    if not np.isfinite(array).all():
        raise DataError(f"{name} holds numbers that are not finite")
    return torch.from_numpy(array.copy())


def whole_number(arrays: Mapping[str, NDArray[np.generic]], name: str) -> int:
    """One integer, from an array of shape (). Raises DataError if it is missing, negative or not an integer."""
    array = arrays.get(name)
    if array is None or array.shape != () or array.dtype.kind not in "iu" or int(array) < 0:
        raise DataError(f"{name} is not a non-negative integer")
    return int(array)
