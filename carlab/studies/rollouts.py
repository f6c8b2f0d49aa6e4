"""Calibration of predicted rollouts of a learned car on a held-out recording.

Each car is fitted to a number of random rows of the recordings to fit, or to all rows: then its particles are also
fitted to rollouts over all windows (``learning.world.rollout_fit``), and its prior simulator may have measured curves,
which are fitted to the same recordings (``curve_prior``). A car's disturbance is estimated from the errors over windows
of blocks that the car was not fitted to (cross-validation). Two kinds of rollouts are compared: steps with independent
particles and noise, and one particle with a disturbance for each rollout.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np
import torch

from carlab.core.episode_data import EpisodeData
from carlab.core.errors import ConfigError, DataError
from carlab.core.quantities import FloatArray
from carlab.prediction.errors import prediction_errors
from carlab.prediction.learned import LearnedModel, drive_windows, recorded_windows
from carlab.prediction.windows import PredictionWindows
from carlab.studies.curve_prior import unbroken_parts, with_curves
from carlab.studies.regression.cases import Data
from carlab.studies.regression.methods import FitTask
from carlab.studies.regression.recordings import RecordedCase
from carlab.studies.regression.study import Progress
from learning.evaluation import negative_log_likelihood
from learning.rollouts import RolloutModel
from learning.transitions import Transitions
from learning.world.car_dynamics import CarDynamics
from learning.world.disturbance import DisturbedCar
from learning.world.disturbance_fit import MAX_WINDOWS, RolloutErrors, fit_disturbance, pooled, rollout_errors
from learning.world.rollout_fit import fit_rollouts
from sim_backends.car_parameters import SimulatorConfig

ALL_ROWS: Literal["all"] = "all"
Rows = int | Literal["all"]
"""Number of random rows of a fit, or all rows."""
COUNTS: tuple[Rows, ...] = (200, 800, ALL_ROWS)
ONE_STEP_ROWS = 800
"""Random rows of the one-step posterior from which a fit to all rows starts."""
HORIZONS_S = (0.3, 0.5, 1.0)
STRIDE_S, FIT_STRIDE_S = 0.2, 0.1
"""Time between the starts of windows for scores and disturbances, and for the fit to rollouts."""
N_FOLDS, BLOCK_S = 3, 20.0
"""Folds of the cross-validation, and length of the blocks that are assigned to them in turn [s]."""
N_SAMPLES = 200
LEVEL = 0.9
"""Nominal coverage of the bands."""
INDEPENDENT, DISTURBED = "independent steps", "one particle, disturbance"


@dataclass(frozen=True, slots=True)
class RolloutScore:
    """Errors and coverage of one model after one horizon.

    Attributes:
        model: kind of rollouts.
        rows, seed: number of rows of the fit, and the seed of rows, fit and samples.
        horizon_s: horizon [s].
        coverage: share of windows within the nominal 90 % band, for x ahead, y left, yaw, vx, vy and yaw rate.
        band: mean width of the bands in the same order [m, m, rad, m/s, m/s, rad/s].
        position_rms_m: root mean square distance of the mean of the paths [m].
        yaw_rms_rad: root mean square error of its yaw [rad].
        energy_m: mean energy score of the position (Gneiting and Raftery 2007, section 4.3) [m]; less is better.
        nll: negative log-likelihood of the one-step predictions [nat per step].
        windows: number of windows.
        all_rows: whether the fit has all rows and rollouts; otherwise its rows are random and its likelihood is that of
            one step.
    """

    model: str
    rows: int
    seed: int
    horizon_s: float
    coverage: tuple[float, ...]
    band: tuple[float, ...]
    position_rms_m: float
    yaw_rms_rad: float
    energy_m: float
    nll: float
    windows: int
    all_rows: bool = False


@dataclass(frozen=True, slots=True)
class FitSettings:
    """Settings of the fit of a car.

    Attributes:
        steps: of the particles' optimiser; None: those of the regression study.
        device: of the fit.
        correct_simulator: whether particles are networks that correct the simulator, instead of networks alone.
    """

    steps: int | None = None
    device: str = "cpu"
    correct_simulator: bool = False


def run_rollout_study(
    case: RecordedCase,
    recordings: Sequence[Sequence[EpisodeData]],
    *,
    rows: Sequence[Rows] = (),
    seeds: int = 3,
    first_seed: int = 0,
    steps: int | None = None,
    device: str = "cpu",
    curves_from: SimulatorConfig | None = None,
    correct_simulator: bool = False,
    progress: Progress = lambda what, done, total: None,
    stop: Callable[[], bool] = lambda: False,
) -> Iterator[RolloutScore]:
    """Fit cars and their disturbances, and yield the scores of the held-out recording.

    Args:
        case: rows of the recordings, the last one held out.
        recordings: the recordings of the case.
        rows: numbers of rows of a fit, or ``ALL_ROWS``; by default ``COUNTS``, with curves ``ALL_ROWS`` alone.
        seeds: number of repetitions.
        first_seed: the smallest seed.
        steps: of the particles' optimiser; by default those of the regression study.
        device: of the fits; rollouts are sampled on the CPU.
        curves_from: simulator of the car file, to which measured curves are added as the prior; None: no curves. The
            curves of a fold are fitted without its blocks.
        correct_simulator: whether particles are networks that correct the simulator, instead of networks alone.
        progress: called before each fit.
        stop: if it returns true before a fit, the study ends.

    Raises:
        ConfigError: curves with a number of rows: they are fitted to windows, which need whole recordings.
        DataError: too few rows, or a recording without a window in which the car moves.
    """
    counts = checked_counts(case, recordings, rows, with_curves=curves_from is not None)
    fitted = [episode for recording in recordings[:-1] for episode in recording]
    fit_windows, held_out = (recorded_windows(of, max(HORIZONS_S), STRIDE_S) for of in (fitted, recordings[-1]))
    fit_settings = FitSettings(steps, device, correct_simulator)
    fit = _fit_without_fold(case, fitted, curves_from, fit_settings)
    total = len(counts) * seeds * (N_FOLDS + 1)
    for done, (count, seed) in enumerate(itertools.product(counts, range(first_seed, first_seed + seeds))):
        errors: list[RolloutErrors] = []
        for fold in range(N_FOLDS):
            if stop():
                return
            progress(f"{count} rows, seed {seed}, fold {fold + 1}", done * (N_FOLDS + 1) + fold, total)
            errors.append(fold_errors(fit(count, seed, fold), fit_windows, fold))
        progress(f"{count} rows, seed {seed}", done * (N_FOLDS + 1) + N_FOLDS, total)
        car = fit(count, seed, None)
        process = fit_disturbance(pooled(errors))
        yield from _scores(case, car, DisturbedCar(car, process), held_out, count, seed)
    progress("", total, total)


def _fit_without_fold(
    case: RecordedCase,
    episodes: Sequence[EpisodeData],
    curves_from: SimulatorConfig | None,
    settings: FitSettings,
) -> Callable[[Rows, int, int | None], CarDynamics]:
    """A fit to a number of rows of the episodes with a seed, without the blocks of a fold (None: to all blocks).

    Curves of a fold are fitted once, for all seeds.
    """
    fold_of_row = folds_of_rows(case.rows, episodes)
    dense_windows = recorded_windows(episodes, max(HORIZONS_S), FIT_STRIDE_S)

    @functools.cache
    def case_of(fold: int | None) -> RecordedCase:
        return case if curves_from is None else with_curves(case, _episodes_without_fold(episodes, fold), curves_from)

    def fit(count: Rows, seed: int, held_out_fold: int | None) -> CarDynamics:
        rows, windows = _without_fold(case, dense_windows, fold_of_row, held_out_fold)
        if count == ALL_ROWS:
            return fit_all(case_of(held_out_fold), rows, windows, seed, settings)
        return fit_rows(case, rows, count, seed, settings)

    return fit


def _scores(
    case: RecordedCase, car: CarDynamics, disturbed: DisturbedCar, windows: PredictionWindows, count: Rows, seed: int
) -> Iterator[RolloutScore]:
    """Scores of both kinds of rollouts on held-out windows."""
    n_rows = len(case.rows) if count == ALL_ROWS else count
    nll = _one_step_nll(car, case.held_out)
    models: tuple[tuple[str, RolloutModel], ...] = ((INDEPENDENT, car), (DISTURBED, disturbed))
    for name, model in models:
        yield from scores_of(name, model, windows, n_rows, seed, nll, all_rows=count == ALL_ROWS)


def _without_fold(
    case: RecordedCase, windows: PredictionWindows, fold_of_row: np.ndarray, fold: int | None
) -> tuple[Transitions, PredictionWindows]:
    """Rows and windows without those of a fold; all of them for None."""
    if fold is None:
        return case.rows, windows
    return case.rows.take(fold_of_row != fold), windows.take((_folds_of(windows) != fold).all(axis=0))


def _episodes_without_fold(episodes: Sequence[EpisodeData], fold: int | None) -> list[EpisodeData]:
    """Parts of episodes without the blocks of a fold; whole episodes for None."""
    if fold is None:
        return list(episodes)
    parts: list[EpisodeData] = []
    for number, episode in enumerate(episodes):
        t_s = episode.times_s[:-1] - episode.times_s[0]
        parts += unbroken_parts(episode, folds(np.full(episode.ticks, number), t_s) != fold)
    return parts


def checked_counts(
    case: RecordedCase,
    recordings: Sequence[Sequence[EpisodeData]],
    rows: Sequence[Rows],
    *,
    with_curves: bool = False,
) -> tuple[Rows, ...]:
    """Numbers of rows, by default ``COUNTS``, with curves ``ALL_ROWS``.

    Raises:
        ConfigError: curves with a number of rows.
        DataError: a fold has fewer rows.
    """
    counts = tuple(rows) or ((ALL_ROWS,) if with_curves else COUNTS)
    if with_curves and any(count != ALL_ROWS for count in counts):
        raise ConfigError("Measured curves are fitted to whole recordings, not to random rows; use --rows all.")
    fold_of_row = folds_of_rows(case.rows, [episode for recording in recordings[:-1] for episode in recording])
    smallest = min(int((fold_of_row != fold).sum()) for fold in range(N_FOLDS))
    largest = max((count for count in counts if count != ALL_ROWS), default=0)
    if largest > smallest:
        raise DataError(f"The folds have {smallest} rows, not {largest}; give fewer with --rows.")
    return counts


def folds_of_rows(rows: Transitions, episodes: Sequence[EpisodeData]) -> np.ndarray:
    """Fold (n,) of rows of episodes by their recorded times, as of windows: a recording may have gaps."""
    t_s = np.empty(len(rows))
    for number, episode in enumerate(episodes):
        own = rows.episode == number
        t_s[own] = episode.times_s[rows.tick[own]] - episode.times_s[0]
    return folds(rows.episode, t_s)


def fit_rows(
    case: RecordedCase, rows: Transitions, count: int, seed: int, settings: FitSettings | None = None
) -> CarDynamics:
    """Fit ``gp-sim-posterior`` of the regression study to ``count`` random rows; the car is on the CPU."""
    settings = settings or FitSettings()
    chosen = rows.take(np.random.default_rng(seed).choice(len(rows), count, replace=False))
    inputs, outputs = (torch.from_numpy(v).float().to(settings.device) for v in (chosen.inputs, chosen.targets))
    task = FitTask(case, Data(inputs, outputs, inputs, outputs), seed, settings.steps)
    size = case.prior_discrepancy_for(count)
    particles = task.distilled(case.prior, outputs, size, correct_simulator=settings.correct_simulator)
    return CarDynamics(particles.posterior.to("cpu"), rows.history)


def fit_all(
    case: RecordedCase, rows: Transitions, windows: PredictionWindows, seed: int, settings: FitSettings
) -> CarDynamics:
    """Fit to ``ONE_STEP_ROWS`` random rows, then to rollouts over windows and to all rows; the car is on the CPU."""
    start = fit_rows(case, rows, min(ONE_STEP_ROWS, len(rows)), seed, settings)
    start = CarDynamics(start.posterior.to(settings.device), start.history)
    car = fit_rollouts(start, drive_windows(windows, start.history), rows, seed=seed)
    return CarDynamics(car.posterior.to("cpu"), car.history)


def folds(recording: np.ndarray, t_s: FloatArray) -> np.ndarray:
    """Fold (n,) of moments (n,) in recordings (n,): blocks of ``BLOCK_S`` in turn."""
    return np.asarray((t_s // BLOCK_S).astype(np.int64) + recording) % N_FOLDS


def fold_errors(car: CarDynamics, windows: PredictionWindows, fold: int) -> RolloutErrors:
    """Errors of a car over the windows that lie within the blocks of one fold."""
    first, last = _folds_of(windows)
    chosen = windows.take((first == fold) & (last == fold)).thinned(MAX_WINDOWS)
    return rollout_errors(car, drive_windows(chosen, car.history))


def _folds_of(windows: PredictionWindows) -> np.ndarray:
    """Folds (2, S) of the starts and ends of windows."""
    return np.stack([folds(windows.recording, windows.t0_s + dt) for dt in (0.0, windows.horizon_s)])


def scores_of(
    name: str, model: RolloutModel, windows: PredictionWindows, rows: int, seed: int, nll: float, *, all_rows: bool
) -> Iterator[RolloutScore]:
    """Scores of a model on windows, by horizon."""
    paths = LearnedModel(model, N_SAMPLES, seed).sample(windows)
    errors = prediction_errors(np.moveaxis(paths, 2, 0), windows)
    for horizon_s in HORIZONS_S:
        at = errors[:, :, round(horizon_s / windows.period_s)]
        low, high = np.quantile(at, [0.5 - 0.5 * LEVEL, 0.5 + 0.5 * LEVEL], axis=0)
        mean = at.mean(axis=0)
        yield RolloutScore(
            name, rows, seed, horizon_s,
            tuple(((low <= 0) & (high >= 0)).mean(axis=0).tolist()),
            tuple((high - low).mean(axis=0).tolist()),
            float(np.sqrt(np.mean(mean[:, 0] ** 2 + mean[:, 1] ** 2))),
            float(np.sqrt(np.mean(mean[:, 2] ** 2))),
            energy_score(at[..., :2]),
            nll,
            len(windows),
            all_rows,
        )  # fmt: skip


def energy_score(errors: FloatArray) -> float:
    """Mean energy score of samples (M, S, d) of predicted minus measured values (Gneiting and Raftery 2007)."""
    half = len(errors) // 2
    distance = np.linalg.norm(errors, axis=-1).mean()
    spread = np.linalg.norm(errors[:half] - errors[half : 2 * half], axis=-1).mean()
    return float(distance - 0.5 * spread)


def as_json(scores: Sequence[RolloutScore], command: str) -> dict[str, Any]:
    """The scores with the command, for a file."""
    return {"schema": "carlab.rollouts/1", "command": command, "level": LEVEL, "scores": [asdict(s) for s in scores]}


def scores_from_json(content: Mapping[str, Any]) -> list[RolloutScore]:
    """Read the scores of ``as_json``. Raises KeyError, TypeError or ValueError for other content."""
    pairs = ("coverage", "band")
    rows: list[dict[str, Any]] = [
        {k: tuple(v) if k in pairs else v for k, v in row.items()} for row in content["scores"]
    ]
    return [RolloutScore(**row) for row in rows]


def _one_step_nll(car: CarDynamics, rows: Transitions) -> float:
    inputs, outputs = (torch.from_numpy(v).float() for v in (rows.inputs, rows.targets))
    return negative_log_likelihood(car.predict(inputs).smoothed(), outputs)
