"""Functions of rows against Python's math library, with NumPy's and with torch's code."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from sim_backends.array_ops import ARRAYS
from sim_backends.batch.rollout import rollout
from sim_backends.car_parameters import SimulatorConfig
from sim_backends.compiled import simd
from sim_backends.compiled.simd import ROWS
from sim_backends.compiled.step import compile_step

LENGTH = 2000
SPECIAL = [0.0, -0.0, 1e-30, -1e30, math.inf, -math.inf, math.nan]
REFERENCES = {"arctan": math.atan, "arctan2": math.atan2, "hypot": math.hypot}


@pytest.fixture(params=[False, True], ids=["torch", "numpy"], autouse=True)
def library(request, monkeypatch):
    """Let NumPy have SIMD code or not, whatever the processor is."""
    monkeypatch.setattr(simd, "has_simd", lambda function, dtype: request.param)
    simd.faster_in_torch.cache_clear()
    compile_step.cache_clear()
    yield
    simd.faster_in_torch.cache_clear()
    compile_step.cache_clear()


def row(dtype: type, seed: int) -> np.ndarray:
    values = np.random.default_rng(seed).normal(0.0, 3.0, LENGTH)
    values[: len(SPECIAL)] = np.roll(SPECIAL, seed)
    return values.astype(dtype)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("function", sorted(REFERENCES))
def test_functions_of_rows_equal_those_of_the_math_library(function, dtype):
    own = getattr(simd, function)
    arguments = [row(dtype, seed) for seed in range(2 if function != "arctan" else 1)]
    expected = np.array([REFERENCES[function](*map(float, each)) for each in zip(*arguments, strict=True)])
    tolerance = 4 * np.finfo(dtype).eps
    np.testing.assert_allclose(own(*arguments), expected.astype(dtype), rtol=tolerance, atol=0.0)
    out = np.empty(LENGTH, dtype)
    assert own(*arguments, out) is out
    np.testing.assert_allclose(out, expected.astype(dtype), rtol=tolerance, atol=0.0)


def test_functions_accept_numbers_short_read_only_and_strided_rows():
    long = row(np.float64, 0)[-1800:]
    read_only = np.broadcast_to(np.float64(0.3), long.shape)
    for y, x in ((0.3, long), (long, 0.3), (long[:5], long[5:10]), (read_only, long), (long[::2], long[1::2])):
        np.testing.assert_allclose(simd.arctan2(y, x), np.arctan2(y, x), rtol=1e-14)
        np.testing.assert_allclose(simd.hypot(y, x), np.hypot(y, x), rtol=1e-14)
    for x in (0.3, long[:5], read_only, long[::2]):
        np.testing.assert_allclose(simd.arctan(x), np.arctan(x), rtol=1e-14)


def test_operations_of_rows_equal_those_of_arrays():
    y, x = row(np.float64, 1)[len(SPECIAL) :], np.abs(row(np.float64, 2)[len(SPECIAL) :]) + 0.1
    for name in ("atan2", "slope_angle", "hypot"):
        np.testing.assert_allclose(getattr(ROWS, name)(y, x), getattr(ARRAYS, name)(y, x), rtol=1e-14)
    np.testing.assert_allclose(ROWS.atan(y), ARRAYS.atan(y), rtol=1e-14)


def test_long_batches_equal_operators_of_torch():
    """A batch that is longer than ``MIN_LENGTH`` uses the functions of this module in the compiled step."""
    rng = np.random.default_rng(0)
    start = torch.tensor(rng.normal([0.0, 0.0, 0.0, 2.0, 0.0, 0.0], 0.3, (LENGTH, 6)))
    commands = torch.tensor(rng.uniform(-0.5, 0.5, (LENGTH, 5, 2)))
    compiled, reference = (
        rollout(SimulatorConfig(), start, commands, engine=engine).states for engine in ("fastest", "operators")
    )
    assert torch.allclose(compiled, reference, rtol=1e-12, atol=1e-12)
