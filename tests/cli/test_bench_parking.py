"""``carlab bench parking`` from the command line: driving, resuming, output and refusals."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from carlab.cli import run

SMALL = ["--methods", "gp-sim-posterior", "fsvgd", "--updates", "40", "--steps", "50", "--seeds", "1"]


def test_two_methods_are_driven_resumed_and_compared(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out, runs = tmp_path / "parking.json", tmp_path / "runs"
    arguments = ["bench", "parking", *SMALL, "--runs", str(runs), "--out", str(out)]
    assert run([*arguments, "--episodes", "1"]) == 0
    first_mtimes = {p.name: (p / "models" / "0001" / "dynamics.pt").stat().st_mtime_ns for p in runs.iterdir()}
    assert len(first_mtimes) == 2
    study = json.loads(out.read_text())
    assert [(r["method"], r["seeds"], r["episodes"]) for r in study["methods"]] == [
        ("gp-sim-posterior", 1, 1),
        ("fsvgd", 1, 1),
    ]
    assert study["command"].startswith("carlab")
    assert out.with_suffix(".png").stat().st_size > 10_000
    capsys.readouterr()
    assert run([*arguments, "--episodes", "1"]) == 0, "the study is complete"
    second_mtimes = {p.name: (p / "models" / "0001" / "dynamics.pt").stat().st_mtime_ns for p in runs.iterdir()}
    assert second_mtimes == first_mtimes
    assert "never" in capsys.readouterr().out, "40 updates do not suffice to park"
    before = out.read_bytes()
    changed = ["bench", "parking", *SMALL[:3], "--seeds", "1", "--runs", str(runs), "--out", str(out)]
    assert run([*changed, "--updates", "40", "--steps", "60"]) == 2
    assert "was started with --steps 50" in " ".join(capsys.readouterr().err.split())
    assert run([*changed, "--steps", "50"]) == 2
    assert "was started with --updates 40" in " ".join(capsys.readouterr().err.split())
    assert out.read_bytes() == before


def test_unknown_method_is_reported(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["bench", "parking", "--methods", "ridge", "--runs", str(tmp_path / "runs")]) == 2
    assert "There is no method 'ridge'" in capsys.readouterr().err
    assert not (tmp_path / "runs").exists()
