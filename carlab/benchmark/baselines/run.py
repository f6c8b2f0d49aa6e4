"""Results of every baseline on one case: first named effect (no sets) and held-out score.

The baselines get the files of the diagnosis, the true noise floor and the generator's model. A correction that
increases the held-out score is discarded. The diagnosis has none of these advantages.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from importlib.util import find_spec
from typing import Any

from threadpoolctl import threadpool_limits

from carlab.benchmark.baselines.correlation import largest_correlation
from carlab.benchmark.baselines.data import Prepared, Table, prepare
from carlab.benchmark.baselines.gaussian_process import gp_score
from carlab.benchmark.baselines.regression import (
    MIN_SCORE_FALL,
    System,
    corrected_score,
    pysindy_regression,
    stepwise_bic,
)
from carlab.benchmark.world.base_car import BaseCar
from carlab.benchmark.world.simulation import FloatArray
from carlab.core.errors import ConfigError, DataError
from carlab.core.extras import install_hint

Outcome = tuple[str | None, float | None]
BASELINES = ("refit only", "PySINDy", "GP residual", "stepwise BIC", "cross-correlation")
NAMES_NOTHING = ("refit only", "GP residual")


def require_studies() -> None:
    """Raise ConfigError if the packages of the baselines are not installed."""
    missing = [name for name in ("pysindy", "sklearn") if find_spec(name) is None]
    if missing:
        raise ConfigError(
            f"The baselines need {' and '.join(missing)}; {install_hint('studies')}. Or leave the baselines out with "
            "--no-baselines."
        )


def run_baselines(fit: Table, hold: Table, nominal: BaseCar, floor: Mapping[str, float]) -> dict[str, Any]:
    """Run each baseline on one case.

    Args:
        fit: Columns of the recording to fit.
        hold: Columns of the held-out recording.
        nominal: The nominal car.
        floor: True noise floor of each of the six channels.

    Returns:
        By baseline ``named`` (an id or None), ``score`` (None where it has none), ``refit_score`` and ``seconds``; or
        ``failed`` with a sentence where the recording cannot be used.
    """
    with threadpool_limits(1):  # threads slow down small matrices
        try:
            data = prepare(fit, hold, nominal, floor)
            system = System.of(data)
        except (DataError, ValueError, ArithmeticError) as error:
            return {"failed": str(error) or type(error).__name__}
        results: dict[str, Any] = {}
        methods: dict[str, Callable[[], Outcome]] = {
            "refit only": lambda: (None, data.refit_score),
            "PySINDy": lambda: _regressed(data, system, pysindy_regression(system)),
            "GP residual": lambda: (None, min(gp_score(data), data.refit_score)),
            "stepwise BIC": lambda: _regressed(data, system, stepwise_bic(system)),
            "cross-correlation": lambda: (largest_correlation(data), None),
        }
        for name in BASELINES:
            begin = time.perf_counter()
            named, score = methods[name]()
            seconds = round(time.perf_counter() - begin, 3)
            results[name] = {"named": named, "score": score, "refit_score": data.refit_score, "seconds": seconds}
        return results


def _regressed(data: Prepared, system: System, coefficients: FloatArray) -> Outcome:
    """Named effect and score; no effect and the score of the refit if the score hardly falls."""
    score = corrected_score(data, system, coefficients)
    if score > (1.0 - MIN_SCORE_FALL) * data.refit_score:
        return None, data.refit_score
    return system.dominant(coefficients), score
