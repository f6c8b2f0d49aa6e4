"""The study on a public simulator diagnoses with the interpreter that runs it; needs no simulator package."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from carlab.benchmark.public_simulators import study as module
from carlab.jobs.child_jobs import PYTHON


def test_diagnosis_does_not_need_python_on_the_path(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    def write_inputs(car: Any, seed: int, folder: Path, *more: Any) -> None:
        folder.mkdir(parents=True)
        for file in module.FILES:
            (folder / file).write_text(f"content of {file}")
        (folder / "report.html").write_text("of an earlier run")

    monkeypatch.setattr(module, "write_inputs", write_inputs)
    monkeypatch.setattr(module, "PublicCar", lambda model: SimpleNamespace(model=model))
    monkeypatch.setattr(module, "activity", lambda car, drive: {})
    monkeypatch.setattr(module, "version", lambda package: "0")
    monkeypatch.setenv("PATH", str(tmp_path))
    assert module.DIAGNOSE[0] == PYTHON
    script = (
        "import pathlib; pathlib.Path('out').mkdir(); pathlib.Path('out', 'model.toml').write_text('fitted'); "
        "print(pathlib.Path('car.toml').read_text())"
    )
    (row,) = module.study(tmp_path / "study", "drift", [3], command=(PYTHON, "-c", script))
    assert (row["exit_status"], row["output"].strip()) == (0, "content of car.toml")
    assert (tmp_path / "study" / "seed_3" / "model.toml").read_text() == "fitted"
    assert not (tmp_path / "study" / "seed_3" / "report.html").exists()
