"""Recordings of episodes: writing during the episode, reading, plotting, import and export."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from carlab.recording.csv.export import write_csv, write_parquet
    from carlab.recording.episode_builder import episode_from_documents
    from carlab.recording.mcap.sink import McapSink, write_episode
    from carlab.recording.mcap.source import read_documents, read_episode, read_recording
    from carlab.recording.picture import save_summary
    from carlab.recording.recorder import Recorder
    from carlab.recording.rerun.screenshot import save_screenshot
    from carlab.recording.rerun.sink import RerunSink, episode_to_rrd
    from carlab.recording.run_folder import RunDirectory
    from carlab.recording.sink import Sink

_MODULES = {
    "McapSink": "mcap.sink",
    "Recorder": "recorder",
    "RerunSink": "rerun.sink",
    "RunDirectory": "run_folder",
    "Sink": "sink",
    "episode_from_documents": "episode_builder",
    "episode_to_rrd": "rerun.sink",
    "read_documents": "mcap.source",
    "read_episode": "mcap.source",
    "read_recording": "mcap.source",
    "save_screenshot": "rerun.screenshot",
    "save_summary": "picture",
    "write_csv": "csv.export",
    "write_episode": "mcap.sink",
    "write_parquet": "csv.export",
}
__all__ = [
    "McapSink",
    "Recorder",
    "RerunSink",
    "RunDirectory",
    "Sink",
    "episode_from_documents",
    "episode_to_rrd",
    "read_documents",
    "read_episode",
    "read_recording",
    "save_screenshot",
    "save_summary",
    "write_csv",
    "write_episode",
    "write_parquet",
]


def __getattr__(name: str) -> Any:
    """Import a public name on first use, since rerun, pyarrow and matplotlib load slowly."""
    if name in _MODULES:
        return getattr(importlib.import_module(f"carlab.recording.{_MODULES[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
