"""The rerun recording of a run folder: every drive, and for a run of learning its predictions and figures."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from carlab.core.documents import EpisodeEnded, EpisodeStarted, Tick
from carlab.core.episode_data import EpisodeData
from carlab.core.errors import DataError
from carlab.core.observation import feature_size
from carlab.experiment.campaign.figures import EpisodeFigures, WindowPredictions, predict_ahead, predict_windows
from carlab.experiment.campaign.training import DYNAMICS_FILE, model_folder
from carlab.recording.atomic_files import rerun_file
from carlab.recording.episode_builder import RECOVERY
from carlab.recording.mcap.source import read_episode, read_recording
from carlab.recording.rerun.blueprint import send_blueprint
from carlab.recording.rerun.run_recording import RunRecording, episode_number
from carlab.recording.run_folder import RunDirectory
from learning.policy.sac_agent import SacAgent, SacSettings
from learning.world.car_fit import LearnedCar, load_car

log = logging.getLogger(__name__)

TICKS_BETWEEN_PATHS = 3
"""Ticks from one predicted path ahead of the car to the next."""


@dataclass(frozen=True, slots=True)
class LearnedDriver:
    """The learned car and the policy before an episode."""

    dynamics: LearnedCar
    agent: SacAgent

    @classmethod
    def load(cls, run: RunDirectory, number: int) -> LearnedDriver | None:
        """Read the models before an episode; None if they are missing or have another file version."""
        folder = model_folder(run.models, number)
        try:
            return cls(load_car(folder / DYNAMICS_FILE), SacAgent.load(folder, SacSettings(), 0))
        except DataError:
            return None

    def draw_paths_ahead(self, recording: RunRecording, ticks: Sequence[Tick], period_s: float) -> None:
        """Draw the predicted path at each tick with the features of this policy."""
        width = feature_size(self.dynamics.history)
        starts = [tick for tick in ticks if tick.features.shape == (width,) and np.isfinite(tick.features).all()]
        if not starts:
            return
        features = np.array([tick.features for tick in starts])
        paths = predict_ahead(self.dynamics, self.agent.act, features, period_s)
        for tick, mean, across_std in zip(starts, *paths, strict=True):
            recording.add_predicted_path(tick.t_s, tick.step, mean, across_std)


@dataclass(frozen=True, slots=True)
class PredictedEpisode:
    """A recorded episode of learning and the predictions of its windows by the model before it."""

    number: int
    data: EpisodeData
    windows: WindowPredictions


def write_run_recording(
    run: RunDirectory, figures: Mapping[int, EpisodeFigures], path: Path
) -> PredictedEpisode | None:
    """Write all episodes of a run into an .rrd file; an existing file is replaced.

    Args:
        run: folder of a run of ``carlab drive`` or ``carlab learn``.
        figures: figures of the episodes of learning, by number.
        path: the file.

    Returns:
        The newest episode with predictions; None without any.

    Raises:
        DataError: no recording can be read, or the file cannot be written.
    """
    files = run.recordings(partial=True)
    newest: PredictedEpisode | None = None
    n_written = 0
    with rerun_file(path, recording_id=run.path.name) as stream:
        stream.send_recording_name(run.path.name)
        recording = RunRecording(stream, len(files))
        for file in files:
            try:
                documents = read_recording(file).documents
            except DataError as error:
                log.warning("%s", error)
                continue
            n_written += 1
            started = next(d for d in documents if isinstance(d, EpisodeStarted))
            for document in documents:
                recording.write(document)
            if not isinstance(documents[-1], EpisodeEnded):
                recording.documents.flush()
            number = episode_number(started)
            driver = LearnedDriver.load(run, number)
            if driver is not None:
                ticks = [d for d in documents if isinstance(d, Tick)][::TICKS_BETWEEN_PATHS]
                driver.draw_paths_ahead(recording, ticks, started.period_s)
                newest = add_windows(recording, driver.dynamics, number, file) or newest
            if number in figures:
                row = figures[number]
                recording.add_figures(number, row.to_dict(), f"{row.prior_change} {row.diagnosis}".strip())
        if not n_written:
            raise DataError(f"{run.path} has no recording that can be read; name the folder of another run.")
        send_blueprint(stream, recording.blueprint())
    return newest


def readable_episodes(run: RunDirectory) -> list[EpisodeData]:
    """The recordings of a run with a complete tick, also incomplete files."""
    episodes = []
    for file in run.recordings(partial=True):
        try:
            episodes.append(read_episode(file))
        except DataError as error:
            log.warning("%s", error)
    return episodes


def warn_of_recovered_files(run: RunDirectory, *, partial: bool) -> None:
    """Log a warning for each recording of which only the complete ticks can be read; ``partial``: also unfinished."""
    for file in run.recordings(partial=partial):
        try:
            recovery = read_episode(file).metadata.get(RECOVERY)
        except DataError:  # No complete tick: the reader of the file decides.
            continue
        if recovery:
            log.warning("%s %s.", file, recovery)


def add_windows(recording: RunRecording, dynamics: LearnedCar, number: int, file: Path) -> PredictedEpisode | None:
    """Write the predictions of the newest episode's windows; None if it has no complete tick."""
    try:
        data = read_episode(file)
    except DataError:
        return None
    windows = predict_windows(dynamics, data)
    recording.add_windows(data, windows.ticks, windows.mean, windows.std)
    return PredictedEpisode(number, data, windows)
