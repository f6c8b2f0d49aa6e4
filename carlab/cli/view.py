"""``carlab view``."""

from __future__ import annotations

import subprocess
import tempfile
from dataclasses import dataclass
from pathlib import Path

from tyro.conf import Positional

from carlab.api.driving import has_screen
from carlab.api.recordings import required_file
from carlab.cli.console import console
from carlab.cli.options import new_file
from carlab.cli.recordings import load_episodes
from carlab.core.episode_data import EpisodeData
from carlab.core.errors import ConfigError, NotReadyError


@dataclass
class View:
    """Open a recording in rerun, save it as .rrd, or save a picture of it."""

    recording: Positional[Path]
    """An MCAP (finished or .partial), a CSV, or an .rrd."""

    save: Path | None = None
    """Write FILE.rrd instead of opening the viewer."""

    screenshot: Path | None = None
    """Write FILE.png instead: a screenshot of the viewer if a Vulkan driver can render it off-screen, else a plot."""

    verbose: bool = False
    """Show the whole log."""

    def run(self) -> int:
        """View or save."""
        required_file(self.recording)
        if self.save is not None:
            new_file(self.save, "--save", ".rrd")
        if self.screenshot is not None and self.screenshot.suffix != ".png":
            raise ConfigError(f"--screenshot {self.screenshot}: name a file that ends in .png.")
        ready = self.recording if self.recording.suffix == ".rrd" else None
        episode = None if ready is not None else self._episode()
        if self.save is not None:
            ready = self._rrd(ready, episode, self.save)
            console.print(f"{ready}")
        if self.screenshot is not None:
            self._picture(ready, episode, self.screenshot)
        if self.save is None and self.screenshot is None:
            return self._open(ready, episode)
        return 0

    def _episode(self) -> EpisodeData:
        episodes = load_episodes(self.recording)
        if len(episodes) > 1:
            console.print(f"Showing the longest of {len(episodes)} episodes.")
        return max(episodes, key=lambda e: e.ticks)

    def _rrd(self, ready: Path | None, episode: EpisodeData | None, path: Path) -> Path:
        from carlab.recording.rerun.sink import episode_to_rrd

        if episode is not None:
            path.parent.mkdir(parents=True, exist_ok=True)
            episode_to_rrd(episode, path, self.recording.name)
        elif ready is not None:
            path.write_bytes(ready.read_bytes())
        return path

    def _picture(self, ready: Path | None, episode: EpisodeData | None, path: Path) -> None:
        from carlab.recording.picture import save_summary
        from carlab.recording.rerun.screenshot import save_screenshot

        with tempfile.TemporaryDirectory(prefix="carlab-view-") as folder:
            try:
                save_screenshot(ready or self._rrd(ready, episode, Path(folder) / "view.rrd"), path)
            except NotReadyError as error:
                if episode is None:
                    raise
                console.print(f"{error}\nDrawing a plot instead.")
                save_summary([episode], path)
        console.print(f"{path}")

    def _open(self, ready: Path | None, episode: EpisodeData | None) -> int:
        from carlab.recording.rerun.screenshot import rerun_program

        program = rerun_program()
        if program is None:
            raise NotReadyError("The viewer", ["the program 'rerun' is not installed; install rerun-sdk with pip."])
        if not has_screen():
            raise NotReadyError(
                "The viewer", ["this computer has no screen; use --save FILE.rrd or --screenshot FILE.png."]
            )
        with tempfile.TemporaryDirectory(prefix="carlab-view-") as folder:
            path = ready or self._rrd(ready, episode, Path(folder) / f"{self.recording.stem}.rrd")
            return subprocess.run([str(program), str(path), "--bind", "127.0.0.1"], check=False).returncode
