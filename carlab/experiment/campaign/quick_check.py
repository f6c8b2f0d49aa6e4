"""The quick check after each episode: whether the simulator still explains the recordings, in another process.

The result is a file in the model folder of the episode (``models/0003/diagnosis.json``). An error of the check becomes
part of the result; the run continues.
"""

from __future__ import annotations

import logging
import math
import shlex
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tomli_w

from carlab.core.errors import DataError
from carlab.core.toml_files import toml_tables
from carlab.experiment.campaign.child_process import ChildError, run_in_child
from carlab.recording.atomic_files import write_json
from carlab.recording.mcap.source import has_ticks, read_episode
from carlab.recording.run_folder import RunDirectory
from sim_backends.car_parameters import SimulatorConfig

log = logging.getLogger(__name__)

CHECK_FILE = "diagnosis.json"
SIMULATOR_FILE = "simulator.toml"
MIN_DIAGNOSIS_EPISODES = 4
"""Minimum number of recordings of a full diagnosis, which fits to some and validates on the others."""


@dataclass(frozen=True, slots=True)
class EpisodeCheck:
    """Result of a quick check: verdict, excess over the noise floor with its standard error, and messages."""

    episode: int
    verdict: str
    excess: float
    excess_std: float
    sentences: tuple[str, ...]
    short: str


def check_path(run: RunDirectory, episode: int) -> Path:
    """File of the check of an episode."""
    return run.models / f"{episode:04d}" / CHECK_FILE


def run_check_subprocess(
    run: RunDirectory, simulator: SimulatorConfig, stop: Callable[[], bool] = lambda: False
) -> EpisodeCheck | None:
    """Check all recordings so far against the simulator, in another process; None if it was stopped.

    The result is written to the model folder of the last episode, the simulator to ``simulator.toml`` of the run.
    """
    recordings = run.recordings()
    number = len(recordings)
    path = check_path(run, number)
    text = tomli_w.dumps(simulator.to_tables())
    try:
        (run.path / SIMULATOR_FILE).write_text(text, encoding="utf-8")
        result = run_in_child("quick check", check, (run.path, recordings, text), stop)
    except (ChildError, OSError) as error:
        if isinstance(error, ChildError) and error.end != "died":
            result = _failed(str(error))
        else:
            log.warning("The quick check of episode %d failed: %s", number, error)
            result = _failed(f"its process failed ({error})")
    if result is None:
        return None
    try:
        write_json(path, {"episode": number, **result})
    except DataError as error:
        log.warning("The quick check is not stored: %s", error)
    excess, std = (math.nan if result[name] is None else result[name] for name in ("excess", "score_std"))
    return EpisodeCheck(number, result["verdict"], excess, std, tuple(result["sentences"]), result["short"])


def check(run: Path, recordings: list[Path], simulator_toml: str) -> dict[str, Any]:
    """Run the quick check of recordings; returns the content of the file, with the messages.

    Raises:
        CarlabError: a recording cannot be read.
    """
    from carlab.diagnosis.quick.quick_check import quick_check
    from carlab.diagnosis.quick.sentences import sentences, short

    driven = [path for path in recordings if has_ticks(path)]
    simulator = SimulatorConfig.from_tables(toml_tables(simulator_toml))
    result = quick_check([read_episode(path) for path in driven], simulator)
    decide = f"carlab diagnose decides, from {MIN_DIAGNOSIS_EPISODES} episodes on"
    command = next_step(run)
    if len(driven) >= MIN_DIAGNOSIS_EPISODES:
        decide = f"this command decides: {command}"
    return {
        **result.to_dict(), "sentences": sentences(result, decide), "short": short(result), "next": command,
        "recordings": [path.name for path in driven],
    }  # fmt: skip


def next_step(run: Path) -> str:
    """The command of the full diagnosis of a run."""
    files = (run, "--car", run / SIMULATOR_FILE, "--out", run / "diagnosis")
    return shlex.join(["carlab", "diagnose", *map(str, files)])


def _failed(reason: str) -> dict[str, Any]:
    text = f"The quick check of this episode failed ({reason.rstrip('.')}); learning continues."
    return {"verdict": "failed", "why": reason, "excess": None, "score_std": None, "sentences": [text], "short": ""}
