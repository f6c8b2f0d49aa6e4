"""Test targets of learning: held-out likelihood, calibration, and comparison with baselines."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest

from carlab.recording.csv.foreign import import_csv
from carlab.studies.regression.recordings import recorded_case
from carlab.studies.regression.scores import Score
from carlab.studies.regression.study import run_study

OURS = "gp-sim-posterior"
BASELINES = ("gp-posterior", "SysID")


def means(scores: Iterable[Score], figure: str = "nll") -> dict[tuple[str, int], float]:
    """Return means over seeds by method and number of rows."""
    found: dict[tuple[str, int], list[float]] = {}
    for score in scores:
        assert score.failed is None, score.failed
        found.setdefault((score.method, score.rows), []).append(float(getattr(score, figure)))
    return {key: float(np.mean(values)) for key, values in found.items()}


@pytest.mark.usefixtures("short_identification")
def test_simulator_posterior_beats_baselines_on_ten_pendulum_rows() -> None:
    """Drag, friction and motor lag are not in the prior."""
    nll = means(run_study("pendulum_motor", rows=(10,), seeds=1, methods=(OURS, *BASELINES), steps=400))
    assert nll[OURS, 10] < -5.7
    assert all(nll[OURS, 10] < nll[name, 10] - 1.0 for name in BASELINES), nll


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_simulator_posterior_beats_baselines_at_each_number_of_pendulum_rows() -> None:
    nll = means(run_study("pendulum_motor", seeds=3, methods=(OURS, *BASELINES, "ridge")))
    for count in (5, 10, 20, 50):
        others = {name: nll[name, count] for name in (*BASELINES, "ridge") if (name, count) in nll}
        assert nll[OURS, count] < min(others.values()), (count, nll[OURS, count], others)


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize(
    ("case", "limits"),
    [
        ("1d", {2: 0.0}),
        ("pendulum", {10: -5.7, 50: -6.9}),
        ("racecar", {20: -15.0, 100: -24.0, 400: -26.0}),
    ],
)
def test_nll_limits_on_the_authors_data(shared: Path, case: str, limits: dict[int, float]) -> None:
    folder = shared / "data" / "regression"
    nll = means(run_study(case, rows=tuple(limits), seeds=3, methods=(OURS,), data=folder))
    assert all(nll[OURS, count] <= limit for count, limit in limits.items()), nll


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize(("count", "limit"), [(50, -22.0), (200, -24.3), (800, -24.9)])
def test_nll_and_calibration_limits_on_a_real_car(shared: Path, count: int, limit: float) -> None:
    folder = shared / "data" / "eth_rc_car"
    recordings = [import_csv(folder / f"train_{k}.csv.gz").episodes for k in (1, 2)]
    case = recorded_case(recordings, Path("eth_rc_car"), history=6)
    scores = list(run_study(case, rows=(count,), seeds=3, methods=(OURS, "ridge"), data=folder, steps=4000))
    nll = means(scores)
    assert nll[OURS, count] <= limit
    assert nll[OURS, count] <= nll["ridge", count] - 2.0
    assert means(scores, "calibration")[OURS, count] <= 0.05
