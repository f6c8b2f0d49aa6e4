"""The real car as a case of the regression study: training recordings and a held-out recording."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from carlab.cars import load_car_file
from carlab.core.episode_data import EpisodeData
from carlab.core.errors import DataError
from carlab.experiment.campaign.campaign import check_period, prior_simulator
from carlab.studies.regression.cases import Case, Data
from learning.priors.simulator_model import DELAY, CarModel, known_ranges
from learning.transitions import Transitions, transitions_of, velocity_delay_s
from learning.world.car_fit import NOISE_STD
from learning.world.history import find_history
from sim_backends.car_parameters import SimulatorConfig

MAX_YAW_RATE_RADPS = 10.0
"""Faster rows are spikes of a differentiated angle."""
NAME = "realcar"
MIN_UNIT = 1e-3
"""Lower bound of an input's or output's standard deviation, which is its unit."""
COUNTS = (50, 200, 800)
DELAY_S = (0.0, 0.2)
SMALL_DISCREPANCY, MIN_ROWS_FOR_DEFAULT = (0.03,) * 3 + (0.1,) * 3, 400
"""Prior discrepancy of steps and of velocities with fewer rows (docs/decisions/0012); more rows have the default."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordedCase(Case):
    """Rows of recordings.

    Attributes:
        rows: training rows to draw from.
        held_out: of the last recording.
        held_out_yaw: heading at each of these (n,) [rad].
        history_message: how the history was chosen.
    """

    rows: Transitions
    held_out: Transitions
    held_out_yaw: np.ndarray
    history_message: str

    def prior_discrepancy_for(self, count: int) -> float | tuple[float, ...] | None:
        """Prior size of the discrepancy with so many rows, in units of the outputs."""
        return SMALL_DISCREPANCY if count < MIN_ROWS_FOR_DEFAULT else self.prior_discrepancy

    def recorded(self, folder: Path, count: int, seed: int) -> Data:
        """Rows drawn from all but the last recording, and the last one whole. Raises DataError for too few."""
        if count > len(self.rows):
            raise DataError(f"The recordings have {len(self.rows)} rows, not {count}; give fewer with --rows.")
        chosen = self.rows.take(np.random.default_rng(seed).choice(len(self.rows), count, replace=False))
        parts = (chosen.inputs, chosen.targets, self.held_out.inputs, self.held_out.targets, self.held_out_yaw)
        return Data(*(torch.from_numpy(part).float() for part in parts))


def recorded_case(recordings: Sequence[Sequence[EpisodeData]], car: Path, history: int | None) -> RecordedCase:
    """A case of recordings.

    Args:
        recordings: episodes of each; the last recording is held out.
        car: file or name of the car whose simulator is the prior, with its ranges and standard deviations.
        history: past commands; found from the recordings that are not held out unless given.

    Raises:
        ConfigError: the recordings were made with another control period than the car's file has.
        DataError: fewer than two recordings, or too short to estimate the history.
    """
    if len(recordings) < 2:
        raise DataError("The study of the real car needs at least two recordings; the last one is held out.")
    simulator = load_car_file(car).simulator
    check_periods(recordings, simulator)
    fitted = [episode for recording in recordings[:-1] for episode in recording]
    history_message = f"{history} past commands, as requested."
    if history is None:
        choice = find_history(fitted)
        if choice is None:
            raise DataError("The recordings are too short to estimate the number of past commands; give --history.")
        history, history_message = choice.history, choice.message()
    rows, held_out = (_without_spikes(transitions_of(episodes, history)) for episodes in (fitted, recordings[-1]))
    yaw = np.array([recordings[-1][e].states[t, 2] for e, t in zip(held_out.episode, held_out.tick, strict=True)])
    own = prior_simulator(simulator, "nominal")
    period_s = own.control_period_s
    # Time-dependent effects are evaluated at the mean time of the rows.
    prior = CarModel(
        own, history, {DELAY: DELAY_S, **known_ranges(own)}, at_s=float(rows.tick.mean()) * period_s,
        velocity_delay_s=velocity_delay_s(rows, period_s),
    )  # fmt: skip
    input_std, output_std = (
        tuple(float(v) for v in np.maximum(of.std(axis=0), MIN_UNIT)) for of in (rows.inputs, rows.targets)
    )
    return RecordedCase(
        name=NAME,
        prior=prior,
        counts=COUNTS,
        noise_std=tuple(0.5 * n for n in NOISE_STD),
        likelihood_std=tuple(0.5 * s for s in output_std),
        fit_noise=True,
        input_std=input_std,
        output_std=output_std,
        discrepancy_std=tuple(0.3 * s for s in output_std),
        discrepancy_lengthscale=3.0,
        function_lengthscale=3.0,
        rows=rows,
        held_out=held_out,
        held_out_yaw=yaw,
        history_message=history_message,
    )


def check_periods(recordings: Sequence[Sequence[EpisodeData]], car: SimulatorConfig) -> None:
    """Raise ConfigError if the control period of a recording differs from that of the car file."""
    for episode in itertools.chain.from_iterable(recordings):
        check_period(car, episode.period_s, "a recording")


def _without_spikes(rows: Transitions) -> Transitions:
    return rows.take(np.abs(rows.inputs[:, 2]) < MAX_YAW_RATE_RADPS)
