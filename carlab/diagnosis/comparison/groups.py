"""Two groups of recordings, prepared alike, and the reference model that is fitted to the first."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from carlab.core.episode_data import EpisodeData
from carlab.core.errors import DataError
from carlab.core.quantities import FloatArray
from carlab.diagnosis.comparison.drive_spread import part_blocks, parts_of
from carlab.diagnosis.findings import DataFault
from carlab.diagnosis.identification.error_model import CrossFittedErrors, ErrorModel
from carlab.diagnosis.identification.fit import Fitter
from carlab.diagnosis.identification.fit_parameters import coordinates_in, stated_parameters
from carlab.diagnosis.identification.held_out_errors import mean_noise_floor
from carlab.diagnosis.identification.measurement_noise import estimate_noise
from carlab.diagnosis.identification.velocity_window import with_initial_states
from carlab.diagnosis.recording_faults import find as data_faults_of
from carlab.diagnosis.recordings import Inconclusive, check_excitation
from carlab.diagnosis.selection.problem import SearchProblem
from carlab.diagnosis.selection.refit import fit_with_scale
from carlab.diagnosis.settings import COMPARISON, DEFAULT
from carlab.diagnosis.state_alignment import with_known_latency
from carlab.prediction.windows import IndexArray, PredictionWindows, RecordingSegment, cut_windows, segments_of
from sim_backends.car_parameters import SimulatorConfig
from sim_backends.effects import confusable_effects


@dataclass(frozen=True, slots=True)
class ComparedGroups:
    """Reference model and both groups.

    config   simulator fitted to the first group
    fitters  windows and error scale of each group
    errors   (S, D) whitened errors of the reference model in each group
    parts    (S,) part of each window, in each group
    error_models  distributions of the errors of the first group
    data_faults   faults that were found in both groups
    """

    config: SimulatorConfig
    fitters: tuple[Fitter, Fitter]
    errors: tuple[FloatArray, FloatArray]
    parts: tuple[IndexArray, IndexArray]
    error_models: CrossFittedErrors
    data_faults: tuple[DataFault, ...]

    @property
    def model(self) -> ErrorModel:
        """Distribution of the errors of the second group."""
        return self.error_models.whole

    def decorrelated(self, of_groups: Sequence[FloatArray]) -> tuple[FloatArray, FloatArray]:
        """Errors (..., S, D) of each group in standard deviations along independent directions.

        Args:
            of_groups: whitened errors (..., S, D) of the first and of the second group.
        """
        first, second = of_groups
        return self.error_models.decorrelated(first), self.model.decorrelated(second)


def compared_groups(
    reference: Sequence[EpisodeData],
    changed: Sequence[EpisodeData],
    nominal: SimulatorConfig,
) -> ComparedGroups:
    """Repair both groups alike, cut them into windows, and fit the base parameters and effects to the first.

    Raises:
        DataError: the recordings are too short or too uniform, or have different periods; the message has the remedy.
    """
    nominal = with_known_latency(nominal, (*reference, *changed))
    reference, changed, faults = data_faults_of.check(reference, changed, nominal, alike=True)
    segments = [_checked_segments(group, k) for k, group in enumerate((reference, changed))]
    periods = [t[0].period_s for t in segments]
    if max(periods) > COMPARISON.period_ratio_max * min(periods):
        raise DataError(
            f"The groups have periods of {periods[0]:.3f} s and {periods[1]:.3f} s; compare recordings of one car."
        )
    first, second = (_windows(segments_of(group, periods[0])) for group in (reference, changed))
    first, second = with_initial_states((first, second), nominal)
    noise = estimate_noise(segments[0], first.curvature_bias)
    floor = mean_noise_floor(first, noise, nominal)
    problem = SearchProblem(nominal, first, floor, noise.measured, confusable_effects(), ())
    free = stated_parameters(nominal)
    fitted = fit_with_scale(problem, (), coordinates_in(nominal, free), free)
    one, two = (
        Fitter(w.thinned(limit), fitted.scale) for w, limit in zip((first, second), COMPARISON.max_windows, strict=True)
    )
    config = fitted.fit.config
    errors = (_errors(one, config), _errors(two, config))
    length = part_blocks((one.windows, two.windows))
    parts = (parts_of(one.windows, length), parts_of(two.windows, length))
    fold = parts[0] % min(COMPARISON.error_folds, int(parts[0].max()) + 1)
    models = CrossFittedErrors.of(errors[0], fold)
    return ComparedGroups(config, (one, two), errors, parts, models, tuple(faults))


def _errors(fitter: Fitter, config: SimulatorConfig) -> FloatArray:
    white = fitter.white(config, (), np.zeros((1, 0)))[0]
    return np.asarray(white.reshape(len(white), -1))


def _checked_segments(episodes: Sequence[EpisodeData], k: int) -> list[RecordingSegment]:
    """Segments of a group. Raises Inconclusive if it is too short or too uniform."""
    which = ("first", "second")[k]
    segments = segments_of(episodes)
    seconds = sum(segment.duration_s for segment in segments)
    needed_s = COMPARISON.block_s * COMPARISON.min_blocks
    if seconds < needed_s:
        raise Inconclusive(
            f"The {which} group has {seconds:.0f} s of driving; a comparison needs {needed_s:.0f} s in each group."
        )
    check_excitation(segments, DEFAULT.windows)
    return segments


def _windows(segments: Sequence[RecordingSegment]) -> PredictionWindows:
    cut = cut_windows(segments, DEFAULT.windows.fit_window_s, DEFAULT.windows.fit_stride_s, COMPARISON.block_s)
    if len(np.unique(cut.block)) < COMPARISON.min_blocks:
        raise Inconclusive("The car moves too little in one group; record at least one minute of driving.")
    return cut.thinned(DEFAULT.windows.max_fit_windows)
