"""Scores of the regression study, their summary over seeds, and their JSON."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch

from carlab.core.json_files import plain

FIGURES = ("nll", "rmse", "calibration", "seconds")


@dataclass(frozen=True, slots=True)
class Score:
    """Scores of one fit.

    Attributes:
        case, method, rows, seed: identify the fit.
        nll: mean joint negative log density of all outputs [nat].
        rmse: root of the squared error summed over outputs, in mixed units.
        calibration: mean absolute difference of empirical and nominal coverage.
        seconds: duration of the fit.
        nll_in_world: negative log density of the seven outputs that the authors score, for a real car [nat].
        failed: reason of a failed fit, whose figures are NaN; None for a successful fit.
    """

    case: str
    method: str
    rows: int
    seed: int
    nll: float
    rmse: float
    calibration: float
    seconds: float
    nll_in_world: float | None = None
    failed: str | None = None


def failed_score(case: str, method: str, rows: int, seed: int, reason: str) -> Score:
    """The score of a failed fit."""
    return Score(case, method, rows, seed, *(math.nan,) * 4, failed=reason)


@dataclass(frozen=True, slots=True)
class Row:
    """One method at one number of rows: means over the seeds, and their standard errors.

    Means are over the ``seeds`` successful fits, NaN without any; standard errors need at least two.
    """

    method: str
    rows: int
    seeds: int
    nll: float
    nll_standard_error: float
    rmse: float
    calibration: float
    seconds: float
    nll_in_world: float | None = None
    rmse_standard_error: float = math.nan
    calibration_standard_error: float = math.nan
    seconds_standard_error: float = math.nan
    failed: int = 0


def summarised(scores: Sequence[Score]) -> list[Row]:
    """One row for each method and number of rows, in the order of the fits."""
    groups: dict[tuple[int, str], list[Score]] = {}
    for score in scores:
        groups.setdefault((score.rows, score.method), []).append(score)
    rows = []
    for (count, method), group in groups.items():
        fitted = [s for s in group if s.failed is None]
        mean, error = {}, {}
        for name in FIGURES:
            values = np.array([getattr(s, name) for s in fitted])
            mean[name] = float(values.mean()) if fitted else math.nan
            error[f"{name}_standard_error"] = (
                float(values.std(ddof=1) / np.sqrt(len(fitted))) if len(fitted) > 1 else math.nan
            )
        world_nlls = [s.nll_in_world for s in fitted if s.nll_in_world is not None]
        in_world = float(np.mean(world_nlls)) if world_nlls else None
        failed = len(group) - len(fitted)
        rows.append(Row(method, count, len(fitted), nll_in_world=in_world, failed=failed, **mean, **error))
    return rows


def as_json(scores: Sequence[Score], command: str, device: str = "cpu") -> dict[str, object]:
    """All scores, their summary, the command of the study and the name of the device; null for a non-finite number."""
    return {
        "schema": "carlab.regression/1",
        "command": command,
        "device": device,
        "torch_threads": torch.get_num_threads(),
        "rows": [plain(asdict(row)) for row in summarised(scores)],
        "scores": [plain(asdict(score)) for score in scores],
    }


def scores_from_json(content: Mapping[str, Any]) -> list[Score]:
    """Read the scores of ``as_json``. Raises KeyError, TypeError or ValueError for other content."""
    rows: list[dict[str, Any]] = [
        {k: math.nan if v is None and k in FIGURES else v for k, v in row.items()} for row in content["scores"]
    ]
    return [Score(**row) for row in rows]
