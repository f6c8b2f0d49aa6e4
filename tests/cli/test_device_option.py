"""``--device``: refused in one sentence if the device does not exist, and written to the figures."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from carlab.studies.regression.study import run_study
from tests.helpers.command_line import Carlab


@pytest.mark.parametrize("verb", [("learn",), ("bench", "speed"), ("bench", "regression")])
def test_missing_cuda_device_is_refused(
    carlab: Carlab, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, verb: tuple[str, ...]
) -> None:
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    monkeypatch.chdir(tmp_path)
    code, text = carlab(*verb, "--device", "cuda")
    assert code == 2
    assert "--device cuda: torch finds no CUDA device here" in text
    assert "use --device cpu" in text
    assert list(tmp_path.iterdir()) == []
    code, text = carlab(*verb, "--device", "abacus")
    assert code == 2
    assert "invalid choice 'abacus'" in text


@pytest.mark.parametrize(("options", "device_text"), [((), "cpu"), (("--device", "cuda"), "cuda: Imaginary 9000")])
def test_figures_name_their_device(
    carlab: Carlab, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, options: tuple[str, ...], device_text: str
) -> None:
    requested: list[str] = []
    run_on_cpu = run_study

    def log_device_and_run(case: str, *, device: str, **others: object) -> object:
        requested.append(device)
        return run_on_cpu(case, **others)

    monkeypatch.setattr("torch.cuda.is_available", lambda: True)
    monkeypatch.setattr("torch.cuda.get_device_name", lambda: "Imaginary 9000")
    monkeypatch.setattr("carlab.cli.bench_regression.run_study", log_device_and_run)
    out = tmp_path / "study.json"
    small = ("--case", "pendulum", "--rows", 5, "--seeds", 1, "--methods", "ridge")
    code, _ = carlab("bench", "regression", *small, "--out", out, *options)
    assert code == 0
    assert json.loads(out.read_text())["device"] == device_text
    assert requested == [device_text.split(":")[0]]
