"""The result of ``carlab.drive`` and its picture."""

from __future__ import annotations

import contextlib
import logging
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from carlab.api.runs import figure_names, html_picture, html_table
from carlab.core.errors import add_sentence
from carlab.core.outcome import EndReason
from carlab.experiment.episodes.result import EpisodeResult

if TYPE_CHECKING:
    from carlab.recording.run_folder import RunDirectory

log = logging.getLogger(__name__)

PICTURE_FILE = "summary.png"


@dataclass(frozen=True)
class DriveRun:
    """Result of ``carlab.drive``.

    Attributes:
        folder: the run's folder.
        episodes: each with ``data`` (arrays), ``reason`` (end reason), ``summary`` (figures of the task), ``path``.
    """

    folder: Path
    episodes: tuple[EpisodeResult, ...]

    @property
    def recordings(self) -> list[Path]:
        """The MCAP files."""
        return [episode.path for episode in self.episodes]

    @property
    def picture(self) -> Path:
        """Path of the summary picture; the file exists only if it was drawn."""
        return self.folder / PICTURE_FILE

    @property
    def end(self) -> EndReason | None:
        """End reason of the last episode; None without episodes."""
        return self.episodes[-1].reason if self.episodes else None

    def __repr__(self) -> str:
        """Folder, number of episodes, last end and its cause."""
        if self.end is None:
            return f"<DriveRun {self.folder}: nothing driven>"
        count = "1 episode" if len(self.episodes) == 1 else f"{len(self.episodes)} episodes"
        cause = self.episodes[-1].data.metadata["end_detail"]
        return f"<DriveRun {self.folder}: {count}, {self.end.name.lower()}{cause and f': {cause}'}>"

    def _repr_html_(self) -> str:
        names = figure_names(self.episodes)
        rows = [
            [
                e.episode,
                e.data.ticks,
                e.total_reward,
                *(e.summary.get(n, math.nan) for n in names),
                e.reason.name.lower(),
            ]
            for e in self.episodes
        ]
        return html_table(["episode", "ticks", "return", *names, "end"], rows) + html_picture(self.picture)


@contextlib.contextmanager
def run_results(run: RunDirectory, picture: bool) -> Iterator[list[EpisodeResult]]:
    """A list for the results of a run; finally their picture is drawn if ``picture``.

    An error within the context gets a sentence with the run's folder if episodes were finished before it.
    """
    results: list[EpisodeResult] = []
    try:
        yield results
    except BaseException as error:
        if results:
            count = "the episode" if len(results) == 1 else f"the {len(results)} episodes"
            add_sentence(error, f"{run.path} has {count} before, see result.json.")
        raise
    finally:
        if picture:
            _draw(results, run.path / PICTURE_FILE)


def _draw(results: Sequence[EpisodeResult], path: Path) -> None:
    """Draw the episodes with complete ticks; an error or ^C leaves out the picture and does not end the program."""
    from carlab.recording.mcap.source import read_episode
    from carlab.recording.picture import save_summary

    try:
        episodes = [read_episode(result.path) for result in results if result.has_recorded_ticks]
        if episodes:
            save_summary(episodes, path)
    except (Exception, KeyboardInterrupt) as error:
        path.unlink(missing_ok=True)
        log.warning("The picture %s was not drawn (%s).", path, str(error) or type(error).__name__)
