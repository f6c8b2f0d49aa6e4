"""``carlab view``."""

from __future__ import annotations

import shutil
import subprocess
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from tyro.conf import Positional

from carlab.api.recordings import is_run_folder, load, required_file, save_run
from carlab.api.runs import viewer_program
from carlab.cli.console import console
from carlab.cli.options import new_file
from carlab.cli.recordings import load_episodes
from carlab.core.episode_data import EpisodeData
from carlab.core.errors import ConfigError, NotReadyError

REPORT_FILE = "report.rrd"
PAGE_FILE = "report.html"
PICTURE_FILE = "summary.png"


@dataclass
class View:
    """Open a recording or a whole run in rerun, save it as .rrd, or save a picture of it.

    A run has tabs: drive by episode, predicted against driven, learning curve, quick check, latency and health. Tabs
    and panels without data are left out.
    """

    recording: Positional[Path]
    """An MCAP (finished or .partial), a CSV, an .rrd, or a folder: of a run, or of a diagnosis."""

    save: Path | None = None
    """Write FILE.rrd instead of opening the viewer."""

    screenshot: Path | None = None
    """Write FILE.png instead: a screenshot of the viewer if a Vulkan driver can render it off-screen, else a plot."""

    verbose: bool = False
    """Show the whole log."""

    def run(self) -> int:
        """View or save."""
        if self.save is not None:
            new_file(self.save, "--save", ".rrd")
        if self.screenshot is not None:
            new_file(self.screenshot, "--screenshot", ".png")
        source = self._source()
        if self.save is None and self.screenshot is None:
            return self._open(source)
        with tempfile.TemporaryDirectory(prefix="carlab-view-") as folder:
            rrd = source.rrd(self.save or Path(folder) / "view.rrd")
            if self.save is not None:
                if rrd != self.save:
                    self.save.write_bytes(rrd.read_bytes())
                console.print(f"{self.save}", soft_wrap=True)
            if self.screenshot is not None:
                self._picture(source, rrd, self.screenshot)
        return 0

    def _source(self) -> _Source:
        path = self.recording
        if path.is_dir():
            if is_run_folder(path):
                return _Source(path.name, lambda rrd: save_run(path, rrd), lambda png: save_run(path, png))
            if not (path / REPORT_FILE).is_file():
                raise ConfigError(
                    f"{path} is not the folder of a run or of a diagnosis; name such a folder, or a recording."
                )
            path /= REPORT_FILE
        if required_file(path).suffix == ".rrd":
            from carlab.recording.rerun.viewer import check_rerun_file

            check_rerun_file(path)
            return _Source(path.stem, lambda rrd: path, _plot_beside(path))
        episodes = load_episodes(path)
        if len(episodes) > 1:
            console.print(f"Showing the longest of {len(episodes)} episodes.")
        episode = max(episodes, key=lambda e: e.ticks)

        def write_rrd(rrd: Path) -> Path:
            from carlab.recording.rerun.sink import episode_to_rrd

            rrd.parent.mkdir(parents=True, exist_ok=True)
            episode_to_rrd(episode, rrd, path.name)
            return rrd

        return _Source(path.stem, write_rrd, lambda png: _plot(episode, png))

    def _picture(self, source: _Source, rrd: Path, path: Path) -> None:
        from carlab.recording.rerun.screenshot import save_screenshot

        try:
            save_screenshot(rrd, path)
        except NotReadyError as error:
            if source.draw is None:
                raise NotReadyError(f"{error}, or {_other_way(self.recording)}") from error
            console.print(f"{error}\nDrawing a plot instead.")
            path.parent.mkdir(parents=True, exist_ok=True)
            source.draw(path)
        console.print(f"{path}", soft_wrap=True)

    def _open(self, source: _Source) -> int:
        program = viewer_program("use --save FILE.rrd or --screenshot FILE.png")
        with tempfile.TemporaryDirectory(prefix="carlab-view-") as folder:
            rrd = source.rrd(Path(folder) / f"{source.name}.rrd")
            return subprocess.run([str(program), str(rrd), "--bind", "127.0.0.1"], check=False).returncode


@dataclass(frozen=True)
class _Source:
    """What is shown.

    Attributes:
        name: of the file that the viewer opens, without suffix.
        rrd: writes the recording to a path, or returns the path of an existing .rrd.
        draw: draws a picture without the viewer; None: impossible.
    """

    name: str
    rrd: Callable[[Path], Path]
    draw: Callable[[Path], Path] | None


def _plot(episode: EpisodeData, png: Path) -> Path:
    from carlab.recording.picture import save_summary

    save_summary([episode], png)
    return png


def _plot_beside(rrd: Path) -> Callable[[Path], Path] | None:
    """How to draw an .rrd without the viewer: the picture of its diagnosis, or a plot of its MCAP recording."""
    picture, recording = rrd.with_name(PICTURE_FILE), rrd.with_suffix(".mcap")
    if rrd.name == REPORT_FILE and picture.is_file():
        return lambda png: Path(shutil.copyfile(picture, png))
    if recording.is_file():
        return lambda png: _plot(load(recording).episode, png)
    return None


def _other_way(path: Path) -> str:
    """What to do where an .rrd or the folder of a diagnosis cannot be drawn."""
    page = (path if path.is_dir() else path.parent) / PAGE_FILE
    if page.is_file():
        return f"open {page} in a browser, which has the same figures."
    return "name the .mcap recording, which is plotted without the viewer."
