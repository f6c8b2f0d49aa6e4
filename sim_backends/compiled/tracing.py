"""Tracing of the model's equations to a graph, for compilation and differentiation.

Calling the equations with ``Tracer`` as their functions and ``Node`` as their values yields the graph of
elementary operations (equal ones merged, constants folded). ``gradients`` adds the reverse-mode derivative of the graph
to the graph itself (Griewank and Walther, "Evaluating Derivatives", ch. 3).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Container, Sequence
from dataclasses import dataclass, field
from typing import Any

from carlab.core.errors import ConfigError


@dataclass(eq=False, slots=True)
class Node:
    """One elementary operation, or an input (``operation`` is then "input")."""

    tracer: Tracer
    index: int
    operation: str
    arguments: tuple[Any, ...]

    def __add__(self, other: Any) -> Any:
        return self.tracer.make("add", self, other)

    __radd__ = __add__

    def __mul__(self, other: Any) -> Any:
        return self.tracer.make("mul", self, other)

    __rmul__ = __mul__

    def __sub__(self, other: Any) -> Any:
        return self.tracer.make("sub", self, other)

    def __rsub__(self, other: Any) -> Any:
        return self.tracer.make("sub", other, self)

    def __truediv__(self, other: Any) -> Any:
        return self.tracer.make("div", self, other)

    def __rtruediv__(self, other: Any) -> Any:
        return self.tracer.make("div", other, self)

    def __neg__(self) -> Any:
        return self.tracer.make("neg", self)

    def __lt__(self, other: Any) -> Any:
        return self.tracer.make("less", self, other)

    def __le__(self, other: Any) -> Any:
        return self.tracer.make("less_equal", self, other)

    def __gt__(self, other: Any) -> Any:
        return self.tracer.make("less", other, self)

    def __ge__(self, other: Any) -> Any:
        return self.tracer.make("less_equal", other, self)

    def _refuse(self, *_: Any) -> Any:
        """Raise ConfigError for a branch or a function of Python, which would act on the node and not on its number."""
        raise ConfigError(
            "An equation of an effect has if, and, or, not, **, abs or a function of math; use ops.where, ops.pow, "
            "ops.abs, ops.sin ... (sim_backends.array_ops)."
        )

    __bool__ = __float__ = __pow__ = __rpow__ = __abs__ = _refuse


_FOLD: dict[str, Callable[..., float]] = {
    "add": lambda a, b: a + b,
    "sub": lambda a, b: a - b,
    "mul": lambda a, b: a * b,
    "div": lambda a, b: a / b,
    "neg": lambda a: -a,
    "less": lambda a, b: a < b,
    "less_equal": lambda a, b: a <= b,
    "sin": math.sin,
    "cos": math.cos,
    "atan": math.atan,
    "atan2": math.atan2,
    "tanh": math.tanh,
    "exp": math.exp,
    "log": math.log,
    "pow": math.pow,
    "sqrt": math.sqrt,
    "hypot": math.hypot,
    "abs": abs,
    "sign": lambda a: math.copysign(1.0, a) if a else 0.0,
    "maximum": max,
    "minimum": min,
    "where": lambda c, a, b: a if c else b,
}
"""Operations on plain numbers."""


@dataclass(eq=False, slots=True)
class Tracer:
    """A graph under construction, and the functions that add to it (it is an ``Ops``)."""

    nodes: list[Node] = field(default_factory=list)
    _known: dict[tuple[Any, ...], Node] = field(default_factory=dict)

    def input(self, name: str) -> Node:
        """A new input."""
        node = Node(self, len(self.nodes), "input", (name,))
        self.nodes.append(node)
        return node

    def make(self, operation: str, *arguments: Any) -> Any:
        """The node of an operation: an existing equal node, or a number if all arguments are numbers."""
        if not any(isinstance(a, Node) for a in arguments):
            return _FOLD[operation](*arguments)
        if (same := _neutral(operation, arguments)) is not None:
            return same
        if operation in ("add", "mul"):
            arguments = tuple(sorted(arguments, key=lambda a: a.index if isinstance(a, Node) else -1))
        key = (operation, *(("n", a.index) if isinstance(a, Node) else ("c", float(a)) for a in arguments))
        if key not in self._known:
            self._known[key] = Node(self, len(self.nodes), operation, arguments)
            self.nodes.append(self._known[key])
        return self._known[key]

    def __getattr__(self, name: str) -> Any:
        if name in _FOLD:
            return lambda *arguments: self.make(name, *arguments)
        raise AttributeError(name)

    def slope_angle(self, y: Any, x: Any) -> Any:
        """``atan2(y, x)`` for positive x."""
        return self.make("atan", self.make("div", y, x))

    def at_least(self, x: Any, low: float) -> Any:
        """Not below ``low``."""
        return self.make("maximum", x, low)

    def clip(self, x: Any, low: Any, high: Any) -> Any:
        """Between ``low`` and ``high``."""
        return self.make("minimum", self.make("maximum", x, low), high)

    def fma(self, a: Any, b: Any, c: Any) -> Any:
        """``a * b + c``."""
        return self.make("add", self.make("mul", a, b), c)

    def fms(self, a: Any, b: Any, c: Any) -> Any:
        """``c - a * b``."""
        return self.make("sub", c, self.make("mul", a, b))


def _neutral(operation: str, arguments: tuple[Any, ...]) -> Any:
    """Result of an operation with a neutral element (x + 0, x * 1 ...); None if there is none."""
    first, last = arguments[0], arguments[-1]
    constants = [a for a in arguments if not isinstance(a, Node)]
    if operation == "add" and constants and constants[0] == 0.0:
        return last if first is constants[0] else first
    if operation == "sub" and not isinstance(last, Node) and last == 0.0:
        return first
    if operation == "mul" and constants and constants[0] in (0.0, 1.0):
        if constants[0] == 0.0:
            return 0.0
        return last if first is constants[0] else first
    return None


def needed_nodes(outputs: Sequence[Any], given: Container[int] = ()) -> list[Node]:
    """The nodes that ``outputs`` need, except those with the indices ``given``, each after its arguments."""
    found: dict[int, Node] = {}
    stack = [o for o in outputs if isinstance(o, Node)]
    while stack:
        node = stack.pop()
        if node.index not in found and node.index not in given:
            found[node.index] = node
            stack += [a for a in node.arguments if isinstance(a, Node)]
    return [found[index] for index in sorted(found)]


def gradients(outputs: Sequence[Any], seeds: Sequence[Node], inputs: Sequence[Node]) -> list[Any]:
    """Nodes of ``sum_i seeds_i d(outputs_i)/d(input)`` for each input; 0.0 if no output depends on it.

    At a kink the derivative is that of torch: ``maximum(x, c)`` passes it where ``x >= c``, ``abs`` and ``sign`` give
    0 at 0, ``hypot`` 0 at the origin.
    """
    adjoint: dict[int, Any] = {}
    nodes: dict[int, Node] = {}

    def give(target: Any, value: Any) -> None:
        if isinstance(target, Node):
            adjoint[target.index] = adjoint[target.index] + value if target.index in adjoint else value

    for output, seed in zip(outputs, seeds, strict=True):
        give(output, seed)
        if isinstance(output, Node):
            nodes[output.index] = output
    if not nodes:
        return [0.0 for _ in inputs]
    tracer = next(iter(nodes.values())).tracer
    needed = _depending(tracer.nodes, inputs)
    for node in reversed(tracer.nodes[: max(nodes) + 1]):
        if node.index in adjoint and node.index in needed and node.operation != "input":
            for argument, value in _adjoint_terms(tracer, node, adjoint[node.index]):
                if isinstance(argument, Node) and argument.index in needed:
                    give(argument, value)
    return [adjoint.get(node.index, 0.0) for node in inputs]


def _depending(nodes: Sequence[Node], inputs: Sequence[Node]) -> set[int]:
    found = {node.index for node in inputs}
    for node in nodes:
        if any(isinstance(a, Node) and a.index in found for a in node.arguments):
            found.add(node.index)
    return found


def _pull_atan2(t: Tracer, n: Node, g: Any) -> tuple[Any, ...]:
    y, x = n.arguments
    share = g / (y * y + x * x)
    return share * x, -(share * y)


def _pull_hypot(t: Tracer, n: Node, g: Any) -> tuple[Any, ...]:
    share = g / t.make("maximum", n, 1e-30)
    return share * n.arguments[0], share * n.arguments[1]


def _pull_quotient(t: Tracer, n: Node, g: Any) -> tuple[Any, ...]:
    share = g / n.arguments[1]
    return share, -(share * n)


def _pull_power(t: Tracer, n: Node, g: Any) -> tuple[Any, ...]:
    """Derivatives of a power of a positive base."""
    base, exponent = n.arguments
    share = g * n
    return share * exponent / base, share * t.make("log", base)


def _pull_extremum(t: Tracer, n: Node, g: Any) -> tuple[Any, ...]:
    a, b = n.arguments
    passes = t.make("less_equal", b, a) if n.operation == "maximum" else t.make("less_equal", a, b)
    return g * passes, g * (1.0 - passes)


_PULLBACKS: dict[str, Callable[[Tracer, Node, Any], tuple[Any, ...]]] = {
    "add": lambda t, n, g: (g, g),
    "sub": lambda t, n, g: (g, -g),
    "mul": lambda t, n, g: (g * n.arguments[1], g * n.arguments[0]),
    "div": _pull_quotient,
    "neg": lambda t, n, g: (-g,),
    "sin": lambda t, n, g: (g * t.make("cos", n.arguments[0]),),
    "cos": lambda t, n, g: (-(g * t.make("sin", n.arguments[0])),),
    "atan": lambda t, n, g: (g / (1.0 + n.arguments[0] * n.arguments[0]),),
    "atan2": _pull_atan2,
    "tanh": lambda t, n, g: (g * (1.0 - n * n),),
    "exp": lambda t, n, g: (g * n,),
    "log": lambda t, n, g: (g / n.arguments[0],),
    "pow": _pull_power,
    "sqrt": lambda t, n, g: (0.5 * g / n,),
    "hypot": _pull_hypot,
    "abs": lambda t, n, g: (g * t.make("sign", n.arguments[0]),),
    "maximum": _pull_extremum,
    "minimum": _pull_extremum,
    "where": lambda t, n, g: (
        None,
        t.make("where", n.arguments[0], g, 0.0),
        t.make("where", n.arguments[0], 0.0, g),
    ),
}
"""By operation: from its node and the node's adjoint, the adjoint of each argument; None if it is zero.

Operations without an entry (sign, comparisons) have zero derivative.
"""


def _adjoint_terms(tracer: Tracer, node: Node, adjoint: Any) -> list[tuple[Any, Any]]:
    """Arguments of an operation with non-zero derivative, with their adjoints."""
    pullback = _PULLBACKS.get(node.operation)
    if pullback is None:
        return []
    pairs = zip(node.arguments, pullback(tracer, node, adjoint), strict=True)
    return [(argument, value) for argument, value in pairs if value is not None]
