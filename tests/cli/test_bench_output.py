"""What ``carlab bench`` keeps of a study: every figure as soon as it is measured, whatever fails later."""

from __future__ import annotations

import errno
import json
import math
import os
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from carlab.cli import run
from carlab.cli.bench_output import write_figures
from carlab.core.errors import DataError
from carlab.studies.regression.methods import METHODS
from carlab.studies.regression.scores import FIGURES, Score, as_json, summarised
from carlab.studies.regression.study import run_study
from learning.evaluation import Mixture

Carlab = Callable[..., tuple[int, str]]
FEW = ("bench", "regression", "--case", "pendulum", "--rows", 5, "--methods", "ridge", "SysID")
RIDGE = METHODS["ridge"]


def strict(path: Path) -> dict[str, Any]:
    """The content of a file, which is JSON for every reader: NaN is none of it."""

    def refused(word: str) -> None:
        pytest.fail(f"{word} is no JSON")

    found: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"), parse_constant=refused)
    return found


def stand_in(monkeypatch: pytest.MonkeyPatch, instead: Callable[[Any], Any]) -> None:
    monkeypatch.setitem(METHODS, "SysID", instead)


def test_a_failed_fit_is_reported_and_the_study_goes_on(
    carlab: Carlab, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def sometimes(task: Any) -> Any:
        if task.seed == 1:
            raise DataError("The simulator gives no finite outputs for this data; check the car file and the rows.")
        return RIDGE(task)

    stand_in(monkeypatch, sometimes)
    out = tmp_path / "study.json"
    code, text = carlab(*FEW, "--seeds", 3, "--out", out)
    assert code == 1
    assert "SysID, 5 rows, seed 1 failed: The simulator gives no finite outputs for this data" in text
    assert "SysID, 1 of 3 failed" in text
    figures = strict(out)
    assert [(s["method"], s["seed"], s["failed"] is None) for s in figures["scores"]] == [
        ("ridge", 0, True), ("SysID", 0, True), ("ridge", 1, True), ("SysID", 1, False), ("ridge", 2, True),
        ("SysID", 2, True),
    ]  # fmt: skip
    assert figures["scores"][3]["nll"] is None
    ridge, identified = figures["rows"]
    assert (ridge["seeds"], ridge["failed"], identified["seeds"], identified["failed"]) == (3, 0, 2, 1)
    own = [figures["scores"][k]["nll"] for k in (1, 5)]
    assert identified["nll"] == pytest.approx(np.mean(own))
    assert identified["nll_standard_error"] == pytest.approx(np.std(own, ddof=1) / math.sqrt(2.0))
    assert out.with_suffix(".png").stat().st_size > 10_000


def test_where_every_fit_fails_the_row_says_so(carlab: Carlab, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def never(task: Any) -> Any:
        raise DataError("There is nothing to be identified.")

    stand_in(monkeypatch, never)
    out = tmp_path / "study.json"
    code, text = carlab(*FEW[:-2], "SysID", "--seeds", 2, "--out", out)
    assert code == 1
    assert "SysID, 2 of 2 failed" in text
    (row,) = strict(out)["rows"]
    assert (row["seeds"], row["failed"], row["nll"], row["seconds_standard_error"]) == (0, 2, None, None)
    assert not out.with_suffix(".png").exists()


def cholesky(task: Any) -> Any:
    return torch.linalg.cholesky(-torch.eye(3))


def numpys(task: Any) -> Any:
    return np.linalg.inv(np.zeros((2, 2)))


def on_a_device(task: Any) -> Any:
    raise RuntimeError("cusolver error: CUSOLVER_STATUS_EXECUTION_FAILED, when calling `cusolverDnSpotrf`\nmore of it")


def blind(task: Any) -> Any:
    class Nothing:
        def predict(self, inputs: torch.Tensor) -> Mixture:
            nowhere = torch.full((1, len(inputs), 3), math.nan)
            return Mixture(nowhere, torch.ones(1, 1, 3))

    return Nothing()


@pytest.mark.parametrize(
    ("instead", "words"),
    [(cholesky, "linalg.cholesky"), (numpys, "Singular matrix"), (on_a_device, "cusolver error"), (blind, "finite")],
)
def test_matrices_that_cannot_be_factored_fail_one_fit(
    monkeypatch: pytest.MonkeyPatch, instead: Callable[[Any], Any], words: str
) -> None:
    stand_in(monkeypatch, instead)
    broken, whole = run_study("pendulum", rows=(5,), seeds=1, methods=("SysID", "ridge"))
    assert words in str(broken.failed)
    assert "\n" not in str(broken.failed)
    assert math.isnan(broken.nll)
    assert whole.failed is None
    assert math.isfinite(whole.nll)


def test_an_error_of_the_program_ends_the_study_and_keeps_what_was_measured(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def wrong(task: Any) -> Any:
        return torch.ones(2) @ torch.ones(3)

    stand_in(monkeypatch, wrong)
    out = tmp_path / "study.json"
    with pytest.raises(RuntimeError, match="size"):
        run([str(word) for word in (*FEW, "--seeds", 1, "--out", out)])
    assert [s["method"] for s in strict(out)["scores"]] == ["ridge"]


def test_the_file_holds_all_scores_so_far_while_the_next_one_is_fitted(
    carlab: Carlab, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, seen = tmp_path / "study.json", []

    def watched(task: Any) -> Any:
        seen.append([(s["method"], s["seed"]) for s in strict(out)["scores"]])
        if task.seed == 1:
            signal.raise_signal(signal.SIGINT)
        return RIDGE(task)

    stand_in(monkeypatch, watched)
    code, text = carlab(*FEW, "--seeds", 5, "--out", out)
    assert code == 130
    assert "interrupted" in text
    assert seen == [[("ridge", 0)], [("ridge", 0), ("SysID", 0), ("ridge", 1)]]
    assert len(strict(out)["scores"]) == 4
    assert out.with_suffix(".png").is_file()


def test_a_file_is_written_whole_or_stays_as_it_was(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / "study.json"
    write_figures(out, {"scores": [1]})
    assert strict(out) == {"scores": [1]}

    def full(number: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(DataError, match=r"study\.json could not be written because the disk is full"):
        write_figures(out, {"scores": [1, 2]})
    assert strict(out) == {"scores": [1]}
    assert [path.name for path in tmp_path.iterdir()] == ["study.json"]


def test_standard_errors_are_of_every_figure() -> None:
    values = np.array([[1.0, 0.5, 0.02, 3.0], [4.0, 0.7, 0.05, 9.0], [5.0, 0.1, 0.01, 1.0]])
    scores = [Score("1d", "ridge", 5, k, *map(float, values[k])) for k in range(3)]
    (row,) = summarised(scores)
    for k, name in enumerate(FIGURES):
        assert getattr(row, name) == pytest.approx(values[:, k].mean())
        spread = values[:, k].std(ddof=1) / math.sqrt(3.0)
        assert getattr(row, f"{name}_standard_error") == pytest.approx(spread)
    figures: Any = as_json(scores[:1], "carlab bench regression")
    assert figures["rows"][0]["rmse_standard_error"] is None, "a single fit has no standard error"
