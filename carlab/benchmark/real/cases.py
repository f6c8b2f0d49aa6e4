"""Cases of a proof on real recordings: parts that are left out of a reference, and what is concealed in them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

import numpy as np

from carlab.benchmark.cases.seal import file_digest
from carlab.benchmark.effects.data_faults import Table
from carlab.benchmark.real.kinds import FULL_LOCK, KINDS, MAX_INEXACT, Kind
from carlab.benchmark.world.measurement import COLUMNS, write_csv
from carlab.core.errors import DataError

PART_S = 80.0
"""Aimed length of a part that a reference leaves out [s]."""
SHORTEST_S, LONGEST_S = 60.0, 100.0
"""Length of the recording of a case [s]."""
GUARD_S = 1.0
"""Time between a part and the recordings of its reference, and cut at both ends of a changed recording [s]."""
SHORTEST_REFERENCE_S = 20.0
"""Shorter pieces of a recording are left out of a reference [s]."""
MAX_GAP_PERIODS = 3.0
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

    def as_dict(self) -> dict[str, Any]:
        """As JSON."""
        return asdict(self)


@dataclass(frozen=True)
class Part:
    """A stretch of one recording between two stamps [s]."""

    recording: str
    begin_s: float
    end_s: float


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
    """Cut recordings into parts of about ``PART_S`` that a reference can leave out.

    Raises:
        DataError: there is no part whose reference would keep ``SHORTEST_S`` of driving.
    """
    found, total_s = [], 0.0
    for name, table in recordings.items():
        for begin_s, end_s in _stretches(table["t"]):
            total_s += end_s - begin_s
            if end_s - begin_s >= SHORTEST_S:
                edges = np.linspace(begin_s, end_s, max(1, round((end_s - begin_s) / PART_S)) + 1)
                found += [Part(name, float(a), float(b)) for a, b in pairwise(edges)]
    usable = [
        part for part in found if total_s - (part.end_s - part.begin_s) >= SHORTEST_S and _is_driven(recordings, part)
    ]
    if not usable:
        raise DataError(
            f"The recordings have {total_s:.0f} s without gaps; a proof needs {2.0 * SHORTEST_S:.0f} s of driving "
            f"with varying commands, {SHORTEST_S:.0f} s of them in one piece; add recordings."
        )
    return usable


def reference(recordings: Mapping[str, Table], left_out: Part) -> list[Table]:
    """The untouched recordings of a reference: everything but the part and ``GUARD_S`` before and after it."""
    kept = []
    for name, table in recordings.items():
        for begin_s, end_s in _stretches(table["t"]):
            pieces = [(begin_s, end_s)]
            if name == left_out.recording:
                pieces = [
                    (begin_s, min(end_s, left_out.begin_s - GUARD_S)),
                    (max(begin_s, left_out.end_s + GUARD_S), end_s),
                ]
            kept += [cut(table, a, b) for a, b in pieces if b - a >= SHORTEST_REFERENCE_S]
    return kept


def cut(table: Table, begin_s: float, end_s: float) -> Table:
    """Rows of a table within two stamps, with stamps from zero."""
    rows = (table["t"] >= begin_s - 1e-9) & (table["t"] <= end_s + 1e-9)
    out = {name: table[name][rows] for name in COLUMNS}
    return {**out, "t": out["t"] - out["t"][0]}


def make_real_case(
    spec: RealCaseSpec, recordings: Mapping[str, Table], left_out: Sequence[Part]
) -> tuple[int, Table, dict[str, Any]]:
    """Draw the part and the recording of a case, and conceal its effects.

    A transformation that clips too many commands takes the next smaller size; if the smallest clips, the next part.

    Returns:
        The number of the part, the recording, and the answer as JSON.

    Raises:
        DataError: the commands of no part allow the effects.
    """
    rng = np.random.default_rng((spec.seed, 1))
    draws = rng.random(2).tolist()
    for number in rng.permutation(len(left_out)):
        part = left_out[number]
        length_s = min(part.end_s - part.begin_s, rng.uniform(SHORTEST_S, LONGEST_S))
        begin_s = rng.uniform(part.begin_s, part.end_s - length_s)
        table = cut(recordings[part.recording], begin_s, begin_s + length_s)
        made = _conceal(spec, table, draws)
        if made is None:
            continue
        answer = {"kind": spec.kind, "seed": spec.seed, "effects": made[1], "part": asdict(part), "begin_s": begin_s}
        end_s = float(made[0]["t"][-1])
        return int(number), cut(made[0], GUARD_S, end_s - GUARD_S), answer
    raise DataError(f"The commands of no recording allow {' and '.join(spec.kinds)} without leaving [-1, 1].")


def _conceal(
    spec: RealCaseSpec, table: Table, draws: np.ndarray[Any, Any]
) -> tuple[Table, list[dict[str, Any]]] | None:
    known = {kind.id: kind for kind in KINDS}
    concealed = []
    for name, largest, draw in zip(spec.kinds, spec.sizes, draws, strict=False):
        change = _largest_exact(known[name], table, largest, draw)
        if change is None:
            return None
        table = change[0]
        concealed.append(change[1])
    return table, concealed


def _largest_exact(kind: Kind, table: Table, largest: int, draw: float) -> tuple[Table, dict[str, Any]] | None:
    for index in range(largest, -1, -1):
        change = kind.apply(table, kind.sizes[index], draw)
        inside = all(np.abs(change.table[name]).max() <= 1.0 for name in ("steering", "throttle"))
        if inside and change.inexact <= MAX_INEXACT:
            return change.table, {**kind.as_dict(change, kind.sizes[index]), "size_index": index}
    return None


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


def _is_driven(recordings: Mapping[str, Table], part: Part) -> bool:
    table = cut(recordings[part.recording], part.begin_s, part.end_s)
    moving = float(np.mean(np.hypot(table["vx"], table["vy"]) > MOVING_MPS))
    return moving >= MIN_MOVING_SHARE and all(np.ptp(table[name]) > 0.0 for name in ("steering", "throttle"))
