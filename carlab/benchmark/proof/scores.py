"""Scores over all cases: rates with Wilson intervals, medians, a table, JSON and a confusion matrix."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from carlab.benchmark.effects.catalogue import EFFECT_IDS
from carlab.benchmark.intervals import share_text, wilson
from carlab.benchmark.proof.case_score import score_case
from carlab.benchmark.proof.detection import detection_curves, spurious_curves
from carlab.benchmark.proof.probabilities import brier_score, probability_bins

Row = Mapping[str, Any]


def _strong(row: Row) -> bool:
    """Return whether the excess is 1 or more; cases from 0.85 on count, because the search for a size ends near 1."""
    return float(row["excess"]) >= 0.85


# (figure, key of the row, which rows count, target)
RATES: tuple[tuple[str, str, Callable[[Row], bool], str], ...] = (
    ("correct effect first, sets allowed, excess >= 1", "set_top1", _strong, ">= 0.97"),
    ("correct effect first, strictly, excess >= 1", "strict_top1", _strong, ">= 0.92"),
    ("correct effect first, sets allowed, all strengths", "set_top1", lambda r: True, ">= 0.75"),
    ("correct effect first, strictly, all strengths", "strict_top1", lambda r: True, ""),
    ("correct effect first, strictly, catalogue's form", "strict_top1", lambda r: r["form"] == "catalogue", ""),
    ("correct effect first, strictly, another form", "strict_top1", lambda r: r["form"] == "other", ""),
    ("pairs: both found", "both_found", lambda r: True, ">= 0.70"),
    ("pairs: both named strictly", "both_strict", lambda r: True, ""),
    ("false alarms, null and parameters", "false_alarm", lambda r: r["kind"] in ("null", "parameters"), "<= 0.05"),
    ("verdict correct, null and parameters", "verdict_right", lambda r: r["kind"] in ("null", "parameters"), ""),
    ("three to five effects: one of them first", "first_right", lambda r: True, ""),
    ("outside: spurious attribution", "is_spurious", lambda r: True, "<= 0.10"),
    ("outside: spurious attribution, excess >= 1", "is_spurious", _strong, "<= 0.05"),
    ("outside: spurious attribution, random physics", "is_spurious", lambda r: bool(r["is_random"]), "<= 0.10"),
    ("outside: main channel correct", "main_channel_right", lambda r: True, ">= 0.80"),
    ("outside: class correct", "class_right", lambda r: True, ">= 0.60"),
    ("data faults found", "fault_found", lambda r: True, ""),
    ("located: main channel", "channel_right", lambda r: True, ">= 0.90"),
    ("located: lag within 25 ms", "lag_right", lambda r: True, ""),
    ("located: patch centre within its radius", "place_right", lambda r: True, ""),
    ("located: drift separated from switch", "time_right", lambda r: True, ">= 0.80"),
)

# (title, kinds of cases, targets for effects found and for names that are right); each effect and each name counts.
NAMED = (
    ("one effect", ("single",), ("", "")),
    ("two effects", ("pair",), ("", "")),
    ("three to five effects", ("multiple",), (">= 0.60", ">= 0.90")),
)


def score_cases(
    answers: Mapping[str, Row],
    reports: Mapping[str, Row],
    oracles: Mapping[str, Row] | None = None,
    same: Callable[[str, str, str], bool | None] | None = None,
) -> dict[str, dict[str, Any]]:
    """Return one row for each diagnosed case.

    Args:
        answers: Answers by case, from ``Proof.open_seal``.
        reports: Reports by case, from ``Proof.reports``.
        oracles: Reports of the tool with the true names given.
        same: ``Proof.same``: whether two effects cannot be separated on a case, (case, id, id).
    """
    oracles = oracles or {}
    rows = {}
    for name, run in reports.items():
        oracle = oracles[name]["report"] if name in oracles else None
        check = partial(same, name) if same is not None else None
        rows[name] = score_case(answers[name], run["report"], oracle, run.get("seconds"), check)
    return rows


def summarise(rows: Iterable[Row]) -> dict[str, Any]:
    """Return rates, medians and coverage over rows of ``score_case``."""
    table = list(rows)
    rates = [
        _rate(title, [bool(r[key]) for r in table if r.get(key) is not None and among(r)], target)
        for title, key, among, target in RATES
    ]
    for title, kinds, target in NAMED:
        chosen = [r for r in table if r["kind"] in kinds]
        found = [bool(d["found"]) for r in chosen for d in r.get("detections", ())]
        right = [bool(name) for r in chosen for name in r.get("names_right", ())]
        rates.append(_rate(f"{title}: effects found", found, target[0]))
        rates.append(_rate(f"{title}: names that are right", right, target[1]))
    fitted = [p for r in table for p in r.get("parameters", {}).values()]
    covered = [bool(p["covered"]) for p in fitted if p["covered"] is not None]
    rates.append(_rate("90 % intervals cover", covered, "0.80 to 0.97"))
    medians = [
        _median("parameter error, relative", [p["relative_error"] for p in fitted], ""),
        _median("lag error [s]", [r.get("lag_error_s") for r in table], "<= 0.025"),
        _median("oracle ratio", [r.get("oracle_ratio") for r in table], ">= 0.90"),
        _median("floor ratio", [r.get("floor_ratio") for r in table], ">= 0.80"),
        _median("seconds", [r.get("seconds") for r in table], "<= 60"),
    ]
    return {"cases": len(table), "no_report": sum(not r["reported"] for r in table), "rates": rates, "medians": medians}


def _rate(title: str, values: Sequence[bool], target: str) -> dict[str, Any]:
    low, high = wilson(sum(values), len(values))
    return {
        "figure": title, "share": sum(values) / len(values) if values else None, "low95": low, "high95": high,
        "hits": sum(values), "count": len(values), "target": target,
    }  # fmt: skip


def _median(title: str, values: Sequence[float | None], target: str) -> dict[str, Any]:
    known = [v for v in values if v is not None]
    low, middle, high = np.quantile(known, (0.25, 0.5, 0.75)).tolist() if known else (None, None, None)
    return {
        "figure": title, "median": middle, "low_quartile": low, "high_quartile": high, "count": len(known),
        "target": target,
    }  # fmt: skip


def table_rows(summary: Mapping[str, Any]) -> list[tuple[str, str, str, str]]:
    """Return rows (figure, value with interval, cases, target) for a console table or Markdown."""
    rows = []
    for r in summary["rates"]:
        hits, count = r["hits"], r["count"]
        rows.append((r["figure"], share_text(hits, count), f"{hits}/{count}", r["target"]))
    for r in summary["medians"]:
        value = (
            "-" if r["median"] is None else f"{r['median']:.3g} ({r['low_quartile']:.3g} to {r['high_quartile']:.3g})"
        )
        rows.append((r["figure"] + ", median (quartiles)", value, str(r["count"]), r["target"]))
    return rows


def per_effect(rows: Iterable[Row]) -> dict[str, dict[str, int]]:
    """Return the cases of each effect, alone or with others: first name strictly and with sets, named at any rank."""
    found: dict[str, dict[str, int]] = {}
    for r in rows:
        for detection in r.get("detections", ()):
            start = {"alone": 0, "strict": 0, "with_sets": 0, "cases": 0, "named": 0}
            entry = found.setdefault(detection["id"], start)
            entry["cases"] += 1
            entry["named"] += bool(detection["found"])
            if r["kind"] == "single":
                entry["alone"] += 1
                entry["strict"] += bool(r["strict_top1"])
                entry["with_sets"] += bool(r["set_top1"])
    return found


def write_scores(
    path: Path, rows: Mapping[str, Row], summary: Mapping[str, Any], baselines: Sequence[Mapping[str, Any]] = ()
) -> None:
    """All figures as JSON; ``baselines`` as ``baseline_scores.compare`` gives them."""
    figures = {
        "summary": summary,
        "per_effect": per_effect(rows.values()),
        "detection": [asdict(curve) for curve in detection_curves(rows.values())],
        "spurious": [asdict(curve) for curve in spurious_curves(rows.values())],
        "probabilities": [asdict(each) for each in probability_bins(rows.values())],
        "brier_score": brier_score(rows.values()),
        "baselines": list(baselines),
    }
    path.write_text(json.dumps({**figures, "cases": dict(rows)}, indent=1) + "\n", encoding="utf-8")


def confusion(rows: Iterable[Row]) -> tuple[list[str], list[str], np.ndarray[tuple[int, ...], np.dtype[np.int64]]]:
    """Return R concealed effects, C first named effects or verdicts, and counts (R, C)."""
    pairs = []
    for r in rows:
        if r["kind"] in ("pair", "multiple"):
            continue
        true = r["true"][0] if r["kind"] == "single" else r["kind"]
        pairs.append((true, r["named"][0] if r["named"] else r["verdict"]))
    order = {name: k for k, name in enumerate((*EFFECT_IDS, "outside", "null", "parameters", "fault"))}
    concealed = sorted({t for t, _ in pairs}, key=lambda t: order.get(t, 999))
    answers = sorted({s for _, s in pairs}, key=lambda s: (order.get(s, 999) if s in EFFECT_IDS else 1000, s))
    counts = np.zeros((len(concealed), len(answers)), dtype=np.int64)
    for true, name in pairs:
        counts[concealed.index(true), answers.index(name)] += 1
    return concealed, answers, counts


def draw_confusion(path: Path, rows: Iterable[Row]) -> None:
    """Draw the confusion matrix; correct names are on the diagonal."""
    concealed, answers, counts = confusion(rows)
    figure = Figure(figsize=(3.5 + 0.3 * len(answers), 2.5 + 0.28 * len(concealed)), layout="constrained")
    axes = figure.add_subplot()
    share = counts / np.maximum(counts.sum(axis=1, keepdims=True), 1)
    axes.imshow(share, cmap="Blues", vmin=0.0, vmax=1.0, aspect="auto")
    for i, j in zip(*np.nonzero(counts), strict=True):
        colour = "white" if share[i, j] > 0.6 else "black"
        axes.text(j, i, str(counts[i, j]), ha="center", va="center", fontsize=7, color=colour)
    axes.set_xticks(range(len(answers)), answers, rotation=90, fontsize=7)
    axes.set_yticks(range(len(concealed)), concealed, fontsize=7)
    axes.set_xlabel("named first, or verdict")
    axes.set_ylabel("concealed")
    figure.savefig(path, dpi=130)
