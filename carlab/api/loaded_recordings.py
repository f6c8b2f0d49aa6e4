"""Recordings of a diagnosis, comparison or prediction: read, assigned to roles, and repaired."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from carlab.api.recordings import Recording, is_csv, load, required_file
from carlab.core.episode_data import EpisodeData
from carlab.core.errors import ConfigError, DataError
from carlab.core.hashes import sha256_of
from carlab.recording.ros.bag import is_bag

if TYPE_CHECKING:
    from carlab.diagnosis.findings import DataFault, RecordingUse

RecordingSource: TypeAlias = "Recording | EpisodeData | Path"
RecordingLike: TypeAlias = "RecordingSource | str"
"""A Recording, an EpisodeData, or the path of an MCAP, a CSV or a run's folder."""
REPORTED_FAULTS = (
    *("yaw_wrap_spikes", "outliers", "stale_samples", "clock_drift", "column_shift", "column_scale"),
    *("wrong_unit", "wrong_sign", "wrong_frame", "integration_error"),
)
"""Findings of the CSV audit that the report lists as data faults if they were repaired."""
LEFT_OUT_ROWS = ("not_a_number", "stamp_order")
"""Findings of the CSV audit about rows that were left out; the report lists them too."""
INCOMPLETE_FILE = "incomplete_file"
"""Data fault of an MCAP file of which only the complete ticks were recovered; its channel is the path."""


@dataclass(slots=True)
class LoadedRecordings:
    """Episodes with the names of their recordings and data faults; ``notes`` are sentences about conversions."""

    episodes: list[EpisodeData] = field(default_factory=list)
    names: list[str] = field(default_factory=list)
    faults: list[DataFault] = field(default_factory=list)
    uses: list[RecordingUse] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


def as_list(given: RecordingLike | Iterable[RecordingLike]) -> list[RecordingSource]:
    """Recordings as a list, with strings converted to paths. Raises ConfigError for another type."""
    kinds = (str, Path, Recording, EpisodeData)
    items = list(given) if isinstance(given, Iterable) and not isinstance(given, kinds) else [given]
    for item in items:
        if not isinstance(item, kinds):
            raise ConfigError(
                f"An object of type {type(item).__name__} is no recording; give a path, a Recording, or an EpisodeData "
                "of your own arrays (carlab.core.episode_data)."
            )
    return [Path(item) if isinstance(item, str) else item for item in items]


def assigned(
    recordings: list[RecordingSource], held_out: list[RecordingSource]
) -> tuple[list[RecordingSource], list[RecordingSource]]:
    """Recordings to fit and to hold out, with run folders resolved. Raises ConfigError if one is both."""
    if not recordings:
        raise ConfigError(
            "Name at least one recording to fit, before --held-out, which takes all names after it, for example carlab "
            "diagnose drive.mcap --held-out other.mcap."
        )
    to_fit: list[RecordingSource] = []
    to_validate = list(held_out)
    for item in recordings:
        fitted, validated = _episodes_of_run(item)
        to_fit += fitted
        to_validate += validated
    _check_repetition(to_fit, to_validate, "is both fitted and held out; remove it from one of the lists")
    return to_fit, to_validate


def recordings_of_runs(
    first: list[RecordingSource], second: list[RecordingSource]
) -> tuple[list[RecordingSource], list[RecordingSource]]:
    """Two groups with run folders replaced by their episodes. Raises ConfigError if a recording is in both."""
    groups: list[list[RecordingSource]] = []
    for items in (first, second):
        resolved = [_episodes_of_run(item) for item in items]
        groups.append([recording for fitted, validated in resolved for recording in (*fitted, *validated)])
    _check_repetition(groups[0], groups[1], "is in both groups; remove it from one of them")
    return groups[0], groups[1]


def _check_repetition(first: list[RecordingSource], second: list[RecordingSource], in_both: str) -> None:
    """Raise ConfigError with ``in_both`` for a file in both lists, and for one that is given twice.

    A file may be given by itself and by its run folder.
    """
    paths = [[path for item in items if (path := _path_of(item))] for items in (first, second)]
    of_first, of_second = ({path.resolve() for path in items} for items in paths)
    if same := of_first & of_second:
        raise ConfigError(f"{min(same).name} {in_both}.")
    known: set[Path] = set()
    for path in (*paths[0], *paths[1]):
        if path.resolve() in known:
            raise ConfigError(f"{path} is given twice; name it once.")
        known.add(path.resolve())


def check_contents(uses: Iterable[RecordingUse]) -> None:
    """Raise ConfigError if two recordings have the same content: a copy of a fitted recording is not held out."""
    known: dict[str, str] = {}
    for use in uses:
        if use.sha256 in known:
            raise ConfigError(f"{use.path} has the content of {known[use.sha256]}; name one of them.")
        known[use.sha256] = use.path


def _episodes_of_run(item: RecordingSource) -> tuple[Sequence[RecordingSource], Sequence[RecordingSource]]:
    """Episodes of a run folder to fit and to hold out (every third); for others the recording itself, to fit."""
    if not isinstance(item, Path) or not item.is_dir() or is_bag(item):
        return [item], []
    if not (item / "episodes").is_dir():
        runs = sorted(entry for entry in item.iterdir() if (entry / "episodes").is_dir())
        example = f", for example {runs[-1]}" if runs else ""
        raise ConfigError(f"{item} is not the folder of a run; name a run folder{example}, or a recording.")
    from carlab.recording.mcap.source import has_ticks

    driven = [recording for recording in sorted((item / "episodes").glob("*.mcap")) if has_ticks(recording)]
    if not driven:
        raise ConfigError(f"{item} has no finished episode; drive one first.")
    return [p for k, p in enumerate(driven) if k % 3 != 2], driven[2::3]


def _path_of(item: RecordingSource) -> Path | None:
    return item.path if isinstance(item, Recording) else item if isinstance(item, Path) else None


def load_recordings(items: list[RecordingSource], role: str, latency_s: float) -> LoadedRecordings:
    """Read episodes for a diagnosis: CSV files are repaired, and states with recorded ages get one known age."""
    loaded = LoadedRecordings()
    for item in items:
        loaded.uses.append(_read_item(item, role, latency_s, loaded))
        loaded.names += [loaded.uses[-1].path] * (len(loaded.episodes) - len(loaded.names))
    return loaded


def _read_item(item: RecordingSource, role: str, latency_s: float, loaded: LoadedRecordings) -> RecordingUse:
    """Add the episodes of one recording."""
    from carlab.diagnosis.findings import DataFault, RecordingUse
    from carlab.diagnosis.state_alignment import align_states

    if isinstance(item, EpisodeData):
        _check_arrays(item)
        loaded.episodes.append(align_states(_without_corrupt_numbers(item), latency_s))
        digest = hashlib.sha256(item.times_s.tobytes() + item.states.tobytes()).hexdigest()
        return RecordingUse(str(item.metadata.get("source", "episode")), digest, role)
    path = item.path if isinstance(item, Recording) else item
    if is_csv(required_file(path)):
        _read_csv(path, item.mapping if isinstance(item, Recording) else None, latency_s, loaded)
    else:
        read = item if isinstance(item, Recording) else load(path)
        loaded.episodes += [align_states(_without_corrupt_numbers(each), latency_s) for each in read.episodes]
        if read.is_recovered:
            missing_ticks = int(read.episode.metadata.get("missing_ticks", 0))
            text = f"reported: the file {read.recovery}."
            loaded.faults.append(DataFault(INCOMPLETE_FILE, str(path), missing_ticks, text))
    return RecordingUse(str(path), sha256_of(path), role)


def _check_arrays(episode: EpisodeData) -> None:
    """Raise DataError if times do not increase or are not in seconds, or if commands exceed [-1, 1]."""
    from carlab.recording.audit.file_checks import MAX_COMMAND, MAX_PERIOD_S

    if not np.all(np.diff(episode.times_s) > 0.0):
        raise DataError("times_s of an EpisodeData does not increase from row to row; sort the rows.")
    if episode.period_s > MAX_PERIOD_S:
        raise DataError(f"The rows of an EpisodeData are {episode.period_s:.4g} s apart; give times_s in seconds.")
    largest = float(np.abs(np.nan_to_num(episode.sent)).max(initial=0.0))
    if largest > MAX_COMMAND:
        raise DataError(
            f"The commands of an EpisodeData reach {largest:.4g} where commands lie in [-1, 1]; divide them by the "
            "full command."
        )


def _without_corrupt_numbers(episode: EpisodeData) -> EpisodeData:
    """The episode with NaN for states that no car has, and without such poses."""
    from carlab.recording.audit.file_checks import MAX_NUMBER

    is_plausible = np.abs(episode.states) <= MAX_NUMBER
    poses = episode.poses[(np.abs(episode.poses[:, 1:]) <= MAX_NUMBER).all(axis=1)]
    return replace(episode, states=np.where(is_plausible, episode.states, np.nan), poses=poses)


def _read_csv(path: Path, mapping: Any, latency_s: float, loaded: LoadedRecordings) -> None:
    """Add a CSV's episodes and its repaired data faults; the diagnosis detects faults without repair itself."""
    from carlab.diagnosis.findings import DataFault
    from carlab.diagnosis.state_alignment import align_states
    from carlab.recording.audit.report import Severity
    from carlab.recording.csv.repairing_import import import_repaired

    read = import_repaired(path, mapping=mapping)
    loaded.episodes += [align_states(episode, latency_s) for episode in read.episodes]
    loaded.notes.append(read.announcement)
    repaired = [f for f in read.report.findings if f.severity is Severity.REPAIRED]
    left_out = [f for f in repaired if f.id in LEFT_OUT_ROWS]
    rows = read.episodes[-1].ticks + 1
    loaded.faults += [
        DataFault(f.id, f.channel, f.count or rows, f"repaired: {f.sentence}")
        for f in (*(f for f in (*read.repaired, *repaired) if f.id in REPORTED_FAULTS), *left_out)
    ]
