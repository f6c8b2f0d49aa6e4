"""Test detection of several effects by excess, scores under conditions, and curves with intervals."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from carlab.benchmark.baselines.scores import compare
from carlab.benchmark.intervals import wilson
from carlab.benchmark.proof.case_score import score_case
from carlab.benchmark.proof.detection import Curve, curve_rows, detection_curves, draw_detection, spurious_curves
from carlab.benchmark.proof.results_page import right
from carlab.benchmark.proof.scores import per_effect, summarise

THREE = ("steering_lag", "battery_sag", "marker_offset")


def answer(kind: str, *names: str, excesses: tuple[float, ...] = (), **more: Any) -> dict[str, Any]:
    effect = {"form": "catalogue", "parameters": {}, "lag_s": None, "place": None, "time": None, "class_words": []}
    return {
        "kind": kind, "effects": [{"id": name, **effect} for name in names], "main_channels": ["vx"],
        "target_excess": 1.0, "excess": 2.0, "single_excesses": list(excesses), "fault": None, **more,
    }  # fmt: skip


def report(*names: str, others: tuple[str, ...] = (), verdict: str = "mismatch") -> dict[str, Any]:
    effects = [{"id": name, "indistinguishable_from": list(others), "where": {}, "parameters": {}} for name in names]
    return {"schema": "carlab.diagnosis/1", "verdict": verdict, "effects": effects, "fit": {}}


def test_each_of_three_effects_and_each_name_counts() -> None:
    row = score_case(answer("multiple", *THREE, excesses=(0.5, 1.0, 4.0)), report("battery_sag", "yaw_damping"))
    assert [d["found"] for d in row["detections"]] == [False, True, False]
    assert [d["excess"] for d in row["detections"]] == [0.5, 1.0, 4.0]
    assert row["names_right"] == [True, False]
    assert row["first_right"]
    assert not right(row)
    complete = score_case(answer("multiple", *THREE), report(*THREE))
    assert right(complete)
    rates = {rate["figure"]: rate for rate in summarise([row, complete])["rates"]}
    found = rates["three to five effects: effects found"]
    assert (found["hits"], found["count"], found["target"]) == (4, 6, ">= 0.60")
    named = rates["three to five effects: names that are right"]
    assert (named["hits"], named["count"]) == (4, 5)


def test_valid_set_finds_an_effect_but_not_strictly() -> None:
    lags = report("steering_lag", others=("steering_delay",))
    row = score_case(answer("multiple", "steering_delay", "battery_sag", "marker_offset"), lags)
    assert (row["detections"][0]["found"], row["detections"][0]["strict"]) == (True, False)


def test_one_name_finds_one_of_two_effects_of_its_set() -> None:
    pair = ("throttle_nonlinearity", "traction_limit")
    set_of_both = report("motor_saturation", others=pair)
    row = score_case(answer("pair", *pair), set_of_both)
    assert not row["both_found"]
    assert sum(d["found"] for d in row["detections"]) == 1
    two = report("throttle_nonlinearity", "motor_saturation", others=("traction_limit",))
    two["effects"][0]["indistinguishable_from"] = []
    assert score_case(answer("pair", *pair), two)["both_found"]
    # The true car has one effect; the report states two, of which one is right.
    again = report("steering_lag", "steering_delay", others=("steering_lag",))
    again["effects"][0]["indistinguishable_from"] = []
    assert score_case(answer("single", "steering_lag"), again)["names_right"] == [True, False]


def test_linear_base_model_implies_tyre_saturation() -> None:
    linear = {"conditions": ["base model linear_tyre"], "implied_effects": ["tyre_saturation"]}
    row = score_case(answer("single", "steering_lag", **linear), report("tyre_saturation", "steering_lag"))
    assert row["strict_top1"]
    assert row["names_right"] == [True]
    null = score_case(answer("null", **linear), report("tyre_saturation"))
    assert (null["false_alarm"], null["verdict_right"]) == (False, True)
    assert score_case(answer("null", **linear), report("tyre_saturation", "yaw_damping"))["false_alarm"]
    assert score_case(answer("null"), report("tyre_saturation"))["false_alarm"]


def test_curves_count_by_excess_and_group() -> None:
    rows = [
        score_case(answer("multiple", *THREE, excesses=(0.5, 1.0, 4.0)), report("battery_sag")),
        score_case(answer("multiple", *THREE, excesses=(0.69, 0.7, 9.0)), report("steering_lag")),
        score_case(answer("single", "yaw_damping", excesses=(0.2,), conditions=["feedback only"]), report()),
    ]
    every, single, several = detection_curves(rows)
    assert every == Curve("all", (0, 1, 1, 0, 0), (1, 2, 2, 0, 2))
    assert several == Curve("three to five effects", (0, 1, 1, 0, 0), (0, 2, 2, 0, 2))
    assert single == Curve("one effect, feedback only", (0, 0, 0, 0, 0), (1, 0, 0, 0, 0))
    low, high = wilson(1, 2)
    assert curve_rows([several])[0][2] == f"0.50 ({low:.2f} to {high:.2f}) 1/2"
    assert curve_rows([several])[0][1] == "-"
    assert per_effect(rows)["steering_lag"] == {"alone": 0, "strict": 0, "with_sets": 0, "cases": 2, "named": 1}


def test_spurious_names_are_counted_for_random_and_listed_physics() -> None:
    random, listed = (answer("outside", "wind") for _ in range(2))
    random["effects"][0]["form"], listed["effects"][0]["form"] = "random", "outside"
    rows = [score_case(random, report("road_slope")), score_case(listed, report(verdict="unexplained"))]
    assert spurious_curves(rows) == [
        Curve("listed physics", (0, 0, 0, 0, 0), (0, 0, 0, 1, 0)),
        Curve("random physics", (0, 0, 0, 1, 0), (0, 0, 0, 1, 0)),
    ]
    shares = {rate["figure"]: rate["share"] for rate in summarise(rows)["rates"]}
    assert shares["outside: spurious attribution, random physics"] == 1.0
    assert shares["outside: spurious attribution, excess >= 1"] == 0.5


def test_curve_is_drawn(tmp_path: Path) -> None:
    curves = [Curve("one effect", (0, 1, 2, 3, 4), (4, 4, 4, 4, 4)), Curve("empty", (0,) * 5, (0,) * 5)]
    for name, start in (("a.png", b"\x89PNG"), ("a.svg", b"<?xm")):
        draw_detection(tmp_path / name, curves)
        assert (tmp_path / name).read_bytes()[:4] == start


@pytest.mark.parametrize(("named", "hits"), [("battery_sag", 1), ("yaw_damping", 0)])
def test_baselines_are_compared_on_cases_with_several_effects(named: str, hits: int) -> None:
    row = score_case(answer("multiple", *THREE), report("steering_lag"))
    results = {"stepwise BIC": {"named": named, "score": 1.5, "refit_score": 2.0, "seconds": 1.0}}
    (figure,) = (f for f in compare({"a": row}, {"a": results}) if "three to five" in f["figure"])
    assert figure["tool"] == {"hits": 1, "count": 1}
    assert figure["stepwise BIC"] == {"hits": hits, "count": 1}
