"""Compiled functions on subnormal numbers, which x86 processors compute about a hundred times slower."""

from __future__ import annotations

import llvmlite.binding as llvm
import numpy as np
import pytest

from sim_backends.compiled.machine_code import compile_function, vector_length
from sim_backends.compiled.tracing import Tracer

X86_ONLY = pytest.mark.skipif(
    not llvm.get_default_triple().startswith("x86"), reason="other processors compute them as fast as other numbers"
)
TYPES = pytest.mark.parametrize("dtype", [np.float32, np.float64])


def halved(x: np.ndarray) -> np.ndarray:
    """``x / 2`` by a compiled function."""
    tracer = Tracer()
    node = tracer.input("x")
    return compile_function([node], [tracer.make("mul", node, 0.5)], x.dtype).run([x], 1)[0]


@X86_ONLY
@TYPES
def test_compiled_functions_replace_subnormal_numbers_by_zero(dtype):
    smallest = np.finfo(dtype).tiny
    x = np.resize(np.array([smallest, -smallest, 4.0 * smallest], dtype), max(vector_length(np.dtype(dtype)), 3))
    found = halved(x)
    assert (found[:2] == 0.0).all()
    assert found[2] == 2.0 * smallest


@X86_ONLY
@TYPES
def test_a_compiled_function_leaves_subnormal_numbers_to_the_rest_of_the_program(dtype):
    smallest = np.full(vector_length(np.dtype(dtype)), np.finfo(dtype).tiny, dtype)
    halved(smallest)
    assert (smallest * dtype(0.5) > 0.0).all()
