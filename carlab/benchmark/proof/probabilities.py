"""Stated probabilities of names, compared with the share of names that are correct."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

from carlab.benchmark.intervals import share_text

EDGES = (0.0, 0.3, 0.6, 0.8, 0.95, 1.0)
"""Edges of the bins of the stated probability; the last bin contains 1."""


@dataclass(frozen=True)
class ProbabilityBin:
    """Names whose stated probability is in [low, high): their mean probability, and how many are correct."""

    low: float
    high: float
    mean: float
    correct: int
    count: int


def stated_names(named: Iterable[Mapping[str, Any]], true: Iterable[str]) -> list[dict[str, Any]]:
    """Stated probability and correctness of each name of a report; names without a probability do not count.

    In a set of indistinguishable effects, the probability is that of the first name.
    """
    concealed = set(true)
    return [
        {"probability": float(e["confidence"]), "correct": e["id"] in concealed}
        for e in named
        if e.get("confidence") is not None
    ]


def probability_bins(rows: Iterable[Mapping[str, Any]]) -> list[ProbabilityBin]:
    """Bins with at least one name over rows of ``score_case``."""
    names = _names(rows)
    bins = []
    for low, high in pairwise(EDGES):
        own = [n for n in names if low <= n["probability"] < high or (high == EDGES[-1] == n["probability"])]
        if own:
            mean = sum(n["probability"] for n in own) / len(own)
            bins.append(ProbabilityBin(low, high, mean, sum(n["correct"] for n in own), len(own)))
    return bins


def brier_score(rows: Iterable[Mapping[str, Any]]) -> float | None:
    """Mean squared difference between stated probability and correctness (Brier 1950); None without names."""
    names = _names(rows)
    return sum((n["probability"] - n["correct"]) ** 2 for n in names) / len(names) if names else None


def bin_rows(bins: Iterable[ProbabilityBin]) -> list[tuple[str, str, str, str]]:
    """Rows (stated probability, its mean, share of correct names with interval, counts) for a table."""
    return [
        (f"{b.low:g} to {b.high:g}", f"{b.mean:.2f}", share_text(b.correct, b.count), f"{b.correct}/{b.count}")
        for b in bins
    ]


def _names(rows: Iterable[Mapping[str, Any]]) -> list[dict[str, Any]]:
    return [name for row in rows for name in row.get("stated_names", ())]
