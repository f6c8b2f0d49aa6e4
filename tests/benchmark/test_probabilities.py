"""Test the comparison of stated probabilities with the share of correct names."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from carlab.benchmark.proof.case_score import score_case
from carlab.benchmark.proof.probabilities import bin_rows, brier_score, probability_bins
from carlab.benchmark.proof.results_page import results_page
from carlab.benchmark.proof.scores import summarise, write_scores


def answer(kind: str, *names: str) -> dict[str, Any]:
    effect: dict[str, Any] = {
        "form": "catalogue",
        "parameters": {},
        "lag_s": None,
        "place": None,
        "time": None,
        "class_words": [],
    }
    return {
        "kind": kind, "effects": [{"id": name, **effect} for name in names], "main_channels": ["vx"],
        "target_excess": 1.0, "excess": 2.0, "fault": None,
    }  # fmt: skip


def report(probabilities: dict[str, float | None]) -> dict[str, Any]:
    effects: list[dict[str, Any]] = [
        {"id": name, "confidence": p, "indistinguishable_from": [], "where": {}, "parameters": {}}
        for name, p in probabilities.items()
    ]
    return {"schema": "carlab.diagnosis/1", "verdict": "mismatch", "effects": effects, "fit": {}}


ROWS = [
    score_case(answer("single", "steering_lag"), report({"steering_lag": 1.0})),
    score_case(answer("pair", "battery_sag", "motor_lag"), report({"battery_sag": 0.9, "yaw_damping": 0.8})),
    score_case(answer("outside", "wind"), report({"road_slope": 0.96})),
    score_case(answer("null"), report({"lateral_bias": 0.2, "torque_steer": None})),
    score_case(answer("single", "motor_lag"), None),
]


def test_names_are_binned_by_their_probability() -> None:
    bins = probability_bins(ROWS)
    assert [(b.low, b.high, b.correct, b.count) for b in bins] == [
        (0.0, 0.3, 0, 1),
        (0.8, 0.95, 1, 2),
        (0.95, 1.0, 1, 2),
    ]
    assert [b.mean for b in bins] == pytest.approx([0.2, 0.85, 0.98])
    assert bin_rows(probability_bins(ROWS))[1] == ("0.8 to 0.95", "0.85", "0.50 (0.09 to 0.91)", "1/2")


def test_brier_score_is_the_mean_squared_error() -> None:
    squared = (0.0, 0.1**2, 0.8**2, 0.96**2, 0.2**2)
    assert brier_score(ROWS) == pytest.approx(sum(squared) / len(squared))
    assert brier_score([]) is None


def test_page_and_file_state_the_probabilities(tmp_path: Path) -> None:
    rows = {str(k): row for k, row in enumerate(ROWS)}
    runs = {str(k): {"exit_status": 0} for k in range(len(ROWS))}
    page = results_page({}, rows, runs, summarise(ROWS), [])
    assert "| 0.8 to 0.95 | 0.85 | 0.50 (0.09 to 0.91) | 1/2 |" in page
    empty = {"4": ROWS[4]}
    assert "Stated probabilities" not in results_page({}, empty, runs, summarise(empty.values()), [])
    for name, some in (("all", rows), ("none", empty)):
        write_scores(tmp_path / name, some, summarise(some.values()))
    assert len(json.loads((tmp_path / "all").read_text())["probabilities"]) == 3
    assert json.loads((tmp_path / "none").read_text())["brier_score"] is None
