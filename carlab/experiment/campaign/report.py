"""The report of a run of learning: learn.json, learn.png and learn.rrd."""

from __future__ import annotations

import json
import logging
from dataclasses import fields

import numpy as np

from carlab.core.errors import DataError
from carlab.core.task import Task
from carlab.experiment.campaign.figures import EpisodeFigures, figures_of, predict_windows
from carlab.experiment.campaign.picture import draw
from carlab.experiment.campaign.quick_check import QuickCheck
from carlab.experiment.campaign.training import DYNAMICS_FILE, FIGURES_FILE, TrainingPlan, has_ticks, model_folder
from carlab.experiment.episodes.session import result_of
from carlab.recording.mcap.source import read_episode
from carlab.recording.rerun.learning_curve import write_learning_curve
from carlab.recording.run_folder import RunDirectory
from learning.world.car_fit import LearnedCar, load_car

log = logging.getLogger(__name__)

CURVE_FILE = "learn.json"


def learning_curve(run: RunDirectory) -> list[EpisodeFigures]:
    """Read the rows of learn.json, version 1 to 3. Raises DataError if the file is invalid."""
    path = run.path / CURVE_FILE
    if not path.is_file():
        return []
    try:
        return [EpisodeFigures.from_dict(row) for row in json.loads(path.read_text(encoding="utf-8"))["episodes"]]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DataError(f"{path} cannot be read ({error}); remove it, and the next run restores it.") from error


def save_row(run: RunDirectory, row: EpisodeFigures) -> list[EpisodeFigures]:
    """Add or replace the row of an episode in learn.json; returns all rows."""
    rows = sorted([r for r in learning_curve(run) if r.episode != row.episode] + [row], key=lambda r: r.episode)
    run.write_json(CURVE_FILE, {"schema": "carlab.learn/3", "episodes": [r.to_dict() for r in rows]})
    return rows


def restore_missing_rows(run: RunDirectory, task: Task) -> None:
    """Restore the missing rows of recorded episodes: the program ended between their last tick and ``save_row``."""
    known = {row.episode for row in learning_curve(run)}
    for number, path in enumerate(run.recordings(), start=1):
        if number in known or not has_ticks(path):
            continue
        try:
            training = json.loads((model_folder(run.models, number) / FIGURES_FILE).read_text(encoding="utf-8"))
            save_row(run, figures_of(result_of(number, read_episode(path), task, path), training, task))
        except (OSError, ValueError, KeyError) as error:
            log.warning("The row of episode %d in %s cannot be restored: %s", number, CURVE_FILE, error)


def save_check(run: RunDirectory, check: QuickCheck) -> None:
    """Add a quick check to the row of its episode; without a row, do nothing."""
    for row in learning_curve(run):
        if row.episode == check.episode:
            save_row(run, row.with_check(check))


def write_report(run: RunDirectory, plan: TrainingPlan, row: EpisodeFigures) -> None:
    """Add an episode to learn.json, learn.png and learn.rrd of a run.

    learn.rrd omits an earlier episode if its learned car was removed or has another file version.
    """
    rows = save_row(run, row)
    recordings = run.recordings()
    driven, predictions = [], []
    shown = [r for r in rows if r.episode <= len(recordings) and has_ticks(recordings[r.episode - 1])]
    models = {r.episode: _learned(run, r.episode) for r in shown}
    shown = [r for r in shown if models[r.episode] is not None]
    for r in shown:
        episode, model = read_episode(recordings[r.episode - 1]), models[r.episode]
        assert model is not None
        predicted = predict_windows(model, episode)
        driven.append(episode.states)
        predictions.append((predicted.ticks, predicted.mean, predicted.std))
        if r is shown[-1]:
            draw(rows, r.episode, episode, predicted, plan.task, run.path / "learn.png")
    numbers = [f.name for f in fields(EpisodeFigures) if f.type in ("int", "float", "bool")]
    figures = [{n: float(np.float64(getattr(r, n))) for n in numbers} for r in shown]
    write_learning_curve(run.path / "learn.rrd", figures, driven, predictions, [r.diagnosis for r in shown])


def _learned(run: RunDirectory, episode: int) -> LearnedCar | None:
    """The learned car before an episode; None if it was removed or has another file version."""
    try:
        return load_car(model_folder(run.models, episode) / DYNAMICS_FILE)
    except DataError:
        return None


__all__ = ["CURVE_FILE", "learning_curve", "restore_missing_rows", "save_check", "save_row", "write_report"]
