"""Compiled functions of vectors against the math library and mpmath."""

from __future__ import annotations

import math

import mpmath
import numpy as np
import pytest

from sim_backends.compiled.machine_code import compile_function, vector_length
from sim_backends.compiled.tracing import Tracer
from sim_backends.compiled.vector_math import VectorWriter

LENGTH = 3001
SPECIAL = (0.0, -0.0, 1e-30, -1e-30, 1e30, -1e30, math.inf, -math.inf, math.nan)
UNARY = {
    "sin": (-300.0, 300.0),
    "cos": (-300.0, 300.0),
    "atan": (-20.0, 20.0),
    "tanh": (-8.0, 8.0),
    "exp": (-80.0, 80.0),
    "log": (1e-6, 50.0),
    "sqrt": (0.0, 50.0),
}
"""Intervals in which the error is at most ``MAX_ERROR``."""
MAX_ERROR = 2.5
"""In units in the last place."""
TYPES = pytest.mark.parametrize("dtype", [np.float32, np.float64])


def compiled(operation: str, *arguments: np.ndarray) -> np.ndarray:
    tracer = Tracer()
    nodes = [tracer.input(str(k)) for k in range(len(arguments))]
    code = compile_function(nodes, [tracer.make(operation, *nodes)], arguments[0].dtype)
    length = len(arguments[0])
    rows = [np.resize(a, max(length, vector_length(a.dtype))) for a in arguments]
    return code.run(rows, 1)[0, :length]


def units(found: np.ndarray, operation: str, *arguments: np.ndarray) -> np.ndarray:
    """Return errors against mpmath in units in the last place."""
    with mpmath.workdps(40):
        exact = [
            getattr(mpmath, operation)(*map(mpmath.mpf, map(float, each))) for each in zip(*arguments, strict=True)
        ]
        errors = [float(mpmath.mpf(float(a)) - b) for a, b in zip(found, exact, strict=True)]
    return np.abs(errors) / np.spacing(np.abs(np.array([float(e) for e in exact]).astype(found.dtype))).astype(float)


@TYPES
@pytest.mark.parametrize("operation", sorted(UNARY))
def test_functions_are_exact_to_the_last_digits(operation, dtype, rng):
    x = rng.uniform(*UNARY[operation], LENGTH).astype(dtype)
    assert units(compiled(operation, x), operation, x).max() < MAX_ERROR
    near = np.copysign(10.0 ** rng.uniform(-20, 0, LENGTH), rng.normal(size=LENGTH) if UNARY[operation][0] < 0 else 1.0)
    near = near.astype(dtype)
    assert units(compiled(operation, near), operation, near).max() < MAX_ERROR


@TYPES
@pytest.mark.parametrize("operation", ["atan2", "hypot"])
def test_functions_of_two_numbers_are_exact_to_the_last_digits(operation, dtype, rng):
    y, x = (rng.normal(0.0, 3.0, LENGTH).astype(dtype) for _ in range(2))
    assert units(compiled(operation, y, x), operation, y, x).max() < MAX_ERROR


@TYPES
def test_powers_have_the_error_of_exponent_times_logarithm(dtype, rng):
    base, exponent = rng.uniform(0.01, 1.0, LENGTH).astype(dtype), rng.uniform(0.3, 3.0, LENGTH).astype(dtype)
    expected = base.astype(np.longdouble) ** exponent.astype(np.longdouble)
    np.testing.assert_allclose(compiled("pow", base, exponent), expected.astype(dtype), rtol=16 * np.finfo(dtype).eps)


@TYPES
def test_special_arguments(dtype):
    x = np.array(SPECIAL, dtype)
    with np.errstate(all="ignore"):
        for operation in ("atan", "tanh", "exp", "sqrt"):
            expected = getattr(np, {"atan": "arctan"}.get(operation, operation))(x)
            np.testing.assert_allclose(compiled(operation, x), expected, rtol=1e-6, atol=1e-30, err_msg=operation)
        np.testing.assert_allclose(compiled("log", np.abs(x)), np.log(np.abs(x)), rtol=1e-6)
        assert np.isnan(compiled("log", -np.abs(x[4:]))).all()
    for operation in ("sin", "cos"):
        found = compiled(operation, x)
        assert np.isnan(found[6:]).all()
        assert (np.abs(found[:6]) <= 1.0).all()
    zero = np.zeros(8, dtype)
    assert (compiled("atan2", zero, zero) == 0.0).all()
    assert (compiled("atan2", zero, zero - 2.0) == dtype(math.pi)).all()


@TYPES
def test_sine_keeps_its_digits_after_a_thousand_turns(dtype, rng):
    """A car that circles for an hour has turned a few thousand times."""
    x = rng.uniform(-6283.0, 6283.0, LENGTH).astype(dtype)
    expected = [float(mpmath.sin(float(v))) for v in x]
    assert np.abs(compiled("sin", x) - expected).max() < 2 * np.finfo(dtype).eps


@TYPES
def test_arithmetic_equals_numpy(dtype, rng):
    a, b = (rng.normal(0.0, 3.0, LENGTH).astype(dtype) for _ in range(2))
    b[:5] = a[:5]
    equal = {
        "add": a + b,
        "sub": a - b,
        "mul": a * b,
        "div": a / b,
        "maximum": np.maximum(a, b),
        "minimum": np.minimum(a, b),
    }
    equal |= {"less": a < b, "less_equal": a <= b}
    for operation, expected in equal.items():
        np.testing.assert_array_equal(compiled(operation, a, b), expected.astype(dtype), err_msg=operation)
    for operation, expected in {"neg": -a, "abs": np.abs(a), "sign": np.sign(a)}.items():
        np.testing.assert_array_equal(compiled(operation, a), expected, err_msg=operation)
    assert np.isnan(compiled("maximum", np.full(8, math.nan, dtype), b[:8])).all()


def test_rows_shorter_than_a_vector_are_refused():
    tracer = Tracer()
    node = tracer.input("x")
    with pytest.raises(ValueError, match="at least"):
        compile_function([node], [node], np.dtype(np.float64)).run([np.zeros(1)], 1)


def test_code_of_a_function_is_written_once():
    """Code of a function at each call would multiply the time of the compiler."""
    writer = VectorWriter(32, 8)
    for k in range(20):
        writer.function("atan")(f"%x{k}")
        writer.function("sin")(f"%x{k}")
        writer.function("cos")(f"%x{k}")
    assert len(writer.lines) == 20 * 5  # a call and its result; a call and the sine and the cosine
    definitions = [line for line in writer.declarations() if line.startswith("define ")]
    assert len(definitions) == 2
