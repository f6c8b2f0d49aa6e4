"""Elementary functions of vectors as LLVM code: a writer of straight-line code, and its sine, arc tangent and so on.

Arguments are reduced as in the Cephes library (Moshier, "Methods and Programs for Mathematical Functions", 1989): sine
and cosine to [-pi/4, pi/4] by multiples of pi/2 in three parts, the arc tangent to [0, tan(pi/8)], the exponential to
half of ln 2. NaN arguments give NaN.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple, TypeAlias

import numpy as np

from sim_backends.compiled.polynomials import (
    ATAN,
    ATANH,
    COS,
    EXP,
    EXP_RANGE,
    HALF_PI_PARTS,
    LN2_PARTS,
    SIN,
    TANH,
)

Name: TypeAlias = str
"""A vector value in the code: a variable or a constant."""

_FRACTION_BITS = {32: 23, 64: 52}
_EXPONENT_BIAS = {32: 127, 64: 1023}
_TANH_BY_POLYNOMIAL = 0.625
_FUNCTIONS = ("atan", "atan2", "exp", "log", "pow", "tanh")
"""Operations that are functions of the code, besides sine and cosine."""


class Function(NamedTuple):
    """A function of the code."""

    result_type: str
    """A structure of vectors."""
    results: int
    code: list[str]


@dataclass(slots=True)
class VectorWriter:
    """Writes straight-line LLVM code on vectors of ``lanes`` numbers with ``bits`` bits; each name is assigned once.

    Each method writes one operation or one function, and returns the name of its result.
    """

    bits: int
    lanes: int
    lines: list[str] = field(default_factory=list)
    """The code so far; may be replaced by another list between two operations."""
    functions: dict[str, Function] = field(default_factory=dict)
    """Functions that ``lines`` calls, by operation. Written at each call instead, they would be most of the
    code, and it would take two to four times as long to compile."""
    _written: int = 0
    _sin_cos: dict[Name, list[Name]] = field(default_factory=dict)

    @property
    def type(self) -> str:
        """Type of a vector."""
        return f"<{self.lanes} x {self.number}>"

    @property
    def number(self) -> str:
        """Type of a number of a vector."""
        return "float" if self.bits == 32 else "double"

    @property
    def _integers(self) -> str:
        return f"<{self.lanes} x i{self.bits}>"

    @property
    def _booleans(self) -> str:
        return f"<{self.lanes} x i1>"

    def constant(self, value: float) -> Name:
        """A vector of equal numbers."""
        number = float(np.float32(value)) if self.bits == 32 else value
        return f"splat ({self.number} 0x{struct.pack('>d', number).hex()})"

    def variable(self) -> Name:
        """A new name."""
        self._written += 1
        return f"%v{self._written}"

    def write(self, code: str) -> Name:
        """Write an instruction, and return the name of its result."""
        name = self.variable()
        self.lines.append(f"  {name} = {code}")
        return name

    def _binary(self, instruction: str, a: Name, b: Name) -> Name:
        return self.write(f"{instruction} {self.type} {a}, {b}")

    def add(self, a: Name, b: Name) -> Name:
        """``a + b``; a product that is added may be fused."""
        return self._binary("fadd contract", a, b)

    def sub(self, a: Name, b: Name) -> Name:
        """``a - b``."""
        return self._binary("fsub contract", a, b)

    def mul(self, a: Name, b: Name) -> Name:
        """``a * b``."""
        return self._binary("fmul contract", a, b)

    def div(self, a: Name, b: Name) -> Name:
        """``a / b``."""
        return self._binary("fdiv", a, b)

    def neg(self, a: Name) -> Name:
        """``-a``."""
        return self.write(f"fneg {self.type} {a}")

    def fma(self, a: Name, b: Name, c: Name) -> Name:
        """``a * b + c``, fused where the processor can."""
        return self._call("fmuladd", a, b, c)

    def _call(self, function: str, *arguments: Name) -> Name:
        kind = f"v{self.lanes}f{self.bits}"
        return self.write(f"call {self.type} @llvm.{function}.{kind}({self._typed(arguments)})")

    def declarations(self) -> list[str]:
        """LLVM's functions and own functions that the code calls."""
        kind, vector = f"v{self.lanes}f{self.bits}", self.type
        counts = {"fmuladd": 3, "fabs": 1, "sqrt": 1, "copysign": 2}
        return [
            *(f"declare {vector} @llvm.{f}.{kind}({', '.join([vector] * n)})" for f, n in counts.items()),
            *(line for function in self.functions.values() for line in function.code),
        ]

    def compare(self, relation: str, a: Name, b: Name) -> Name:
        """Booleans of an ordered comparison: ``olt``, ``ole``, ``ogt``."""
        return self.write(f"fcmp {relation} {self.type} {a}, {b}")

    def where(self, condition: Name, yes: Name, no: Name) -> Name:
        """``yes`` where ``condition``, otherwise ``no``."""
        return self.write(f"select {self._booleans} {condition}, {self.type} {yes}, {self.type} {no}")

    def maximum(self, a: Name, b: Name) -> Name:
        """The larger one; NaN where ``a`` is NaN."""
        return self.where(self.compare("olt", a, b), b, a)

    def minimum(self, a: Name, b: Name) -> Name:
        """The smaller one; NaN where ``a`` is NaN."""
        return self.where(self.compare("olt", b, a), b, a)

    def abs(self, a: Name) -> Name:
        """``|a|``."""
        return self._call("fabs", a)

    def sqrt(self, a: Name) -> Name:
        """Square root."""
        return self._call("sqrt", a)

    def sign(self, a: Name) -> Name:
        """-1, 0 or 1."""
        zero = self.constant(0.0)
        negative = self.where(self.compare("olt", a, zero), self.constant(-1.0), a)
        return self.where(self.compare("olt", zero, a), self.constant(1.0), negative)

    def hypot(self, a: Name, b: Name) -> Name:
        """``sqrt(a^2 + b^2)``, for arguments whose squares neither overflow nor underflow."""
        return self.sqrt(self.fma(a, a, self.mul(b, b)))

    def _polynomial(self, coefficients: Sequence[float], x: Name) -> Name:
        result = self.constant(coefficients[-1])
        for coefficient in reversed(coefficients[:-1]):
            result = self.fma(result, x, self.constant(coefficient))
        return result

    def _rounded(self, x: Name) -> tuple[Name, Name]:
        """The nearest whole number to ``x``, and the same as integers.

        Adding 1.5 * 2^fraction bits moves the whole number into the lowest bits of the fraction.
        """
        shift = self.constant(1.5 * 2.0 ** _FRACTION_BITS[self.bits])
        shifted = self.write(f"fadd {self.type} {x}, {shift}")
        integers = self.write(f"bitcast {self.type} {shifted} to {self._integers}")
        return self.write(f"fsub {self.type} {shifted}, {shift}"), integers

    def _reduced(self, x: Name, multiple: Name, parts: Sequence[float]) -> Name:
        """``x - multiple * sum(parts)``."""
        negative = self.neg(multiple)
        for part in parts:
            x = self.fma(negative, self.constant(part), x)
        return x

    def _sine_and_cosine(self, x: Name) -> list[Name]:
        turns, integers = self._rounded(self.mul(x, self.constant(2.0 / math.pi)))
        r = self._reduced(x, turns, HALF_PI_PARTS[self.bits])
        limit = math.pi / 4 * 1.01  # of use only where x is so large that its fraction is lost
        r = self.minimum(self.maximum(r, self.constant(-limit)), self.constant(limit))
        s = self.mul(r, r)
        sine = self.fma(self.mul(r, s), self._polynomial(SIN[self.bits], s), r)
        high = self._polynomial(COS[self.bits], s)
        cosine = self.fma(self.mul(s, s), high, self.fma(s, self.constant(-0.5), self.constant(1.0)))
        lowest = self.write(f"and {self._integers} {integers}, {self._integer(1)}")
        odd = self.write(f"icmp ne {self._integers} {lowest}, {self._integer(0)}")
        sine_sign, cosine_sign = self._sign_bit(integers, 0), self._sign_bit(integers, 1)
        return [
            self._flipped(self.where(odd, cosine, sine), sine_sign),
            self._flipped(self.where(odd, sine, cosine), cosine_sign),
        ]

    def _integer(self, value: int) -> Name:
        return f"splat (i{self.bits} {value})"

    def _sign_bit(self, quadrants: Name, ahead: int) -> Name:
        """The second lowest bit of ``quadrants + ahead``, moved to the place of the sign."""
        moved = self.write(f"add {self._integers} {quadrants}, {self._integer(ahead)}")
        bit = self.write(f"and {self._integers} {moved}, {self._integer(2)}")
        return self.write(f"shl {self._integers} {bit}, {self._integer(self.bits - 2)}")

    def _flipped(self, x: Name, sign_bit: Name) -> Name:
        integers = self.write(f"bitcast {self.type} {x} to {self._integers}")
        changed = self.write(f"xor {self._integers} {integers}, {sign_bit}")
        return self.write(f"bitcast {self._integers} {changed} to {self.type}")

    def sin(self, x: Name) -> Name:
        """Sine; of arguments so large that their fraction is lost, any number in [-1, 1]."""
        return self._both(x)[0]

    def cos(self, x: Name) -> Name:
        """Cosine, like ``sin``."""
        return self._both(x)[1]

    def _both(self, x: Name) -> list[Name]:
        """Sine and cosine, computed once for each argument."""
        if x not in self._sin_cos:
            self._sin_cos[x] = self._call_own("sine_and_cosine", VectorWriter._sine_and_cosine, x)
        return self._sin_cos[x]

    def _atan_of_quotient(self, numerator: Name, denominator: Name) -> Name:
        """``atan(n / d)`` for 0 <= n <= d and d > 0, in [0, pi/4], with a single division.

        Above tan(pi/8): ``atan(n / d) = pi/4 + atan((n - d) / (n + d))``.
        """
        edge = self.mul(denominator, self.constant(math.tan(math.pi / 8)))
        far = self.compare("olt", edge, numerator)
        top = self.where(far, self.sub(numerator, denominator), numerator)
        bottom = self.where(far, self.add(numerator, denominator), denominator)
        t = self.div(top, bottom)
        s = self.mul(t, t)
        near = self.fma(self.mul(t, s), self._polynomial(ATAN[self.bits], s), t)
        return self.add(near, self.where(far, self.constant(math.pi / 4), self.constant(0.0)))

    def atan(self, x: Name) -> Name:
        """Arc tangent."""
        size, one = self.abs(x), self.constant(1.0)
        large = self.compare("olt", one, size)
        angle = self._atan_of_quotient(self.where(large, one, size), self.where(large, size, one))
        angle = self.where(large, self.sub(self.constant(math.pi / 2), angle), angle)
        return self._call("copysign", angle, x)

    def atan2(self, y: Name, x: Name) -> Name:
        """Angle of the point (x, y); 0 at the origin, for x = -0.0 too."""
        across, along = self.abs(y), self.abs(x)
        steep = self.compare("olt", along, across)
        smallest = self.constant(float(np.finfo(np.float32 if self.bits == 32 else np.float64).tiny))
        larger = self.maximum(self.where(steep, across, along), smallest)
        angle = self._atan_of_quotient(self.where(steep, along, across), larger)
        angle = self.where(steep, self.sub(self.constant(math.pi / 2), angle), angle)
        behind = self.compare("olt", x, self.constant(0.0))
        angle = self.where(behind, self.sub(self.constant(math.pi), angle), angle)
        return self._call("copysign", angle, y)

    def exp(self, x: Name) -> Name:
        """Exponential; results below the smallest normal number are 0."""
        low, high = EXP_RANGE[self.bits]
        inside = self.minimum(self.maximum(x, self.constant(low)), self.constant(high))
        powers, integers = self._rounded(self.mul(inside, self.constant(1.0 / math.log(2.0))))
        r = self._reduced(inside, powers, LN2_PARTS[self.bits])
        rest = self.fma(self.mul(r, r), self._polynomial(EXP[self.bits], r), r)
        near = self.write(f"fadd {self.type} {rest}, {self.constant(1.0)}")
        # near * 2^power in two factors, since 2^power alone may overflow.
        half = self.write(f"ashr {self._integers} {self._lowest(integers)}, {self._integer(1)}")
        other = self.write(f"sub {self._integers} {self._lowest(integers)}, {half}")
        result = self.mul(self.mul(near, self._power_of_two(half)), self._power_of_two(other))
        result = self.where(self.compare("olt", x, self.constant(low)), self.constant(0.0), result)
        return self.where(self.compare("olt", self.constant(high), x), self.constant(math.inf), result)

    def _lowest(self, shifted: Name) -> Name:
        """The signed whole numbers of ``_rounded``'s integers, without the bits of the shift."""
        unused = self._integer(self.bits - _FRACTION_BITS[self.bits] + 1)
        left = self.write(f"shl {self._integers} {shifted}, {unused}")
        return self.write(f"ashr {self._integers} {left}, {unused}")

    def _power_of_two(self, exponents: Name) -> Name:
        biased = self.write(f"add {self._integers} {exponents}, {self._integer(_EXPONENT_BIAS[self.bits])}")
        moved = self.write(f"shl {self._integers} {biased}, {self._integer(_FRACTION_BITS[self.bits])}")
        return self.write(f"bitcast {self._integers} {moved} to {self.type}")

    def log(self, x: Name) -> Name:
        """Natural logarithm of positive normal numbers; NaN for negative numbers, -infinity for 0.

        With x = 2^k m and sqrt(1/2) <= m < sqrt(2): ``log(m) = 2 atanh(t)`` with ``t = (m - 1) / (m + 1)``.
        """
        fraction = _FRACTION_BITS[self.bits]
        integers = self.write(f"bitcast {self.type} {x} to {self._integers}")
        half = self._integer(
            struct.unpack("<q", struct.pack("<d", math.sqrt(0.5)))[0] if self.bits == 64 else 0x3F3504F3
        )
        above = self.write(f"sub {self._integers} {integers}, {half}")
        power = self.write(f"ashr {self._integers} {above}, {self._integer(fraction)}")
        moved = self.write(f"shl {self._integers} {power}, {self._integer(fraction)}")
        rest = self.write(f"sub {self._integers} {integers}, {moved}")
        m = self.write(f"bitcast {self._integers} {rest} to {self.type}")
        k = self.write(f"sitofp {self._integers} {power} to {self.type}")
        one = self.constant(1.0)
        t = self.div(self.sub(m, one), self.add(m, one))
        s = self.mul(t, t)
        odd = self.fma(self.mul(t, s), self._polynomial(ATANH[self.bits], s), t)
        high, low = LN2_PARTS[self.bits]
        result = self.fma(k, self.constant(high), self.fma(k, self.constant(low), self.add(odd, odd)))
        zero = self.constant(0.0)
        result = self.where(self.compare("olt", zero, x), result, self.constant(math.nan))
        result = self.where(self.compare("oeq", x, zero), self.constant(-math.inf), result)
        return self.where(self.compare("oeq", x, self.constant(math.inf)), x, result)

    def pow(self, x: Name, exponent: Name) -> Name:
        """Power of a positive base."""
        return self.exp(self.mul(exponent, self.log(x)))

    def tanh(self, x: Name) -> Name:
        """Hyperbolic tangent."""
        size = self.abs(x)
        s = self.mul(x, x)
        small = self.fma(self.mul(x, s), self._polynomial(TANH[self.bits], s), x)
        growth = self.add(self.exp(self.add(size, size)), self.constant(1.0))
        large = self.sub(self.constant(1.0), self.div(self.constant(2.0), growth))
        use_polynomial = self.compare("olt", size, self.constant(_TANH_BY_POLYNOMIAL))
        return self.where(use_polynomial, small, self._call("copysign", large, x))

    def function(self, operation: str) -> Callable[..., Name]:
        """The method of an operation of the traced graph."""
        if operation in ("less", "less_equal"):
            relation = "olt" if operation == "less" else "ole"
            return lambda a, b: self.compare(relation, a, b)
        if operation in _FUNCTIONS:
            method: Callable[..., Name] = getattr(VectorWriter, operation)
            return lambda *x: self._call_own(operation, lambda *given: [method(*given)], *x)[0]
        return getattr(self, operation)  # type: ignore[no-any-return]

    def _call_own(self, operation: str, write: Callable[..., list[Name]], *arguments: Name) -> list[Name]:
        """Call the function of an operation; ``write`` writes its body to a writer, and returns its results."""
        if operation not in self.functions:
            body = VectorWriter(self.bits, self.lanes)
            names = [f"%x{k}" for k in range(len(arguments))]
            results = write(body, *names)
            kind, value = f"{{ {', '.join(self.type for _ in results)} }}", "poison"
            for k, result in enumerate(results):
                value = body.write(f"insertvalue {kind} {value}, {self.type} {result}, {k}")
            head = f"define internal fastcc {kind} @{operation}({self._typed(names)}) noinline {{"
            self.functions[operation] = Function(kind, len(results), [head, *body.lines, f"  ret {kind} {value}", "}"])
        kind, count, _ = self.functions[operation]
        called = self.write(f"call fastcc {kind} @{operation}({self._typed(arguments)})")
        return [self.write(f"extractvalue {kind} {called}, {k}") for k in range(count)]

    def _typed(self, names: Sequence[Name]) -> str:
        """Arguments of a call or a definition."""
        return ", ".join(f"{self.type} {name}" for name in names)
