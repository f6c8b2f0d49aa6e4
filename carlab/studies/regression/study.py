"""Learning from few rows: every method on a case, scored by likelihood, error and calibration on held-out rows."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from carlab.core.clock import MonotonicClock
from carlab.core.errors import ConfigError, DataError, first_line
from carlab.studies.regression.cases import CASES, Case, Data
from carlab.studies.regression.methods import METHODS, PAPER_METHODS, VARIANTS, FitTask
from carlab.studies.regression.scores import Score, failed_score
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


@dataclass(frozen=True, slots=True)
class Fit:
    """One fit of a study: number of rows, seed, and method."""

    rows: int
    seed: int
    method: str


@dataclass(frozen=True, slots=True)
class StudyPlan:
    """The fits of a study with their data.

    Attributes:
        fits: in the order of the study.
        variants: case of each method: in the world frame for the paper's methods, else in the body frame.
        data: by frame (``in_body_frame``), number of rows and seed.
    """

    fits: tuple[Fit, ...]
    variants: Mapping[str, Case]
    data: Mapping[tuple[bool, int, int], Data]

    def scored(self, fit: Fit, steps: int | None = None, device: str = "cpu") -> Score:
        """Run one fit and score it."""
        variant = self.variants[fit.method]
        data = self.data[variant.in_body_frame, fit.rows, fit.seed].to(device)
        return scored(variant, data, fit.rows, fit.seed, fit.method, steps=steps)


def plan_study(
    case: str | Case,
    *,
    rows: Sequence[int] = (),
    seeds: Sequence[int] = range(3),
    methods: Sequence[str] = (),
    structure: bool = False,
    data: Path | None = None,
) -> StudyPlan:
    """The fits of every method to every number of rows with every seed, and their data.

    Args:
        case: name in ``CASES``, or a case.
        rows: numbers of rows; by default those of the case.
        seeds: data and fit have the same seed.
        methods: names in ``METHODS`` or ``VARIANTS``; by default all of ``METHODS``.
        structure: every method knows the structured simulator of the case.
        data: folder of the authors' arrays; None: the study generates the data.

    Raises:
        ConfigError: an unknown case or method, no structured simulator, or too few rows for all methods.
        DataError: arrays are missing or have fewer rows.
    """
    if isinstance(case, str) and case not in CASES:
        raise ConfigError(f"There is no case '{case}'; choose {', '.join(CASES)}.")
    known = METHODS | VARIANTS
    if unknown := [m for m in methods if m not in known]:
        raise ConfigError(f"There is no method '{unknown[0]}'; choose among {', '.join(known)}.")
    chosen = CASES[case] if isinstance(case, str) else case
    if structure:
        chosen = chosen.structured()
    counts = tuple(rows) or chosen.counts
    names = tuple(methods) or tuple(METHODS)
    all_fits = itertools.starmap(Fit, itertools.product(counts, seeds, names))
    fits = tuple(fit for fit in all_fits if not (fit.method == "ridge" and fit.rows < MIN_RIDGE_ROWS))
    if not fits:
        raise ConfigError(f"Ridge regression needs {MIN_RIDGE_ROWS} rows or more; give --rows, or other methods.")
    variants = {name: chosen if name in PAPER_METHODS else chosen.body_frame or chosen for name in names}
    frames = {variant.in_body_frame: variant for variant in variants.values()}
    drawn = {
        (frame, count, seed): variant.data(count, seed) if data is None else variant.recorded(data, count, seed)
        for (frame, variant), count, seed in itertools.product(frames.items(), counts, seeds)
    }
    return StudyPlan(fits, variants, drawn)


def run_study(
    case: str | Case,
    *,
    rows: Sequence[int] = (),
    seeds: int = 3,
    first_seed: int = 0,
    methods: Sequence[str] = (),
    structure: bool = False,
    data: Path | None = None,
    steps: int | None = None,
    device: str = "cpu",
    progress: Progress = lambda what, done, total: None,
) -> Iterator[Score]:
    """Fit every method to every number of rows with every seed; yield each score after its fit.

    The score of a failed fit has the reason; the study continues. All data is read before the first fit, so that the
    study fails early if data is missing.

    Args:
        case: as for ``plan_study``.
        rows: as for ``plan_study``.
        seeds: number of seeds.
        first_seed: the smallest seed.
        methods: as for ``plan_study``.
        structure: as for ``plan_study``.
        data: as for ``plan_study``.
        steps: of the optimiser; by default those of the method.
        device: of fits and predictions; random numbers are drawn on the CPU. Ridge runs in NumPy.
        progress: called before each fit and at the end.

    Raises:
        ConfigError, DataError: as for ``plan_study``.
    """
    plan = plan_study(
        case, rows=rows, seeds=range(first_seed, first_seed + seeds), methods=methods, structure=structure, data=data
    )
    for done, fit in enumerate(plan.fits):
        progress(f"{fit.method}, {fit.rows} rows, seed {fit.seed}", done, len(plan.fits))
        yield plan.scored(fit, steps, device)
    progress("", len(plan.fits), len(plan.fits))


def scored(case: Case, data: Data, count: int, seed: int, method: str, *, steps: int | None = None) -> Score:
    """Fit one method to rows of a case and score it on the test rows; a failed fit gives its reason."""
    clock = MonotonicClock()
    began_s = clock.now_s()
    try:
        model = (METHODS | VARIANTS)[method](FitTask(case, data, seed, steps))
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
        return failed_score(case.name, method, count, seed, reason)
    if not all(map(math.isfinite, figures)):
        return failed_score(case.name, method, count, seed, "The prediction is not finite.")
    return Score(case.name, method, count, seed, *figures, seconds, in_world)


def _failure_reason(error: Exception) -> str | None:
    """Why a fit failed; None for a programming error, which ends the study."""
    is_failed_fit = isinstance(error, (DataError, np.linalg.LinAlgError)) or any(
        name in str(error).lower() for name in _LINEAR_ALGEBRA
    )
    return first_line(error) if is_failed_fit else None


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
