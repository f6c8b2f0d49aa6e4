"""Cases of a proof on real recordings: held-out parts with concealed effects, and a reference of the other parts.

A car differs from drive to drive (battery, tyres), so a whole drive differs from others without anything concealed.
Therefore a part consists of short pieces of many drives, and a reference of the pieces between them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

import numpy as np

from carlab.benchmark.cases.seal import file_digest
from carlab.benchmark.effects.data_faults import Table
from carlab.benchmark.real.kinds import FULL_LOCK, KINDS, MAX_INEXACT_SHARE, Kind, Truth
from carlab.benchmark.world.measurement import COLUMNS, write_csv
from carlab.core.errors import DataError

PIECE_S = 20.0
"""Aimed length of a piece [s]."""
MAX_PARTS = 4
"""Maximum number of parts, each with its own reference."""
MIN_CASE_S, MAX_CASE_S = 60.0, 100.0
"""Minimum and maximum total length of the pieces of a case, before the guards are cut [s]."""
GUARD_S = 1.0
"""Time between a piece and the recordings of its reference, and cut at both ends of a changed piece [s]."""
MIN_REFERENCE_STRETCH_S = 10.0
"""Shorter stretches are not used in a reference [s]."""
MAX_GAP_PERIODS = 3.0
MAX_SIZE_RATIO = 0.02
"""Maximum relative difference of an effect's size between the pieces of a case."""
MOVING_MPS = 0.2
MIN_MOVING_SHARE = 0.5
SEED_BASE = 3_000_000
CaseKind = Literal["single", "pair", "null"]


@dataclass(frozen=True)
class RealCaseSpec:
    """The random draws of one case.

    ``kinds`` and ``sizes`` (0 to 2, small to large) have one entry per effect.
    """

    kind: CaseKind
    seed: int
    kinds: tuple[str, ...] = ()
    sizes: tuple[int, ...] = ()


@dataclass(frozen=True)
class Piece:
    """A stretch of one recording between two stamps [s]."""

    recording: str
    begin_s: float
    end_s: float

    @property
    def duration_s(self) -> float:
        """Length [s]."""
        return self.end_s - self.begin_s


Part = tuple[Piece, ...]
"""Pieces of recordings that a reference leaves out."""


def case_specs(seed: int = 0) -> list[RealCaseSpec]:
    """Two cases for each kind and size, 12 pairs of effects on different channels, and 40 without any."""
    rng = np.random.default_rng((SEED_BASE, seed))
    base = SEED_BASE + 10_000 * seed
    specs: list[RealCaseSpec] = []
    for kind in KINDS:
        specs += [RealCaseSpec("single", base + len(specs) + k, (kind.id,), (k % 3,)) for k in range(6)]
    while len(specs) < 6 * len(KINDS) + 12:
        one, two = (KINDS[k] for k in rng.choice(len(KINDS), 2, replace=False))
        if "both" not in (one.channel, two.channel) and one.channel != two.channel:
            sizes = (int(rng.integers(1, 3)), int(rng.integers(1, 3)))
            specs.append(RealCaseSpec("pair", base + len(specs), (one.id, two.id), sizes))
    return specs + [RealCaseSpec("null", base + len(specs) + k) for k in range(40)]


def with_full_lock(table: Table) -> Table:
    """The table with steering in shares of the larger unit of a proof, and stamps from zero."""
    return {**table, "t": table["t"] - table["t"][0], "steering": FULL_LOCK * table["steering"]}


def parts(recordings: Mapping[str, Table]) -> list[Part]:
    """Cut recordings into pieces of about ``PIECE_S``, and assign them in turn to parts that a reference can leave out.

    Raises:
        DataError: there are fewer than two parts of ``MIN_CASE_S`` of driving.
    """
    pieces = [piece for name, table in recordings.items() for piece in _pieces(name, table)]
    driven = [piece for piece in pieces if _is_driven(recordings, piece)]
    driven_s = sum(piece.duration_s for piece in driven)
    count = min(MAX_PARTS, int(driven_s / (MIN_CASE_S + PIECE_S)))
    if count < 2:
        raise DataError(
            f"The recordings have {driven_s:.0f} s of driving with varying commands in pieces of {PIECE_S:.0f} s; a "
            f"proof needs {2.0 * (MIN_CASE_S + PIECE_S):.0f} s; add recordings."
        )
    return [tuple(driven[k::count]) for k in range(count)]


def reference(recordings: Mapping[str, Table], left_out: Part) -> list[Table]:
    """The untouched recordings of a reference: everything but the pieces and ``GUARD_S`` before and after each."""
    chosen = []
    for name, table in recordings.items():
        for begin_s, end_s in _stretches(table["t"]):
            edges = [begin_s]
            for piece in left_out:
                if piece.recording == name and begin_s <= piece.begin_s < end_s:
                    edges += [piece.begin_s - GUARD_S, piece.end_s + GUARD_S]
            edges.append(end_s)
            chosen += [
                cut(table, a, b)
                for a, b in zip(edges[::2], edges[1::2], strict=True)
                if b - a >= MIN_REFERENCE_STRETCH_S
            ]
    return chosen


def cut(table: Table, begin_s: float, end_s: float) -> Table:
    """Rows of a table within two stamps, with stamps from zero."""
    rows = (table["t"] >= begin_s - 1e-9) & (table["t"] <= end_s + 1e-9)
    out = {name: table[name][rows] for name in COLUMNS}
    return {**out, "t": out["t"] - out["t"][0]}


def make_real_case(
    spec: RealCaseSpec, recordings: Mapping[str, Table], left_out: Sequence[Part]
) -> tuple[int, list[Table], dict[str, Any]]:
    """Draw the part and the pieces of a case, and conceal its effects in all of them.

    A transformation that clips too many commands takes the next smaller size; if the smallest clips, the next part.

    Returns:
        The number of the part, the recordings, and the answer as JSON.

    Raises:
        DataError: the commands of no part allow the effects.
    """
    rng = np.random.default_rng((spec.seed, 1))
    draws = rng.random(2).tolist()
    for number in rng.permutation(len(left_out)):
        pieces = _drawn_pieces(left_out[number], rng)
        made = _conceal(spec, [cut(recordings[p.recording], p.begin_s, p.end_s) for p in pieces], draws)
        if made is None:
            continue
        tables, effects = made
        answer = {"kind": spec.kind, "seed": spec.seed, "effects": effects, "part": [asdict(p) for p in pieces]}
        return int(number), [cut(t, GUARD_S, float(t["t"][-1]) - GUARD_S) for t in tables], answer
    raise DataError(f"The commands of no recording allow {' and '.join(spec.kinds)} without leaving [-1, 1].")


def _drawn_pieces(part: Part, rng: np.random.Generator) -> list[Piece]:
    """Random pieces of a part, in their order, whose total length is within ``MIN_CASE_S`` and ``MAX_CASE_S``."""
    aimed_s = rng.uniform(MIN_CASE_S, MAX_CASE_S)
    chosen: list[int] = []
    total_s = 0.0
    for k in rng.permutation(len(part)):
        if total_s < MIN_CASE_S or total_s + part[k].duration_s <= aimed_s:
            chosen.append(int(k))
            total_s += part[k].duration_s
    return [part[k] for k in sorted(chosen)]


def _conceal(
    spec: RealCaseSpec, tables: list[Table], draws: Sequence[float]
) -> tuple[list[Table], list[dict[str, Any]]] | None:
    known = {kind.id: kind for kind in KINDS}
    concealed = []
    for name, largest, draw in zip(spec.kinds, spec.sizes, draws, strict=False):
        change = _largest_exact(known[name], tables, largest, draw)
        if change is None:
            return None
        tables = change[0]
        concealed.append(change[1])
    return tables, concealed


def _largest_exact(
    kind: Kind, tables: Sequence[Table], largest: int, draw: float
) -> tuple[list[Table], dict[str, Any]] | None:
    """The tables with the largest size that clips few commands in each of them, and the answer; None without one."""
    for index in range(largest, -1, -1):
        changes = [kind.change(table, kind.sizes[index], draw) for table in tables]
        if not all(_are_close(change.truth, changes[0].truth) for change in changes):
            raise DataError("The recordings have different periods; use recordings of one period.")
        commands = [change.table[name] for change in changes for name in ("steering", "throttle")]
        inexact = max(change.inexact for change in changes)
        if all(np.abs(command).max() <= 1.0 for command in commands) and inexact <= MAX_INEXACT_SHARE:
            answer = kind.as_dict(replace(changes[0], inexact=inexact), kind.sizes[index])
            return [change.table for change in changes], {**answer, "size_index": index}
    return None


def _are_close(truth: Sequence[Truth], other: Sequence[Truth]) -> bool:
    """Whether the sizes are equal up to the jitter of the stamps."""
    return all(math.isclose(a.size, b.size, rel_tol=MAX_SIZE_RATIO) for a, b in zip(truth, other, strict=True))


def write_tables(folder: Path, tables: Mapping[str, Table]) -> dict[str, str]:
    """Write CSV files and return the hash of each."""
    folder.mkdir(parents=True, exist_ok=True)
    for file, table in tables.items():
        write_csv(folder / file, table)
    return {file: file_digest(folder / file) for file in tables}


def _stretches(t_s: np.ndarray[Any, Any]) -> list[tuple[float, float]]:
    """First and last stamp of each stretch without a gap."""
    period_s = float(np.median(np.diff(t_s)))
    breaks = np.flatnonzero(np.diff(t_s) > MAX_GAP_PERIODS * period_s)
    first, last = np.concatenate([[0], breaks + 1]), np.concatenate([breaks, [len(t_s) - 1]])
    return [(float(t_s[a]), float(t_s[b])) for a, b in zip(first, last, strict=True) if b > a]


def _pieces(name: str, table: Table) -> list[Piece]:
    """Pieces of equal length of each stretch that has at least two."""
    found: list[Piece] = []
    for begin_s, end_s in _stretches(table["t"]):
        count = round((end_s - begin_s) / PIECE_S)
        if count > 1:
            edges = np.linspace(begin_s, end_s, count + 1).tolist()
            found += [Piece(name, a, b) for a, b in pairwise(edges)]
    return found


def _is_driven(recordings: Mapping[str, Table], piece: Piece) -> bool:
    table = cut(recordings[piece.recording], piece.begin_s, piece.end_s)
    moving = float(np.mean(np.hypot(table["vx"], table["vy"]) > MOVING_MPS))
    return moving >= MIN_MOVING_SHARE and all(np.ptp(table[name]) > 0.0 for name in ("steering", "throttle"))
