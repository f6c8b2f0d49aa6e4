"""Comparison of the tool with the baselines on the same cases: strict names, false alarms, floor ratio."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from carlab.benchmark.baselines.run import BASELINES, NAMES_NOTHING
from carlab.benchmark.intervals import share_text

Row = Mapping[str, Any]
COLUMNS = ("tool", *BASELINES)


def compare(rows: Mapping[str, Row], answers: Mapping[str, Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return figures of the tool and of every baseline over the cases with results of both.

    Args:
        rows: Rows by case, from ``score_cases``.
        answers: Results of ``run_baselines`` by case; a failed case counts as no name and no gain, as a missing report
            does. Names that a wrong base model implies do not count.

    Returns:
        One entry for each figure: ``figure``, ``kind`` (rate or median) and, by column, hits and count or the median.
    """
    names = [name for name in rows if name in answers]
    figures: list[dict[str, Any]] = []

    def first(name: str, column: str) -> str | None:
        if column == "tool":
            return next(iter(rows[name]["named"]), None)
        named: str | None = (answers[name].get(column) or {}).get("named")
        return None if named in rows[name]["implied"] else named

    def rate(title: str, among: Callable[[Row], bool], hit: Callable[[Row, str | None], bool]) -> None:
        chosen = [name for name in names if among(rows[name])]
        if not chosen:
            return
        entry: dict[str, Any] = {"figure": title, "kind": "rate", "count": len(chosen)}
        for column in COLUMNS:
            hits = sum(hit(rows[name], first(name, column)) for name in chosen)
            entry[column] = None if column in NAMES_NOTHING else {"hits": hits, "count": len(chosen)}
        figures.append(entry)

    def right(row: Row, name: str | None) -> bool:
        return bool(name == row["true"][0])

    rate("correct effect first, strictly, excess >= 1", lambda r: r["kind"] == "single" and r["excess"] >= 0.85, right)
    rate("correct effect first, strictly, all strengths", lambda r: r["kind"] == "single", right)
    rate(
        "wrong effect first, singles",
        lambda r: r["kind"] == "single",
        lambda r, name: name is not None and not right(r, name),
    )
    rate(
        "one of the effects first, three to five", lambda r: r["kind"] == "multiple", lambda r, name: name in r["true"]
    )
    rate(
        "false alarms, null and parameters",
        lambda r: r["kind"] in ("null", "parameters"),
        lambda r, name: name is not None,
    )
    rate("outside: spurious attribution", lambda r: r["kind"] == "outside", lambda r, name: name is not None)
    ratios: dict[str, Any] = {"figure": "floor ratio, singles, median", "kind": "median"}
    singles = [name for name in names if rows[name]["kind"] == "single"]
    ratios["count"] = len(singles)
    for column in COLUMNS:
        values = [_floor_ratio(rows[name], answers[name], column) for name in singles]
        known = [v for v in values if v is not None]
        none = column == "cross-correlation" or not known
        ratios[column] = None if none else {"median": float(np.median(known)), "count": len(known)}
    return [*figures, ratios]


def _floor_ratio(row: Row, answers: Mapping[str, Any], column: str) -> float | None:
    """(refit - corrected) / (refit - 1), each with its own refit."""
    if column == "tool":
        return row.get("floor_ratio") if row["reported"] else 0.0
    entry = answers.get(column)
    if entry is None:
        return 0.0
    if entry["score"] is None or entry["refit_score"] <= 1.0:
        return None
    return float((entry["refit_score"] - entry["score"]) / (entry["refit_score"] - 1.0))


def comparison_rows(figures: Sequence[Mapping[str, Any]]) -> list[tuple[str, ...]]:
    """Cells for a table with the columns figure and COLUMNS."""
    return [
        (f"{entry['figure']} (n {entry['count']})", *(_cell(entry[column]) for column in COLUMNS)) for entry in figures
    ]


def _cell(value: Mapping[str, Any] | None) -> str:
    if value is None:
        return "-"
    if "median" in value:
        return f"{value['median']:.2f}"
    return share_text(value["hits"], value["count"])
