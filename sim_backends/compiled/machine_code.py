"""Machine code of traced graphs: LLVM code on vectors of cars, compiled within the process by llvmlite.

A function has rows of one number per car as inputs and outputs. It computes all operations of a vector of cars in
registers, so no intermediate result goes to memory. A register has 8 cars with AVX2 in single precision. A vector of a
simulation has two registers: an operation of one runs while that of the other waits for its arguments.

Subnormal numbers are replaced by zero on x86 processors, where an operation with one takes about 100 cycles. The side
slip of a car at rest decays through them.
"""

from __future__ import annotations

import ctypes
import functools
import itertools
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import llvmlite
import llvmlite.binding as llvm
import numpy as np
from numpy.typing import NDArray

from sim_backends.compiled.code_cache import cached_object_code
from sim_backends.compiled.tracing import Node, needed_nodes
from sim_backends.compiled.vector_math import Name, VectorWriter

FloatRow = NDArray[np.floating[Any]]
_FUNCTION = ctypes.CFUNCTYPE(None, ctypes.c_int64, ctypes.c_int64, ctypes.c_void_p, ctypes.c_void_p)
_BOOLEAN = ("less", "less_equal")
_IDS = itertools.count()
_NAME = "carlab_function"
_REGISTERS = 2
"""Registers of a vector of a simulation."""
_FLUSH_SUBNORMAL = 0x8040
"""Bits of the control register MXCSR that replace subnormal arguments and results by zero."""
OPTIMISATION = 1
"""Level of LLVM's optimisation: level 2 compiles 10 % longer and is not faster, level 0 is up to 1.8 times as slow."""


@dataclass(frozen=True, slots=True)
class _Compiler:
    """The compiler for this processor."""

    machine: Any
    """LLVM's target machine, which compiles to object code."""
    linker: Any
    """LLVM's just-in-time linker, which loads object code."""
    register_bits: int
    is_x86: bool
    name: str
    """Processor, its features, version and settings of the compiler: what the object code of a source depends on."""


@functools.cache
def _compiler() -> _Compiler:
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    target, cpu, features = llvm.Target.from_default_triple(), llvm.get_host_cpu_name(), llvm.get_host_cpu_features()
    settings = {"cpu": cpu, "features": features.flatten(), "opt": OPTIMISATION, "jit": True}
    machine, for_linker = (target.create_target_machine(**settings) for _ in range(2))
    bits = 512 if features.get("avx512f") else 256 if features.get("avx") else 128
    name = f"{target.triple} {settings} llvmlite {llvmlite.__version__} LLVM {llvm.llvm_version_info}"
    return _Compiler(machine, llvm.create_lljit_compiler(for_linker), bits, target.triple.startswith("x86"), name)


def _register_length(dtype: np.dtype[Any]) -> int:
    """Cars in a register of this processor."""
    return _compiler().register_bits // (8 * dtype.itemsize)


def vector_length(dtype: np.dtype[Any]) -> int:
    """Cars in a vector of a simulation."""
    return _REGISTERS * _register_length(dtype)


@dataclass(frozen=True, slots=True)
class MachineCode:
    """A compiled function of rows."""

    call: Callable[[int, int, int, int], None]
    """Arguments: length of the rows, number of segments (one or more), addresses of the tables of inputs and outputs.

    Rows are contiguous, of the compiled type, and have at least ``vector_length`` numbers. No output shares memory with
    an input.
    """
    _library: Any
    """Keeps the code in memory."""

    def run(self, inputs: Sequence[FloatRow], count: int) -> FloatRow:
        """Output rows (count, cars) of a function that has no segments, from input rows (cars,).

        Raises:
            ValueError: The rows are shorter than ``vector_length``.
        """
        cars, least = len(inputs[0]), vector_length(inputs[0].dtype)
        if cars < least:
            raise ValueError(f"A compiled function needs rows of at least {least} numbers.")
        outputs = np.empty((count, cars), inputs[0].dtype)
        given, results = addresses(inputs), addresses(outputs)
        self.call(cars, 0, given.ctypes.data, results.ctypes.data)
        return outputs


class SegmentTable:
    """Columns of the table of segments: whole numbers, and addresses of rows."""

    STEPS, HAS_START, STEP, TIME, STEERING, THROTTLE, START, OUT = range(8)
    """Number of steps (one or more); whether the first carried rows have given values at the start of the segment; then
    addresses."""


def addresses(rows: Iterable[FloatRow]) -> NDArray[np.uint64]:
    """The table (rows,) of the addresses of contiguous rows (cars,)."""
    return np.array([row.__array_interface__["data"][0] for row in rows], np.uint64)


def compile_function(inputs: Sequence[Node], outputs: Sequence[Any], dtype: np.dtype[Any]) -> MachineCode:
    """Compile a function from the rows ``inputs`` to the rows ``outputs`` (nodes or numbers)."""
    writer, names = _load_inputs(inputs, dtype, _register_length(dtype))
    for node in needed_nodes(outputs, names):
        names[node.index] = _operation(writer, node, names)
    for k, output in enumerate(outputs):
        _store_row(writer, _row(writer, "%out", k), _value(writer, output, names))
    return _compile(writer, ["  br label %next", "next:"])


def compile_segments(
    parameters: Sequence[Node],
    held: Sequence[Node],
    step: Node,
    time: Node,
    carried: Sequence[Node],
    body_rows: int,
    outputs: Sequence[Any],
    dtype: np.dtype[Any],
) -> MachineCode:
    """Compile loops over segments and their steps; ``outputs`` become the next ``carried``.

    The input rows are ``parameters`` and ``carried``. The output is a table of segments (``SegmentTable``), with the
    addresses of the rows ``held``, ``step`` and ``time`` at the start, of the block of the first ``body_rows`` carried
    rows at the start if they are given, and of the block of carried rows at the end. Each operation runs in the
    outermost loop that has its arguments.
    """
    writer, names = _load_inputs([*parameters, *carried], dtype, vector_length(dtype))
    at_start = [names.pop(node.index) for node in carried]
    at_segment = [writer.variable() for _ in carried]
    at_step = [writer.variable() for _ in (time, *carried)]
    before, writer.lines = writer.lines, []
    (steps, has_start), (*rows, start, end) = _segment_columns(writer)
    names |= {node.index: _load_row(writer, row) for node, row in zip((step, time, *held), rows, strict=True)}
    first_step = _start_of_segment(writer, start, has_start, at_segment, body_rows)
    start_time, segment = names[time.index], writer.lines
    names |= {node.index: name for node, name in zip((time, *carried), at_step, strict=True)}
    depths = {node.index: 1 for node in (step, *held)} | {node.index: 2 for node in (time, *carried)}
    body = list[str]()
    _write_by_depth(writer, needed_nodes(outputs, names), names, depths, (before, segment, body))
    writer.lines = body
    after = [writer.add(names[time.index], names[step.index]), *(_value(writer, o, names) for o in outputs)]
    ends = writer.lines = list[str]()
    for k, value in enumerate(after[1:]):
        _store_row(writer, _row_of_block(writer, end, k), value)
    writer.lines = before
    rest = [
        "  br label %segments",
        "segments:",
        "  %j = phi i64 [ 0, %vector ], [ %j_next, %ends ]",
        *_phis(writer, at_segment, "%vector", at_start, "%ends", after[1:]),
        f"  %place = mul i64 %j, {SegmentTable.OUT + 1}",
        "  %segment = getelementptr i64, ptr %out, i64 %place",
        *segment,
        "  br label %step",
        "step:",
        "  %k = phi i64 [ 0, %segments ], [ %k_next, %step ]",
        *_phis(writer, at_step, "%segments", [start_time, *first_step], "%step", after),
        *body,
        "  %k_next = add i64 %k, 1",
        f"  %again = icmp slt i64 %k_next, {steps}",
        "  br i1 %again, label %step, label %ends",
        "ends:",
        *ends,
        "  %j_next = add i64 %j, 1",
        "  %another = icmp slt i64 %j_next, %count",
        "  br i1 %another, label %segments, label %next",
        "next:",
    ]
    return _compile(writer, rest)


def _phis(
    writer: VectorWriter,
    names: Sequence[Name],
    before: str,
    first: Sequence[Name],
    loop: str,
    following: Sequence[Name],
) -> list[str]:
    """Variables of a loop: ``first`` when entered from the block ``before``, ``following`` from the block ``loop``."""
    rows = zip(names, first, following, strict=True)
    return [f"  {name} = phi {writer.type} [ {a}, {before} ], [ {b}, {loop} ]" for name, a, b in rows]


def _segment_columns(writer: VectorWriter) -> tuple[list[Name], list[Name]]:
    """The whole numbers of the segment and its addresses, both in the order of ``SegmentTable``."""
    columns = [writer.write(f"getelementptr i64, ptr %segment, i64 {k}") for k in range(SegmentTable.OUT + 1)]
    numbers, rows = columns[: SegmentTable.STEP], columns[SegmentTable.STEP :]
    return [writer.write(f"load i64, ptr {c}") for c in numbers], [writer.write(f"load ptr, ptr {c}") for c in rows]


def _write_by_depth(
    writer: VectorWriter,
    nodes: Sequence[Node],
    names: dict[int, Name],
    depths: dict[int, int],
    loops: tuple[list[str], list[str], list[str]],
) -> None:
    """Write each operation to the code of the outermost loop that has its arguments."""
    for node in nodes:
        depths[node.index] = max((depths.get(a.index, 0) for a in node.arguments if isinstance(a, Node)), default=0)
        writer.lines = loops[depths[node.index]]
        names[node.index] = _operation(writer, node, names)


def _start_of_segment(
    writer: VectorWriter, block: Name, has_start: Name, carried: Sequence[Name], body_rows: int
) -> list[Name]:
    """The carried values, of which the first ``body_rows`` are those of the block if the segment has a start."""
    is_set = writer.write(f"icmp ne i64 {has_start}, 0")
    body = [_load_row(writer, _row_of_block(writer, block, k)) for k in range(body_rows)]
    pairs = zip(body, carried, strict=False)
    chosen = [writer.write(f"select i1 {is_set}, {writer.type} {a}, {writer.type} {b}") for a, b in pairs]
    return [*chosen, *carried[body_rows:]]


def _row_of_block(writer: VectorWriter, block: Name, k: int) -> Name:
    """The address of a row of a block (rows, cars)."""
    offset = writer.write(f"mul i64 %cars, {k}")
    return writer.write(f"getelementptr {writer.number}, ptr {block}, i64 {offset}")


def _load_inputs(inputs: Sequence[Node], dtype: np.dtype[Any], lanes: int) -> tuple[VectorWriter, dict[int, Name]]:
    writer = VectorWriter(8 * dtype.itemsize, lanes)
    return writer, {node.index: _load_row(writer, _row(writer, "%in", k)) for k, node in enumerate(inputs)}


def _compile(writer: VectorWriter, rest: Sequence[str]) -> MachineCode:
    """Compile the code of a vector: the writer's lines, then ``rest`` with the label ``next``."""
    declarations, flush, restore = _flush_of_subnormal_numbers() if _compiler().is_x86 else ((), (), ())
    source = [
        *writer.declarations(),
        *declarations,
        f"define void @{_NAME}(i64 %cars, i64 %count, ptr %in, ptr %out) {{",
        "entry:",
        *flush,
        f"  %last = sub i64 %cars, {writer.lanes}",
        "  br label %vector",
        "vector:",
        "  %wanted = phi i64 [ 0, %entry ], [ %following, %next ]",
        "  %over = icmp sgt i64 %wanted, %last",
        "  %at = select i1 %over, i64 %last, i64 %wanted",
        *writer.lines,
        *rest,
        f"  %following = add i64 %wanted, {writer.lanes}",
        "  %more = icmp slt i64 %following, %cars",
        "  br i1 %more, label %vector, label %end",
        "end:",
        *restore,
        "  ret void",
        "}",
    ]
    return _linked("\n".join(source))


def _flush_of_subnormal_numbers() -> tuple[list[str], list[str], list[str]]:
    """Declarations, code that replaces subnormal numbers by zero from here on, and code that ends this."""
    load, store = ("void @llvm.x86.sse.ldmxcsr", "void @llvm.x86.sse.stmxcsr")
    flush = [
        "  %mode_before = alloca i32",
        "  %mode = alloca i32",
        f"  call {store}(ptr %mode_before)",
        "  %bits_before = load i32, ptr %mode_before",
        f"  %bits = or i32 %bits_before, {_FLUSH_SUBNORMAL}",
        "  store i32 %bits, ptr %mode",
        f"  call {load}(ptr %mode)",
    ]
    return [f"declare {load}(ptr)", f"declare {store}(ptr)"], flush, [f"  call {load}(ptr %mode_before)"]


def _linked(source: str) -> MachineCode:
    """The function of LLVM code, compiled or from the cache."""
    compiler = _compiler()

    def compiled() -> bytes:
        code: bytes = compiler.machine.emit_object(llvm.parse_assembly(source))
        return code

    code = cached_object_code((compiler.name, source), compiled)
    builder = llvm.JITLibraryBuilder().add_object_img(code).export_symbol(_NAME)
    library = builder.link(compiler.linker, f"library_{next(_IDS)}")
    return MachineCode(_FUNCTION(library[_NAME]), library)


def _row(writer: VectorWriter, table: str, k: int) -> str:
    """The address of a row in a table of addresses."""
    place = writer.write(f"getelementptr ptr, ptr {table}, i64 {k}")
    return writer.write(f"load ptr, ptr {place}")


def _load_row(writer: VectorWriter, row: str) -> Name:
    """The vector of cars ``%at`` of a row."""
    address = writer.write(f"getelementptr {writer.number}, ptr {row}, i64 %at")
    return writer.write(f"load {writer.type}, ptr {address}, align {writer.bits // 8}")


def _store_row(writer: VectorWriter, row: str, value: Name) -> None:
    address = writer.write(f"getelementptr {writer.number}, ptr {row}, i64 %at")
    writer.lines.append(f"  store {writer.type} {value}, ptr {address}, align {writer.bits // 8}")


def _value(writer: VectorWriter, value: Any, names: dict[int, Name]) -> Name:
    """The vector of a node or number; booleans become 1 and 0."""
    if not isinstance(value, Node):
        return writer.constant(value)
    name = names[value.index]
    if value.operation in _BOOLEAN:
        return writer.where(name, writer.constant(1.0), writer.constant(0.0))
    return name


def _operation(writer: VectorWriter, node: Node, names: dict[int, Name]) -> Name:
    arguments = [_value(writer, a, names) for a in node.arguments[1 if node.operation == "where" else 0 :]]
    if node.operation == "where":
        arguments.insert(0, names[node.arguments[0].index])
    return writer.function(node.operation)(*arguments)
