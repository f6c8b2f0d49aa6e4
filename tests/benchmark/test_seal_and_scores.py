"""Test the seal, resumed proofs, and scores of correct and wrong reports."""

from __future__ import annotations

import copy
import json
import math
import secrets
import sys
from pathlib import Path
from typing import Any

import pytest

from carlab.benchmark.cases.proof_set import CaseSpec
from carlab.benchmark.cases.seal import check, digest
from carlab.benchmark.intervals import wilson
from carlab.benchmark.proof.case_score import score_case, valid_set
from carlab.benchmark.proof.detection import spurious_curves
from carlab.benchmark.proof.results_page import failures
from carlab.benchmark.proof.runner import Proof
from carlab.benchmark.proof.scores import (
    confusion,
    draw_confusion,
    score_cases,
    summarise,
    table_rows,
    write_scores,
)
from carlab.core.errors import DataError

FAKE_DIAGNOSIS = (sys.executable, str(Path(__file__).with_name("fake_diagnosis.py")))
SPECS = [
    CaseSpec("single", 1, ("steering_lag",), "catalogue", 2.0, fit_s=10.0, hold_s=6.0),
    CaseSpec("null", 2, fit_s=8.0, hold_s=5.0),
]


def answer(kind: str = "single", name: str = "steering_lag", **more: Any) -> dict[str, Any]:
    effect = {
        "id": name, "form": "catalogue", "parameters": {"time_constant": 0.1}, "lag_s": 0.1, "place": None,
        "time": None, "class_words": [["steering"]],
    }  # fmt: skip
    return {
        "kind": kind, "effects": [effect] if kind in ("single", "outside") else [], "main_channels": ["yaw_rate"],
        "target_excess": 1.0, "excess": 1.0, "fault": None, **more,
    }  # fmt: skip


def report(*named: str, others: tuple[str, ...] = (), verdict: str | None = None, **more: Any) -> dict[str, Any]:
    effects = [
        {
            "id": name,
            "parameters": {"time_constant": {"value": 0.11, "low90": 0.09, "high90": 0.12}},
            "indistinguishable_from": list(others),
            "where": {"channels": ["yaw_rate"], "lag_s": 0.11, "time": None, "place": None},
        }
        for name in named
    ]
    return {
        "schema": "carlab.diagnosis/1",
        "verdict": verdict or ("mismatch" if named else "none"),
        "effects": effects,
        "fit": {"held_out": {"refit": {"score": 3.0}, "with_effects": {"score": 1.2}}},
        **more,
    }


def test_correct_name_is_a_hit() -> None:
    row = score_case(answer(), report("steering_lag"), oracle=report("steering_lag"))
    assert row["strict_top1"]
    assert row["set_top1"]
    assert row["channel_right"]
    assert row["lag_right"]
    assert row["parameters"]["time_constant"]["relative_error"] == pytest.approx(0.1)
    assert row["parameters"]["time_constant"]["covered"]
    assert row["floor_ratio"] == pytest.approx(0.9)
    assert row["oracle_ratio"] == pytest.approx(1.0)


def test_wrong_name_and_second_place_are_misses() -> None:
    assert not score_case(answer(), report("motor_lag"))["set_top1"]
    assert not score_case(answer(), report("motor_lag", "steering_lag"))["set_top1"]


def test_set_is_a_hit_only_with_confusable_effects() -> None:
    in_set = score_case(answer(name="tyre_relaxation"), report("steering_lag", others=("tyre_relaxation",)))
    assert in_set["set_top1"]
    assert not in_set["strict_top1"]
    assert "parameters" not in in_set
    assert not score_case(answer(name="motor_lag"), report("steering_lag", others=("motor_lag",)))["set_top1"]
    three = ("steering_delay", "steering_rate_limit", "tyre_relaxation")
    assert not score_case(answer(name="tyre_relaxation"), report("steering_lag", others=three))["set_top1"]
    lags = report("steering_lag", others=("steering_delay",))
    assert score_case(answer(name="steering_delay"), lags, same=lambda a, b: None)["set_top1"]
    assert not score_case(answer(name="steering_delay"), lags, same=lambda a, b: False)["set_top1"]
    assert valid_set({"id": "yaw_damping", "indistinguishable_from": []})


def test_false_alarms_in_null_cases() -> None:
    for kind, verdict in (("null", "none"), ("parameters", "parameters")):
        correct, false_alarm = (
            score_case(answer(kind), report(verdict=verdict)),
            score_case(answer(kind), report("battery_sag")),
        )
        assert (correct["false_alarm"], correct["verdict_right"]) == (False, True)
        assert (false_alarm["false_alarm"], false_alarm["verdict_right"]) == (True, False)


def test_pairs_require_both_effects() -> None:
    pair = answer("pair")
    pair["effects"] = [answer()["effects"][0], answer(name="battery_sag")["effects"][0]]
    assert score_case(pair, report("battery_sag", "steering_lag"))["both_found"]
    assert not score_case(pair, report("steering_lag"))["both_found"]


def test_outside_requires_channel_and_class_without_a_name() -> None:
    unexplained = {"channels": ["yaw_rate"], "class": "odd in steering, acts on yaw_rate", "regime": "", "share": 0.5}
    good = score_case(answer("outside", "camber"), report(verdict="unexplained", unexplained=unexplained))
    assert (good["is_spurious"], good["main_channel_right"], good["class_right"]) == (False, True, True)
    bad = score_case(answer("outside", "camber"), report("steering_offset"))
    assert (bad["is_spurious"], bad["main_channel_right"], bad["class_right"]) == (True, False, False)


def test_scores_of_place_time_and_wrapped_direction() -> None:
    truth = answer(name="low_friction_patch")
    truth["effects"][0] |= {"place": {"x": 1.0, "y": 2.0, "radius": 0.5}, "lag_s": None, "time": "drift"}
    truth["effects"][0]["parameters"] = {"direction": math.pi - 0.05}
    case_report = report("low_friction_patch")
    case_report["effects"][0]["where"] |= {"place": {"x": 1.3, "y": 2.2}, "time": "drift over the run"}
    case_report["effects"][0]["parameters"] = {"direction": {"value": -math.pi + 0.05, "low90": -3.3, "high90": -3.0}}
    row = score_case(truth, case_report)
    assert row["place_right"]
    assert row["time_right"]
    assert row["parameters"]["direction"]["relative_error"] == pytest.approx(0.1 / (math.pi - 0.05))
    assert row["parameters"]["direction"]["covered"]
    case_report["effects"][0]["where"]["place"] = {"x": 1.6, "y": 2.2}
    assert not score_case(truth, case_report)["place_right"]


def test_missing_report_is_a_miss_and_wrong_schema_an_error() -> None:
    row = score_case(answer(), None)
    assert not row["set_top1"]
    assert not row["reported"]
    with pytest.raises(DataError, match="schema"):
        score_case(answer(), report("steering_lag") | {"schema": "carlab.diagnosis/9"})


def test_failures_state_the_reason_of_a_missing_report() -> None:
    row = score_case(answer(), None)
    runs = {
        "a": {"exit_status": None, "output": "worker lost: the node died"},
        "b": {"exit_status": None, "output": "ended after 1800 s"},
        "c": {"exit_status": -9, "output": "reading\nKilled"},
    }
    assert failures(dict.fromkeys(runs, row), runs).splitlines() == [
        "* a: single steering_lag: no report: worker lost: the node died",
        "* b: single steering_lag: no report: ended after 1800 s",
        "* c: single steering_lag: no report (exit status -9): Killed",
    ]


def test_missing_report_is_no_evidence_against_false_alarms_and_no_correct_verdict() -> None:
    wrong_model = {"conditions": ["base model kinematic"], "implied_effects": ["tyre_saturation"]}
    rows = [score_case(answer(kind, **wrong_model), None) for kind in ("null", "parameters")]
    rows += [score_case(answer("outside"), None), score_case(answer("null"), report("motor_lag"))]
    counts = {r["figure"]: (r["hits"], r["count"]) for r in summarise(rows)["rates"]}
    assert counts["false alarms, null and parameters"] == (1, 1)
    assert counts["verdict correct, null and parameters"] == (0, 3)
    assert counts["outside: spurious attribution"] == (0, 0)
    assert spurious_curves(rows) == []


def test_wilson_interval_equals_published_values() -> None:
    # Newcombe (1998), Statistics in Medicine 17, table I: 81/263, 15/148, 0/20, 1/29 at 95 %.
    for hits, count, low, high in (
        (81, 263, 0.2553, 0.3662),
        (15, 148, 0.0624, 0.1605),
        (0, 20, 0.0, 0.1611),
        (1, 29, 0.0061, 0.1718),
    ):
        assert wilson(hits, count) == (pytest.approx(low, abs=2e-4), pytest.approx(high, abs=2e-4))


def test_summary_table_and_pictures(tmp_path: Path) -> None:
    rows = {
        "a": score_case(answer(), report("steering_lag"), seconds=40.0),
        "b": score_case(answer(), report("motor_lag"), seconds=50.0),
        "c": score_case(answer("null"), report(), seconds=30.0),
    }
    summary = summarise(rows.values())
    shares = {r["figure"]: r["share"] for r in summary["rates"]}
    assert shares["correct effect first, strictly, excess >= 1"] == 0.5
    assert shares["false alarms, null and parameters"] == 0.0
    assert shares["90 % intervals cover"] == 1.0
    assert any(row[0].startswith("seconds") and row[1].startswith("40") for row in table_rows(summary))
    true_names, reported_names, counts = confusion(rows.values())
    assert true_names == ["steering_lag", "null"]
    assert (
        counts[0, reported_names.index("steering_lag")]
        == counts[0, reported_names.index("motor_lag")]
        == counts[1, reported_names.index("none")]
        == 1
    )
    draw_confusion(tmp_path / "confusion.png", rows.values())
    assert (tmp_path / "confusion.png").read_bytes()[:4] == b"\x89PNG"
    write_scores(tmp_path / "scores.json", rows, summary)
    assert json.loads((tmp_path / "scores.json").read_text())["summary"]["cases"] == 3


def test_seal_detects_any_change() -> None:
    answers = {"aa": answer(), "bb": answer("null")}
    nonce = secrets.token_hex(32)
    sealed = digest(answers, nonce)
    check(answers, nonce, sealed)
    changed = copy.deepcopy(answers)
    changed["aa"]["effects"][0]["parameters"]["time_constant"] += 1e-12
    for wrong, key in ((changed, nonce), (answers, secrets.token_hex(32)), ({"aa": answers["aa"]}, nonce)):
        with pytest.raises(DataError, match="seal is broken"):
            check(wrong, key, sealed)


def test_proof_is_sealed_resumed_diagnosed_and_scored(tmp_path: Path) -> None:
    root = tmp_path / "proof"
    progress_steps: list[tuple[str, int, int, str]] = []
    stops = iter([False, True])
    first = Proof(root, SPECS, command=FAKE_DIAGNOSIS, stop_requested=lambda: next(stops))
    assert first.make() is None
    answer_times = {p.name: p.stat().st_mtime_ns for p in (root / "answers").glob("*.json")}
    assert len(answer_times) == 2  # the plan and one answer
    with pytest.raises(DataError, match="Seal"):
        first.diagnose()
    resumed = Proof(root, SPECS, command=FAKE_DIAGNOSIS, progress=lambda *step: progress_steps.append(step))
    sealed = resumed.make()
    assert sealed is not None
    assert ("seal", 2, 2, sealed) in progress_steps
    assert all((root / "answers" / name).stat().st_mtime_ns == when for name, when in answer_times.items())

    stops = iter([False, True])
    assert not Proof(root, SPECS, command=FAKE_DIAGNOSIS, stop_requested=lambda: next(stops)).diagnose()
    run_times = {p: p.stat().st_mtime_ns for p in (root / "reports").glob("*/run.json")}
    assert len(run_times) == 1
    assert resumed.make() == sealed
    assert resumed.diagnose()
    assert resumed.diagnose(oracle=True)
    assert all(p.stat().st_mtime_ns == when for p, when in run_times.items())

    answers = resumed.open_seal()
    reports = resumed.reports()
    seen = [run["report"]["seen"] for run in reports.values()]
    assert all(s["files"] == ["car.toml", "fit.csv", "hold.csv", "out"] for s in seen)
    assert all(str(root) not in json.dumps(s) for s in seen)
    rows = score_cases(answers, reports, resumed.reports(oracle=True), resumed.same)
    by_kind = {row["kind"]: row for row in rows.values()}
    assert by_kind["single"]["strict_top1"]
    assert by_kind["single"]["oracle_ratio"] == pytest.approx(1.4 / 1.8)
    assert by_kind["null"]["false_alarm"]
    assert all(row["seconds"] > 0.0 for row in rows.values())

    with pytest.raises(DataError, match="other cases"):
        Proof(root, SPECS[:1], command=FAKE_DIAGNOSIS).make()
    handed = next((root / "handed").glob("*/fit.csv"))
    handed.write_bytes(handed.read_bytes() + b"\n")
    with pytest.raises(DataError, match="seal is broken"):
        resumed.open_seal()


def test_folder_with_other_files_is_refused(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("")
    with pytest.raises(DataError, match=r"contains other files \(thesis.tex\); name a new folder"):
        Proof(tmp_path, SPECS, command=FAKE_DIAGNOSIS).make()
    assert [p.name for p in tmp_path.iterdir()] == ["thesis.tex"]


def test_failed_or_hung_diagnosis_is_recorded(tmp_path: Path) -> None:
    root = tmp_path / "proof"
    proof = Proof(root, SPECS[1:], command=(sys.executable, "-c", "import sys; sys.exit('no such verb')"))
    proof.make()
    assert proof.diagnose()
    (run,) = proof.reports().values()
    assert run["report"] is None
    assert run["exit_status"] == 1
    assert "no such verb" in run["output"]
