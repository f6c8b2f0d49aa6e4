"""Records the model's equations as a graph, so that they can be compiled and differentiated without a second copy.

Calling the ordinary equations with ``Tracer`` as their functions and ``Node`` as their values yields the graph of
elementary operations (equal ones merged, constants folded). ``gradients`` adds the reverse-mode derivative of the graph
to the graph itself (Griewank and Walther, "Evaluating Derivatives", ch. 3).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, cast

from sim_backends.array_ops import Ops

Argument = "Node | float"


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
    "sqrt": math.sqrt,
    "hypot": math.hypot,
    "abs": abs,
    "sign": lambda a: math.copysign(1.0, a) if a else 0.0,
    "maximum": max,
    "minimum": min,
    "where": lambda c, a, b: a if c else b,
}


def fold(operation: str, *arguments: float) -> float:
    """An operation on plain numbers."""
    return _FOLD[operation](*arguments)


@dataclass(eq=False, slots=True)
class Tracer:
    """A graph under construction, and the functions that add to it (it is an ``Ops``)."""

    nodes: list[Node] = field(default_factory=list)
    _known: dict[tuple[Any, ...], Node] = field(default_factory=dict)

    def as_ops(self) -> Ops:
        """Itself, as what the equations take."""
        return cast(Ops, self)

    def input(self, name: str) -> Node:
        """A new input."""
        node = Node(self, len(self.nodes), "input", (name,))
        self.nodes.append(node)
        return node

    def make(self, operation: str, *arguments: Any) -> Any:
        """The node of an operation: an equal one where there is, a number where all arguments are."""
        if not any(isinstance(a, Node) for a in arguments):
            return fold(operation, *arguments)
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

    def floor(self, x: Any, low: float) -> Any:
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
    """Result of an operation with 0 or 1 that needs no computing; None otherwise."""
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


def gradients(outputs: Sequence[Any], seeds: Sequence[Node], inputs: Sequence[Node]) -> list[Any]:
    """Nodes of ``sum_i seeds_i d(outputs_i)/d(input)`` for each input; 0.0 where nothing depends on it.

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
            for argument, value in _pull(tracer, node, adjoint[node.index]):
                if isinstance(argument, Node) and argument.index in needed:
                    give(argument, value)
    return [adjoint.get(node.index, 0.0) for node in inputs]


def _depending(nodes: Sequence[Node], inputs: Sequence[Node]) -> set[int]:
    found = {node.index for node in inputs}
    for node in nodes:
        if any(isinstance(a, Node) and a.index in found for a in node.arguments):
            found.add(node.index)
    return found


def _pull(t: Tracer, node: Node, g: Any) -> list[tuple[Any, Any]]:
    """What an operation hands back to each of its arguments."""
    a, b = node.arguments[0], node.arguments[-1]
    match node.operation:
        case "add":
            return [(a, g), (b, g)]
        case "sub":
            return [(a, g), (b, -g)]
        case "mul":
            return [(a, g * b), (b, g * a)]
        case "div":
            share = g / b
            return [(a, share), (b, -(share * node))]
        case "neg":
            return [(a, -g)]
        case "sin":
            return [(a, g * t.make("cos", a))]
        case "cos":
            return [(a, -(g * t.make("sin", a)))]
        case "atan":
            return [(a, g / (1.0 + a * a))]
        case "atan2":
            share = g / (a * a + b * b)
            return [(a, share * b), (b, -(share * a))]
        case "tanh":
            return [(a, g * (1.0 - node * node))]
        case "exp":
            return [(a, g * node)]
        case "sqrt":
            return [(a, 0.5 * g / node)]
        case "hypot":
            share = g / t.make("maximum", node, 1e-30)
            return [(a, share * a), (b, share * b)]
        case "abs":
            return [(a, g * t.make("sign", a))]
        case "maximum":
            passes = t.make("less_equal", b, a)
            return [(a, g * passes), (b, g * (1.0 - passes))]
        case "minimum":
            passes = t.make("less_equal", a, b)
            return [(a, g * passes), (b, g * (1.0 - passes))]
        case "where":
            condition, yes, no = node.arguments
            return [(yes, t.make("where", condition, g, 0.0)), (no, t.make("where", condition, 0.0, g))]
        case _:  # sign and comparisons are flat
            return []
