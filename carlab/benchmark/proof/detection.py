"""Detection curves: share of concealed effects that are named, over their excess."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from carlab.benchmark.intervals import share_text, wilson

Row = Mapping[str, Any]
EDGES = (0.0, 0.35, 0.7, 1.4, 2.8, math.inf)
"""Edges of the bins of excess: geometric means of the target strengths 0.5, 1, 2, 4."""
BINS = ("below 0.35", "0.35 to 0.7", "0.7 to 1.4", "1.4 to 2.8", "2.8 and more")
_AT = (0.25, 0.5, 1.0, 2.0, 4.0)
KINDS = {"single": "one effect", "pair": "two effects", "multiple": "three to five effects"}


@dataclass(frozen=True)
class Curve:
    """Hits and counts of one group of cases in each of the BINS."""

    group: str
    hits: tuple[int, ...]
    counts: tuple[int, ...]

    @classmethod
    def of(cls, group: str, values: Sequence[tuple[float, bool]]) -> Curve:
        """Count pairs (excess, hit)."""
        binned = [[hit for excess, hit in values if low <= excess < high] for low, high in pairwise(EDGES)]
        return cls(group, tuple(map(sum, binned)), tuple(map(len, binned)))


def detection_curves(rows: Iterable[Row]) -> list[Curve]:
    """Return a curve for each number of effects under each combination of conditions, and before them one for all.

    Args:
        rows: Rows of ``score_case``; each concealed effect counts, with the excess of the effect alone.
    """
    groups: dict[str, list[tuple[float, bool]]] = {}
    for row in rows:
        for detection in row.get("detections", ()):
            group = ", ".join((KINDS[row["kind"]], *row["conditions"]))
            groups.setdefault(group, []).append((float(detection["excess"]), bool(detection["found"])))
    every = [value for values in groups.values() for value in values]
    return [Curve.of("all", every), *(Curve.of(group, groups[group]) for group in sorted(groups))]


def spurious_curves(rows: Iterable[Row]) -> list[Curve]:
    """Return the share of reports on uncatalogued physics with a spurious name, for listed and for random physics."""
    groups: dict[str, list[tuple[float, bool]]] = {}
    for row in rows:
        if row["kind"] == "outside" and row["reported"]:
            group = "random physics" if row["is_random"] else "listed physics"
            groups.setdefault(group, []).append((float(row["excess"]), bool(row["is_spurious"])))
    return [Curve.of(group, groups[group]) for group in sorted(groups)]


def curve_rows(curves: Iterable[Curve]) -> list[tuple[str, ...]]:
    """Return rows (group, share with interval and counts in each bin) for a table."""
    return [
        (c.group, *(share_text(h, n) + (f" {h}/{n}" if n else "") for h, n in zip(c.hits, c.counts, strict=True)))
        for c in curves
    ]


def draw_detection(path: Path, curves: Sequence[Curve]) -> None:
    """Draw the curves with their intervals; the format follows from the name of the file."""
    figure = Figure(figsize=(7.0, 4.0 + 0.2 * len(curves)), layout="constrained")
    axes = figure.add_subplot()
    for number, curve in enumerate(curves):
        shift = 1.0 + 0.03 * (number - 0.5 * (len(curves) - 1))
        known = [k for k, count in enumerate(curve.counts) if count]
        shares = [curve.hits[k] / curve.counts[k] for k in known]
        intervals = [wilson(curve.hits[k], curve.counts[k]) for k in known]
        below = [max(share - low, 0.0) for share, (low, _) in zip(shares, intervals, strict=True)]
        above = [max(high - share, 0.0) for share, (_, high) in zip(shares, intervals, strict=True)]
        label = f"{curve.group} (n {sum(curve.counts)})"
        axes.errorbar([shift * _AT[k] for k in known], shares, [below, above], marker="o", capsize=3, label=label)
    axes.set_xscale("log", base=2)
    axes.set_xticks(_AT, BINS, fontsize=8)
    axes.set(xlabel="excess of the effect alone", ylabel="share of effects found", ylim=(-0.03, 1.03), xlim=(0.2, 5.0))
    if curves:
        figure.legend(loc="outside lower center", frameon=False, fontsize=8)
    figure.savefig(path, dpi=130)
