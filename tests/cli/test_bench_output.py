"""Files of ``carlab bench``: each score is saved as soon as it is measured, whatever fails later."""

from __future__ import annotations

import errno
import json
import math
import os
import shlex
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from carlab.cli import run
from carlab.cli.bench_output import command
from carlab.core.errors import DataError
from carlab.recording.atomic_files import write_json
from carlab.studies.regression.methods import METHODS
from carlab.studies.regression.scores import FIGURES, Score, as_json, summarised
from carlab.studies.regression.study import run_study
from learning.evaluation import Mixture
from tests.helpers.command_line import Carlab

SMALL = ("bench", "regression", "--case", "pendulum", "--rows", 5, "--methods", "ridge", "SysID")
RIDGE = METHODS["ridge"]


def read_strict_json(path: Path) -> dict[str, Any]:
    """Content of a JSON file; fails on NaN, which the JSON standard does not have."""

    def fail(constant: str) -> None:
        pytest.fail(f"{constant} is not JSON")

    content: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"), parse_constant=fail)
    return content


def replace_sysid(monkeypatch: pytest.MonkeyPatch, method: Callable[[Any], Any]) -> None:
    monkeypatch.setitem(METHODS, "SysID", method)


def test_command_of_a_study_names_the_same_files_in_a_shell(monkeypatch: pytest.MonkeyPatch) -> None:
    words = ["bench", "speed", "--out", "my figures/speed.json"]
    monkeypatch.setattr(sys, "argv", ["/usr/bin/carlab", *words])
    assert shlex.split(command()) == ["carlab", *words]


def test_failed_fit_is_reported_and_the_study_continues(
    carlab: Carlab, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails_for_seed_1(task: Any) -> Any:
        if task.seed == 1:
            raise DataError("The simulator gives no finite outputs for this data; check the car file and the rows.")
        return RIDGE(task)

    replace_sysid(monkeypatch, fails_for_seed_1)
    out = tmp_path / "study.json"
    code, text = carlab(*SMALL, "--seeds", 3, "--out", out)
    assert code == 1
    assert "SysID, 5 rows, seed 1 failed: The simulator gives no finite outputs for this data" in text
    assert "SysID, 1 of 3 failed" in text
    figures = read_strict_json(out)
    assert [(s["method"], s["seed"], s["failed"] is None) for s in figures["scores"]] == [
        ("ridge", 0, True), ("SysID", 0, True), ("ridge", 1, True), ("SysID", 1, False), ("ridge", 2, True),
        ("SysID", 2, True),
    ]  # fmt: skip
    assert figures["scores"][3]["nll"] is None
    ridge, sysid = figures["rows"]
    assert (ridge["seeds"], ridge["failed"], sysid["seeds"], sysid["failed"]) == (3, 0, 2, 1)
    sysid_nlls = [figures["scores"][k]["nll"] for k in (1, 5)]
    assert sysid["nll"] == pytest.approx(np.mean(sysid_nlls))
    assert sysid["nll_standard_error"] == pytest.approx(np.std(sysid_nlls, ddof=1) / math.sqrt(2.0))
    assert out.with_suffix(".png").stat().st_size > 10_000


def test_row_reports_that_every_fit_failed(carlab: Carlab, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def always_fails(task: Any) -> Any:
        raise DataError("The parameters cannot be identified.")

    replace_sysid(monkeypatch, always_fails)
    out = tmp_path / "study.json"
    code, text = carlab(*SMALL[:-2], "SysID", "--seeds", 2, "--out", out)
    assert code == 1
    assert "SysID, 2 of 2 failed" in text
    (row,) = read_strict_json(out)["rows"]
    assert (row["seeds"], row["failed"], row["nll"], row["seconds_standard_error"]) == (0, 2, None, None)
    assert not out.with_suffix(".png").exists()


def failing_cholesky(task: Any) -> Any:
    return torch.linalg.cholesky(-torch.eye(3))


def singular_inverse(task: Any) -> Any:
    return np.linalg.inv(np.zeros((2, 2)))


def failing_cusolver(task: Any) -> Any:
    raise RuntimeError("cusolver error: CUSOLVER_STATUS_EXECUTION_FAILED, when calling `cusolverDnSpotrf`\nmore of it")


def predicts_nan(task: Any) -> Any:
    class NanModel:
        def predict(self, inputs: torch.Tensor) -> Mixture:
            nan_mean = torch.full((1, len(inputs), 3), math.nan)
            return Mixture(nan_mean, torch.ones(1, 1, 3))

    return NanModel()


@pytest.mark.parametrize(
    ("method", "message"),
    [
        (failing_cholesky, "linalg.cholesky"),
        (singular_inverse, "Singular matrix"),
        (failing_cusolver, "cusolver error"),
        (predicts_nan, "finite"),
    ],
)
def test_numerical_error_fails_only_its_own_fit(
    monkeypatch: pytest.MonkeyPatch, method: Callable[[Any], Any], message: str
) -> None:
    replace_sysid(monkeypatch, method)
    sysid, ridge = run_study("pendulum", rows=(5,), seeds=1, methods=("SysID", "ridge"))
    assert message in str(sysid.failed)
    assert "\n" not in str(sysid.failed)
    assert math.isnan(sysid.nll)
    assert ridge.failed is None
    assert math.isfinite(ridge.nll)


def test_programming_error_ends_the_study_and_keeps_the_scores(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def shape_error(task: Any) -> Any:
        return torch.ones(2) @ torch.ones(3)

    replace_sysid(monkeypatch, shape_error)
    out = tmp_path / "study.json"
    with pytest.raises(RuntimeError, match="size"):
        run([str(word) for word in (*SMALL, "--seeds", 1, "--out", out)])
    assert [s["method"] for s in read_strict_json(out)["scores"]] == ["ridge"]


def test_file_holds_all_earlier_scores_during_a_fit(
    carlab: Carlab, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, saved_scores = tmp_path / "study.json", []

    def read_file_and_fit(task: Any) -> Any:
        saved_scores.append([(s["method"], s["seed"]) for s in read_strict_json(out)["scores"]])
        if task.seed == 1:
            signal.raise_signal(signal.SIGINT)
        return RIDGE(task)

    replace_sysid(monkeypatch, read_file_and_fit)
    code, text = carlab(*SMALL, "--seeds", 5, "--out", out)
    assert code == 130
    assert "interrupted" in text
    assert saved_scores == [[("ridge", 0)], [("ridge", 0), ("SysID", 0), ("ridge", 1)]]
    assert len(read_strict_json(out)["scores"]) == 4
    assert out.with_suffix(".png").is_file()


def test_file_is_unchanged_if_it_cannot_be_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / "study.json"
    write_json(out, {"scores": [1]})
    assert read_strict_json(out) == {"scores": [1]}

    def fail_with_full_disk(descriptor: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr("os.fsync", fail_with_full_disk)
    with pytest.raises(DataError, match=r"study\.json could not be written because the disk is full"):
        write_json(out, {"scores": [1, 2]})
    assert read_strict_json(out) == {"scores": [1]}
    assert [path.name for path in tmp_path.iterdir()] == ["study.json"]


def test_every_figure_has_its_standard_error() -> None:
    values = np.array([[1.0, 0.5, 0.02, 3.0], [4.0, 0.7, 0.05, 9.0], [5.0, 0.1, 0.01, 1.0]])
    scores = [Score("1d", "ridge", 5, k, *map(float, values[k])) for k in range(3)]
    (row,) = summarised(scores)
    for k, name in enumerate(FIGURES):
        assert getattr(row, name) == pytest.approx(values[:, k].mean())
        expected = values[:, k].std(ddof=1) / math.sqrt(3.0)
        assert getattr(row, f"{name}_standard_error") == pytest.approx(expected)
    figures: Any = as_json(scores[:1], "carlab bench regression")
    assert figures["rows"][0]["rmse_standard_error"] is None, "a single fit has no standard error"
