"""Test that calibration repeats recorded decisions at other thresholds and counts false and missed names."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import pytest

from carlab.benchmark.cases.proof_set import CaseSpec
from carlab.benchmark.proof.calibration import calibrate, passes
from carlab.benchmark.proof.runner import Proof
from carlab.cli import run

CHI2, SHARE = "selection.accept_chi2_min", "selection.accept_left_out_share"


def decision(stage: str, effect: str, chi2: float, share: float = 1.0, step: int = 0) -> dict[str, Any]:
    conditions = [
        {"setting": CHI2, "statistic": chi2, "threshold": 20.0, "above": True},
        {"setting": SHARE, "statistic": share, "threshold": 0.5, "above": True},
    ]
    passed = chi2 > 20.0 and share > 0.5
    return {"stage": stage, "effect": effect, "step": step, "passed": passed, "alternatives": [conditions]}


def content(*decisions: dict[str, Any]) -> dict[str, Any]:
    return {"schema": "carlab.decisions/1", "decisions": list(decisions)}


ANSWERS: dict[str, Any] = {"a": {"effects": [{"id": "steering_lag"}]}, "b": {"effects": []}}
DECISIONS = {
    "a": content(decision("accept", "steering_lag", 35.0), decision("accept", "steering_delay", 33.0)),
    "b": content(decision("accept", "motor_lag", 12.0)),
}


def test_lower_threshold_accepts_wrong_names_and_a_higher_one_misses_concealed_names() -> None:
    counts = {r.value / 20.0: dataclasses.astuple(r)[3:] for r in calibrate(ANSWERS, DECISIONS) if r.setting == CHI2}
    assert counts[0.5] == (1, 2, 0, 1), "a name in the null case"
    assert counts[1.0] == (0, 2, 0, 1)
    assert counts[1.5] == (0, 2, 0, 1), "only the first candidate that passes is accepted"
    assert counts[2.0] == (0, 2, 1, 1), "no candidate passes"
    assert [r.is_present_value for r in calibrate(ANSWERS, DECISIONS) if r.value == 20.0] == [True]


def test_names_that_a_wrong_base_model_implies_are_not_false() -> None:
    answers = {"a": {"effects": [{"id": "steering_lag"}], "implied_effects": ["tyre_saturation"]}}
    made = {
        "a": content(*(decision("accept", name, 35.0, step=k) for k, name in enumerate(("tyre_saturation", "drag"))))
    }
    (present,) = (r for r in calibrate(answers, made) if r.setting == CHI2 and r.is_present_value)
    assert (present.false_names, present.false_opportunities) == (1, 1)


def test_settings_have_their_present_names_in_decisions_of_earlier_versions() -> None:
    former = json.loads(json.dumps(DECISIONS).replace(SHARE, "selection.accept_unseen_share"))
    assert calibrate(ANSWERS, former) == calibrate(ANSWERS, DECISIONS)


def test_decisions_of_the_keep_stage_are_counted_separately() -> None:
    kept = {"a": content(decision("keep", "steering_lag", 25.0), decision("keep", "motor_lag", 25.0))}
    by_value = {r.value / 20.0: (r.false_names, r.missed_names) for r in calibrate(ANSWERS, kept) if r.setting == CHI2}
    assert by_value[1.0] == (1, 0)
    assert by_value[1.5] == (0, 1)


def test_one_alternative_is_sufficient_and_conditions_may_be_upper_bounds() -> None:
    below = [{"setting": "rivals.spurious_share", "statistic": 0.2, "threshold": 0.1, "above": False}]
    made = decision("confirm", "steering_lag", 10.0)
    made["alternatives"].append(below)
    assert not passes(made, CHI2, 20.0)
    assert passes(made, CHI2, 5.0)
    assert passes(made, "rivals.spurious_share", 0.3)


def test_folder_without_decisions_raises_an_error(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert run(["prove", "--set", "development", "--calibrate", "--out", str(tmp_path / "proof")]) == 2
    assert "run the same command without --calibrate" in " ".join(capfd.readouterr().err.split())


@pytest.mark.parametrize("name", ["short", "full", "hard", "development", "hard-development"])
def test_rates_of_a_test_set_have_a_warning(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    (tmp_path / "seal.json").touch()
    monkeypatch.setattr(Proof, "decisions", lambda proof: DECISIONS)
    monkeypatch.setattr(Proof, "open_seal", lambda proof: ANSWERS)
    assert run(["prove", "--set", name, "--calibrate", "--out", str(tmp_path)]) == 0
    warning = f"--set {name} is a test set: thresholds must not be chosen on its rates."
    assert (warning in capsys.readouterr().out) == ("development" not in name)


def test_decisions_of_finished_runs_are_read_with_the_names_of_their_cases(tmp_path: Path) -> None:
    proof = Proof(tmp_path, [CaseSpec("null", 1)])
    for name, made in DECISIONS.items():
        (tmp_path / "reports" / name).mkdir(parents=True)
        (tmp_path / "reports" / name / "decisions.json").write_text(json.dumps(made))
    assert proof.decisions() == DECISIONS
