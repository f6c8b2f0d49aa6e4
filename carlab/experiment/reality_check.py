"""After an episode: whether, where and how reality has left the simulator, in a process of its own.

The process that drives only waits, its car in neutral. The answer is a file beside the model that the episode was
driven with (``models/0003/diagnosis.json``). Nothing that goes wrong here ends a run: it is told in the answer.
"""

from __future__ import annotations

import json
import logging
import multiprocessing
import os
import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from carlab.core.errors import CarlabError
from carlab.recording.run_directory import RunDirectory
from sim_backends.car_parameters import SimulatorConfig

log = logging.getLogger(__name__)

CHECK_FILE = "diagnosis.json"
SIMULATOR_FILE = "simulator.toml"
POLL_S = 0.1
LEAST_EPISODES = 4
"""Recordings from which a full diagnosis can fit to some and judge by others."""


@dataclass(frozen=True, slots=True)
class RealityCheck:
    """A light diagnosis as it is kept: verdict, excess over the noise and its standard error, and what to tell."""

    episode: int
    verdict: str
    excess: float
    excess_std: float
    sentences: tuple[str, ...]
    short: str

    @classmethod
    def from_dict(cls, content: Mapping[str, Any]) -> RealityCheck:
        """Of a file. Raises KeyError, TypeError or ValueError where it is none."""
        excess, spread = (float("nan") if content[k] is None else float(content[k]) for k in ("excess", "score_std"))
        lines = tuple(str(s) for s in content["sentences"])
        return cls(int(content["episode"]), str(content["verdict"]), excess, spread, lines, str(content["short"]))


def check_path(run: RunDirectory, episode: int) -> Path:
    """Where the check of an episode lies."""
    return run.models / f"{episode:04d}" / CHECK_FILE


def check_beside(
    run: RunDirectory, simulator: SimulatorConfig, stop: Callable[[], bool] = lambda: False
) -> RealityCheck | None:
    """Check all recordings so far against the simulator, in another process; None where it was stopped.

    The check of the last episode is written into its model's folder, the simulator into ``simulator.toml`` of the run.
    """
    import tomli_w

    recordings = run.recordings()
    number = len(recordings)
    path = check_path(run, number)
    text = tomli_w.dumps(simulator.to_tables())
    context = multiprocessing.get_context("spawn")
    child = context.Process(target=_child, args=(path, run.path, recordings, text), daemon=True, name="reality check")
    try:
        (run.path / SIMULATOR_FILE).write_text(text, encoding="utf-8")
        child.start()
        while child.is_alive():
            if stop():
                child.terminate()
                child.join()
                return None
            child.join(POLL_S)
        return RealityCheck.from_dict(json.loads(path.read_text(encoding="utf-8")))
    except (OSError, ValueError, KeyError, TypeError) as error:
        code = f"exit code {child.exitcode}" if child.exitcode else str(error)
        log.warning("The light diagnosis of episode %d failed: %s", number, error)
        return RealityCheck.from_dict(_kept(path, number, _failed(f"its process failed ({code})")))


def check(run: Path, recordings: list[Path], simulator: SimulatorConfig) -> dict[str, Any]:
    """The content of the file: the light diagnosis of recordings, with what to tell.

    Raises:
        CarlabError: a recording cannot be read.
    """
    from carlab.diagnosis.light import look
    from carlab.diagnosis.light_text import sentences, short
    from carlab.experiment.training import has_ticks
    from carlab.recording.mcap_source import read_episode

    driven = [path for path in recordings if has_ticks(path)]
    told = look([read_episode(path) for path in driven], simulator)
    decide = f"carlab diagnose decides, from {LEAST_EPISODES} episodes on"
    command = next_step(run)
    if len(driven) >= LEAST_EPISODES:
        decide = f"what decides: {command}"
    return {
        **told.to_dict(), "sentences": sentences(told, decide), "short": short(told), "next": command,
        "recordings": [path.name for path in driven],
    }  # fmt: skip


def next_step(run: Path) -> str:
    """The command of the full diagnosis of a run."""
    return f"carlab diagnose {run} --car {run / SIMULATOR_FILE} --out {run / 'diagnosis'}"


def _child(path: Path, run: Path, recordings: list[Path], simulator_toml: str) -> None:
    import signal

    import torch

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # ^C is for the process that drives; it ends this one.
    torch.set_num_threads(1)
    try:
        told = check(run, recordings, SimulatorConfig.from_tables(tomllib.loads(simulator_toml)))
    except CarlabError as error:
        told = _failed(str(error))
    except Exception as error:
        log.exception("The light diagnosis failed")
        told = _failed(f"{type(error).__name__}: {error}")
    _kept(path, len(recordings), told)


def _failed(why: str) -> dict[str, Any]:
    text = f"The light diagnosis of this episode failed, learning goes on: {why.rstrip('.')}."
    return {"verdict": "failed", "why": why, "excess": None, "score_std": None, "sentences": [text], "short": ""}


def _kept(path: Path, episode: int, told: dict[str, Any]) -> dict[str, Any]:
    content = {"episode": episode, **told}
    unfinished = path.with_name(f"{path.name}.partial")
    try:
        unfinished.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
        os.replace(unfinished, path)
    except OSError as error:
        log.warning("%s cannot be written: %s", path, error)
    return content


__all__ = ["CHECK_FILE", "SIMULATOR_FILE", "RealityCheck", "check", "check_beside", "check_path", "next_step"]
