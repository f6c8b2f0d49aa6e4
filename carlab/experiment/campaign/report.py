"""The report of a run of learning: learn.json, learn.png and learn.rrd."""

from __future__ import annotations

import logging

from carlab.core.errors import DataError
from carlab.core.json_files import read_json
from carlab.core.task import Task
from carlab.experiment.campaign.figures import EpisodeFigures, figures_of
from carlab.experiment.campaign.picture import draw
from carlab.experiment.campaign.quick_check import EpisodeCheck
from carlab.experiment.campaign.run_recording import write_run_recording
from carlab.experiment.campaign.training import training_figures
from carlab.experiment.campaign.training_plan import TrainingPlan
from carlab.experiment.episodes.result import EpisodeResult, result_of
from carlab.recording.mcap.source import has_ticks, read_episode
from carlab.recording.run_folder import RunDirectory

log = logging.getLogger(__name__)

CURVE_FILE = "learn.json"
PICTURE_FILE = "learn.png"


def learning_curve(run: RunDirectory) -> list[EpisodeFigures]:
    """Read the rows of learn.json, version 1 to 3. Raises DataError if the file is invalid."""
    path = run.path / CURVE_FILE
    if not path.is_file():
        return []
    try:
        return [EpisodeFigures.from_dict(row) for row in read_json(path)["episodes"]]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DataError(f"{path} cannot be read ({error}); remove it, and the next run restores it.") from error


def save_row(run: RunDirectory, row: EpisodeFigures) -> list[EpisodeFigures]:
    """Add or replace the row of an episode in learn.json; returns all rows."""
    rows = sorted([r for r in learning_curve(run) if r.episode != row.episode] + [row], key=lambda r: r.episode)
    run.write_json(CURVE_FILE, {"schema": "carlab.learn/3", "episodes": [r.to_dict() for r in rows]})
    return rows


def restore_missing_rows(run: RunDirectory, task: Task) -> list[EpisodeResult]:
    """Restore the missing rows of recorded episodes in learn.json: the program ended before it had reported them.

    Returns:
        The episodes without a row in learn.json or in result.json, the last file of a report.
    """
    known = {row.episode for row in learning_curve(run)}
    reported = {row["episode"] for row in run.result_rows}
    unreported = []
    for number, path in enumerate(run.recordings(), start=1):
        file_number = int(path.stem) if path.stem.isdecimal() else number
        if (number in known and file_number in reported) or not has_ticks(path):
            continue
        try:
            result = result_of(file_number, read_episode(path), task, path)
            if number not in known:
                save_row(run, figures_of(result, training_figures(run, number), task))
            unreported.append(result)
        except (OSError, ValueError, KeyError, TypeError) as error:
            log.warning("The row of episode %d in %s cannot be restored: %s", number, CURVE_FILE, error)
    return unreported


def save_check(run: RunDirectory, check: EpisodeCheck) -> None:
    """Add a quick check to the row of its episode; without a row, do nothing."""
    for row in learning_curve(run):
        if row.episode == check.episode:
            save_row(run, row.with_check(check))


def write_report(run: RunDirectory, plan: TrainingPlan, row: EpisodeFigures) -> None:
    """Add an episode to learn.json, learn.png and learn.rrd of a run.

    An episode has no predictions if its learned car was removed or has another file version.
    """
    rows = save_row(run, row)
    newest = write_run_recording(run, {r.episode: r for r in rows}, run.path / "learn.rrd")
    if newest is not None:
        draw(rows, newest.number, newest.data, newest.windows, plan.task, run.path / PICTURE_FILE)
