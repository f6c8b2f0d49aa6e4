"""Reading and writing of recordings in all supported formats."""

from __future__ import annotations

import html
import types
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from carlab.api.runs import html_table
from carlab.core.episode_data import EpisodeData
from carlab.core.errors import ConfigError, DataError
from carlab.recording.column_mapping import CHANNELS, ColumnMapping, load_mapping
from carlab.recording.episode_builder import RECOVERY
from carlab.recording.layouts import recognise_layout
from carlab.recording.ros.bag import is_bag

if TYPE_CHECKING:
    from carlab.recording.audit.report import AuditReport
    from carlab.recording.csv.foreign import ImportedRecording

CSV_ENDINGS = (".csv", ".csv.gz")


@dataclass(frozen=True, slots=True)
class Recording:
    """One recording file.

    Attributes:
        path: the file.
        episodes: one episode, or several if a CSV was split.
        announcement: recognised layout and conversions of a CSV or a ROS bag.
        audit: findings in a CSV or a ROS bag; None for carlab's MCAP.
        mapping: the column mapping of a CSV or a ROS bag; None if its layout was recognised.
        is_recovered: whether the MCAP file is incomplete and its complete ticks were recovered.
        recovery: predicate about an incomplete file: what is wrong, how many ticks were recovered, and the remedy.
    """

    path: Path
    episodes: tuple[EpisodeData, ...]
    announcement: str = ""
    audit: AuditReport | None = None
    mapping: ColumnMapping | None = None
    is_recovered: bool = False
    recovery: str = ""

    @property
    def episode(self) -> EpisodeData:
        """The longest episode."""
        return max(self.episodes, key=lambda episode: episode.ticks)

    @property
    def duration_s(self) -> float:
        """Driving time of all episodes [s]."""
        return float(sum(e.times_s[-1] - e.times_s[0] for e in self.episodes))

    def save(self, path: Path | str) -> Path:
        """Write the recording as .mcap, .csv, .csv.gz, .parquet, .rrd (rerun) or .png (summary picture).

        Args:
            path: the file to write; its ending chooses the format.

        Returns:
            The path.

        Raises:
            ConfigError: the ending is not one of these.
            DataError: the file exists or cannot be written, or several episodes do not fit into its format.
        """
        path = Path(path)
        name = path.name.lower()
        if not name.endswith((*CSV_ENDINGS, ".mcap", ".parquet", ".rrd", ".png")):
            raise ConfigError(f"{path}: name a .mcap, .csv, .csv.gz, .parquet, .rrd or .png file.")
        if path.exists():
            raise DataError(f"{path} exists already; remove it or choose another name.")
        if name.endswith(".png"):
            from carlab.recording.picture import save_summary

            save_summary(self.episodes, path, self.path.name)
            return path
        if len(self.episodes) > 1:
            raise DataError(f"{self.path} holds {len(self.episodes)} episodes; a {path.suffix} file can hold only one.")
        from carlab.recording.csv.export import write_csv, write_parquet
        from carlab.recording.mcap.sink import write_episode
        from carlab.recording.rerun.sink import episode_to_rrd

        if name.endswith(".rrd"):
            episode_to_rrd(self.episode, path, self.path.name)
        elif name.endswith(".mcap"):
            write_episode(self.episode, path)
        else:
            (write_parquet if name.endswith(".parquet") else write_csv)(self.episode, path)
        return path

    def __repr__(self) -> str:
        """One line: file, episodes, commands, seconds."""
        ticks = sum(episode.ticks for episode in self.episodes)
        episodes = "1 episode" if len(self.episodes) == 1 else f"{len(self.episodes)} episodes"
        return f"<Recording {self.path.name}: {episodes}, {ticks} commands, {self.duration_s:.1f} s>"

    def _repr_html_(self) -> str:
        rows = [] if self.audit is None else self.audit.rows()
        cells = [[severity, identity, channel, sentence] for severity, identity, channel, _, sentence, _ in rows]
        table = html_table(["severity", "finding", "channel", "sentence"], cells) if cells else ""
        return f"<p>{html.escape(repr(self).strip('<>'))}</p><p>{html.escape(self.announcement)}</p>{table}"


def is_csv(path: Path) -> bool:
    """Whether the file name ends in .csv or .csv.gz."""
    return path.name.lower().endswith(CSV_ENDINGS)


def load(path: Path | str, *, mapping: ColumnMapping | Path | str | None = None, **options: Any) -> Recording:
    """Read an MCAP recording, a CSV (.csv, .csv.gz) or a ROS bag (a .bag, .db3 or .mcap file, or a folder).

    Args:
        path: the file. An incomplete recording (.mcap.partial) is recovered.
        mapping: column mapping of a CSV or a bag, a TOML file or a ``ColumnMapping``; not needed for known layouts of
            a CSV.
        options: changes of the mapping, with the names of ``carlab import``'s options:
            ``velocity_frame="world"``, ``vx_unit="km/h"``, ``steering_sign=-1``, ``gaps="split"`` ...

    Returns:
        The recording; ``episodes`` have states in SI units, see ``carlab.core.episode_data.EpisodeData``.

    Raises:
        ConfigError: the file does not exist, or an option or mapping is invalid.
        DataError: the file cannot be read as declared.
    """
    if not isinstance(path, (str, Path)):
        raise ConfigError(
            f"carlab.load reads a file, but its argument has the type {type(path).__name__}; give a path. For your own "
            "arrays make a carlab.core.episode_data.EpisodeData."
        )
    path = required_file(Path(path))
    if is_foreign(path):
        resolved = resolved_mapping(path, mapping, options)
        imported = import_foreign(path, resolved)
        return Recording(path, imported.episodes, imported.announcement, imported.report, resolved)
    if mapping is not None or options:
        raise ConfigError(f"{path} is neither a CSV nor a ROS bag; remove the mapping and its options.")
    from carlab.recording.mcap.source import read_episode

    episode = read_episode(path)
    recovery = episode.metadata.get(RECOVERY, "")
    return Recording(path, (episode,), is_recovered=bool(recovery), recovery=recovery)


def is_foreign(path: Path) -> bool:
    """Whether a recording is of another program: a CSV or a ROS bag."""
    return is_csv(path) or is_bag(path)


def import_foreign(path: Path, mapping: ColumnMapping | None) -> ImportedRecording:
    """Import a CSV or a ROS bag. Raises ConfigError or DataError if it cannot be imported as declared."""
    from carlab.recording.csv.foreign import import_csv
    from carlab.recording.ros.bag_import import import_bag

    return (import_bag if is_bag(path) else import_csv)(path, mapping=mapping)


def required_file(path: Path, what: str = "The recording") -> Path:
    """Return the path of an existing file or folder of a ROS bag. Raises ConfigError for another path."""
    if not path.exists():
        from carlab.recording.sink import partial_path

        unfinished = partial_path(path)
        if path.suffix == ".mcap" and unfinished.is_file():
            raise ConfigError(
                f"{what} '{path}' does not exist, because its writer was stopped; name '{unfinished}', whose ticks can "
                "be read."
            )
        raise ConfigError(f"{what} '{path}' does not exist; check the path.")
    if path.is_dir() and not is_bag(path):
        raise ConfigError(
            f"{what} '{path}' is a folder; name a file in it (a run has episodes/0001.mcap). The folder of a ROS 2 bag "
            "needs its metadata.yaml, which 'ros2 bag reindex' writes."
        )
    return path


def is_run_folder(path: Path) -> bool:
    """Whether a path is the folder of a run of ``carlab drive`` or ``carlab learn``."""
    return (path / "environment.json").is_file() and (path / "episodes").is_dir()


def save_run(run: Path | str, path: Path | str) -> Path:
    """Write all episodes of a run as one file: .rrd (rerun, with a layout of tabs) or .png (picture).

    Args:
        run: folder of a run of ``carlab drive`` or ``carlab learn``.
        path: the file to write; its ending chooses the format. An existing file is replaced.

    Returns:
        The path.

    Raises:
        ConfigError: the folder is not a run's, or the ending is not one of these.
        DataError: no recording can be read, or the file cannot be written.
    """
    from carlab.experiment.campaign.report import PICTURE_FILE, learning_curve
    from carlab.experiment.campaign.run_recording import (
        readable_episodes,
        warn_of_recovered_files,
        write_run_recording,
    )
    from carlab.recording.picture import save_summary
    from carlab.recording.run_folder import RunDirectory

    run, path = Path(run), Path(path)
    if not is_run_folder(run):
        raise ConfigError(f"{run} is not the folder of a run; name one such as runs/2026-.., or a recording in it.")
    if path.suffix not in (".rrd", ".png"):
        raise ConfigError(f"{path}: name a file that ends in .rrd or .png.")
    directory = RunDirectory(run)
    warn_of_recovered_files(directory, partial=True)
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".rrd":
        write_run_recording(directory, {row.episode: row for row in learning_curve(directory)}, path)
    elif (run / PICTURE_FILE).is_file():
        path.write_bytes((run / PICTURE_FILE).read_bytes())
    else:
        save_summary(readable_episodes(directory), path, run.name)
    return path


CHANNEL_OPTIONS = ("unit", "sign", "scale", "neutral")
RENAMED_OPTIONS = {
    "velocity_lag": "velocity_lag_s",
    "yaw_offset": "yaw_offset_rad",
    "command_lag": "command_lag_s",
    "rate": "rate_hz",
}
"""Options of ``carlab import`` whose field of ``ColumnMapping`` has a unit in its name."""


def resolved_mapping(
    path: Path, mapping: ColumnMapping | Path | str | None, options: dict[str, Any]
) -> ColumnMapping | None:
    """The mapping with options; None without both, so that the layout of a CSV is recognised, or for a bag without one.

    Raises:
        ConfigError: the mapping file or an option is invalid.
    """
    from carlab.recording.csv.table import read_csv

    columns: dict[str, dict[str, Any]] = {}
    whole: dict[str, Any] = {}
    for name, value in options.items():
        channel, _, part = name.rpartition("_")
        if value is None:
            continue
        if part in CHANNEL_OPTIONS and channel in CHANNELS:
            columns.setdefault(channel, {})[part] = value
        else:
            whole[RENAMED_OPTIONS.get(name, name)] = value
    if isinstance(mapping, (str, Path)):
        mapping = load_mapping(mapping)
    if not isinstance(mapping, (ColumnMapping, types.NoneType)):
        raise ConfigError(f"mapping is {mapping!r}; give a TOML file or a ColumnMapping.")
    if not columns and not whole:
        return mapping
    if mapping is None and is_bag(path):
        return None
    if mapping is None:
        mapping = recognise_layout(read_csv(path).header, path.name, whole.get("rate_hz"))
    return mapping.with_options(columns=columns, **whole)
