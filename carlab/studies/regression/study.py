"""Learning from few rows: every method on a case, scored by likelihood, error and calibration on held-out rows."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np

from carlab.core.clock import MonotonicClock
from carlab.core.errors import ConfigError, DataError
from carlab.studies.regression.cases import CASES, Case, Data
from carlab.studies.regression.methods import METHODS, PAPER_METHODS, FitTask
from carlab.studies.regression.scores import Score
from learning.evaluation import (
    Mixture,
    Prediction,
    WeightedMixture,
    calibration_error,
    negative_log_likelihood,
    root_mean_square_error,
)
from learning.world.world_outputs import measured_seven_outputs, seven_outputs

Progress = Callable[[str, int, int], None]
"""Called with the name of the fit, the number of completed fits and the total number."""
MIN_RIDGE_ROWS = 3
_LINEAR_ALGEBRA = ("linalg", "lapack", "cusolver", "magma")
"""Words that identify RuntimeErrors of torch's linear algebra and its libraries."""


def run_study(
    case: str | Case,
    *,
    rows: Sequence[int] = (),
    seeds: int = 3,
    methods: Sequence[str] = (),
    structure: bool = False,
    data: Path | None = None,
    steps: int | None = None,
    device: str = "cpu",
    progress: Progress = lambda what, done, total: None,
) -> Iterator[Score]:
    """Fit every method to every number of rows with every seed; yield each score after its fit.

    The score of a failed fit has the reason; the study continues.

    Args:
        case: name in ``CASES``, or a case.
        rows: numbers of rows; by default those of the case.
        seeds: number of seeds; data and fit have the same seed.
        methods: names in ``METHODS``; by default all.
        structure: every method knows the structured simulator of the case.
        data: folder of the authors' arrays; None: the study generates the data.
        steps: of the optimiser; by default those of the method.
        device: of fits and predictions; random numbers are drawn on the CPU. Ridge runs in NumPy.
        progress: called before each fit and at the end.

    Raises:
        ConfigError: an unknown case or method, no structured simulator, or too few rows for all methods.
        DataError: arrays are missing or have fewer rows (raised before the first fit).
    """
    if isinstance(case, str) and case not in CASES:
        raise ConfigError(f"There is no case '{case}'; choose {', '.join(CASES)}.")
    if unknown := [m for m in methods if m not in METHODS]:
        raise ConfigError(f"There is no method '{unknown[0]}'; choose among {', '.join(METHODS)}.")
    chosen = CASES[case] if isinstance(case, str) else case
    if structure:
        chosen = chosen.structured()
    counts = tuple(rows) or chosen.counts
    names = tuple(methods) or tuple(METHODS)
    all_fits = itertools.product(counts, range(seeds), names)
    plan = [fit for fit in all_fits if not (fit[2] == "ridge" and fit[0] < MIN_RIDGE_ROWS)]
    if not plan:
        raise ConfigError(f"Ridge regression needs {MIN_RIDGE_ROWS} rows or more; give --rows, or other methods.")
    # All data is read before the first fit, so that the study fails early if data is missing.
    variants = {name: chosen if name in PAPER_METHODS else chosen.body_frame or chosen for name in names}
    frames = {variant.in_body_frame: variant for variant in variants.values()}
    drawn = {
        (frame, count, seed): variant.data(count, seed) if data is None else variant.recorded(data, count, seed)
        for (frame, variant), count, seed in itertools.product(frames.items(), counts, range(seeds))
    }
    for done, (count, seed, name) in enumerate(plan):
        progress(f"{name}, {count} rows, seed {seed}", done, len(plan))
        variant = variants[name]
        rows_of_fit = drawn[variant.in_body_frame, count, seed].to(device)
        yield scored(variant, rows_of_fit, count, seed, name, steps=steps)
    progress("", len(plan), len(plan))


def scored(case: Case, data: Data, count: int, seed: int, method: str, *, steps: int | None = None) -> Score:
    """Fit one method of ``METHODS`` to rows of a case and score it on the test rows; a failed fit gives its reason."""
    clock = MonotonicClock()
    began_s = clock.now_s()
    try:
        model = METHODS[method](FitTask(case, data, seed, steps))
        seconds = clock.now_s() - began_s
        prediction = model.predict(data.test_inputs)
        figures = (
            negative_log_likelihood(prediction, data.test_outputs),
            root_mean_square_error(prediction, data.test_outputs),
            calibration_error(prediction, data.test_outputs),
        )
        in_world = _nll_in_world(prediction, data)
    except (DataError, RuntimeError, np.linalg.LinAlgError) as error:
        if (reason := _failure_reason(error)) is None:
            raise
        return _failed(case, method, count, seed, reason)
    if not all(map(math.isfinite, figures)):
        return _failed(case, method, count, seed, "The prediction is not finite.")
    return Score(case.name, method, count, seed, *figures, seconds, in_world)


def _failed(case: Case, method: str, count: int, seed: int, reason: str) -> Score:
    return Score(case.name, method, count, seed, *(math.nan,) * 4, failed=reason)


def _failure_reason(error: Exception) -> str | None:
    """Why a fit failed; None for a programming error, which ends the study."""
    reason = next(iter(str(error).splitlines()), "") or type(error).__name__
    if isinstance(error, (DataError, np.linalg.LinAlgError)):
        return reason
    return reason if any(name in str(error).lower() for name in _LINEAR_ALGEBRA) else None


def _nll_in_world(prediction: Prediction, data: Data) -> float | None:
    if data.test_yaw is None:
        return None
    start = (data.test_inputs[:, :2], data.test_yaw)
    measured = measured_seven_outputs(data.test_outputs, *start)

    def in_world(part: Prediction) -> Prediction:
        if isinstance(part, WeightedMixture):
            return WeightedMixture([in_world(p) for p in part.predictions], part.weights)
        assert isinstance(part, Mixture)
        return seven_outputs(part, *start)

    return negative_log_likelihood(in_world(prediction), measured)


__all__ = ["Progress", "run_study", "scored"]
