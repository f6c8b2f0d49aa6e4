"""Comparison of two groups of recordings of one car."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from carlab.api.cars import load_car
from carlab.api.loaded_recordings import RecordingLike, as_list, check_contents, recordings_of_runs
from carlab.api.loaded_recordings import load_recordings as read
from carlab.core.errors import ConfigError
from carlab.core.tables import nearest_name
from carlab.recording.atomic_files import write_json
from carlab.recording.sink import make_folder, writing

if TYPE_CHECKING:
    from carlab.cars import CarFile
    from carlab.diagnosis.comparison.result import Comparison

FILE_NAME = "compare.json"


_NEEDS_TWO_GROUPS = (
    "A comparison needs two groups; name the first one before --with, which takes all names after it, for example "
    "carlab compare monday.mcap --with friday.mcap."
)


def compare(
    recordings: RecordingLike | Iterable[RecordingLike],
    changed: RecordingLike | Iterable[RecordingLike],
    car: str | Path | CarFile = "sim",
    *,
    candidates: Sequence[str] = (),
    out: Path | str | None = None,
    progress: Callable[[str, float], None] = lambda activity, share: None,
    stop: Callable[[], bool] = lambda: False,
) -> Comparison:
    """Find what changed between two groups of recordings of one car.

    Args:
        recordings: first group: recordings, episodes, or paths of MCAP or CSV files or of run folders.
        changed: second group.
        car: simulator of the car: a car file (preferably the model of a diagnosis), its path, or a name: ``sim`` (the
            default car) or a preset (``eth_rc_car`` ...).
        candidates: restrict the changes to these effects and base parameters (``motor.drive_gain`` ...).
        out: folder for compare.json (schema ``carlab.compare/1``); nothing is written by default.
        progress: callback with the activity and the completed share in [0, 1].
        stop: callback; if it returns true, the changes so far are the result.

    Returns:
        The smallest set of changes with 90 % intervals; verdict "changed", "nothing", or "inconclusive" after a stop.

    Raises:
        ConfigError: a group is empty, a recording is in both groups, or a candidate does not exist.
        DataError: a recording cannot be read, or a group is too short or too uniform; the message has the remedy.
    """
    from carlab.diagnosis.comparison.candidates import change_candidates
    from carlab.diagnosis.comparison.compare import compare as search

    file = load_car(car)
    first, second = as_list(recordings), as_list(changed)
    if not first or not second:
        raise ConfigError(_NEEDS_TWO_GROUPS)
    first, second = recordings_of_runs(first, second)
    known = [c.id for c in change_candidates(file.simulator)]
    candidates = (candidates,) if isinstance(candidates, str) else candidates
    for name in candidates:
        if name not in known:
            raise ConfigError(f"'{name}' cannot change in this car; {nearest_name(name, known)}")
    latency_s = file.simulator.latency_s()
    groups = [read(items, role, latency_s) for items, role in ((first, "first group"), (second, "second group"))]
    check_contents([use for group in groups for use in group.uses])
    found = search(
        groups[0].episodes,
        groups[1].episodes,
        file.simulator,
        candidates=tuple(candidates) or None,
        progress=progress,
        stop=stop,
    )
    faults_of_files = tuple(fault for group in groups for fault in group.faults)
    found = replace(found, data_faults=(*faults_of_files, *found.data_faults))
    if out is not None:
        with writing(folder := Path(out)):
            make_folder(folder)
        write_json(folder / FILE_NAME, found.to_dict())
    return found
