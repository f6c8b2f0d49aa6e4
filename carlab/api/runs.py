"""Common parts of the calls that drive a car: the run's folder, and its results."""

from __future__ import annotations

import base64
import functools
import html
import logging
import math
import multiprocessing
import os
import shutil
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, ParamSpec

from carlab.core.errors import ConfigError, DataError, NotReadyError
from carlab.core.json_files import read_json
from carlab.core.version import VERSION
from carlab.experiment.episodes.hooks import RunHooks
from carlab.experiment.episodes.result import EpisodeResult

if TYPE_CHECKING:
    from rerun import RecordingStream

    from carlab.cars import CarChoice
    from carlab.recording.run_folder import RunDirectory

P = ParamSpec("P")


@contextmanager
def new_run(
    out: Path | str, name: str, choice: CarChoice, hooks: RunHooks, keep: str = "episodes"
) -> Iterator[RunDirectory]:
    """Create a run folder with the program's log; remove it finally if its subfolder ``keep`` is empty or missing.

    The folder is locked until the end of the run.

    Raises:
        ConfigError: a child process executes the program's script again.
        DataError: the folder cannot be written.
    """
    from carlab.recording.run_folder import RunDirectory

    _refuse_second_execution()
    run = RunDirectory.create(out, name, config_toml=choice.config_toml)
    with run.locked():
        try:
            with _logged(run, choice, hooks):
                yield run
        finally:
            if not any((run.path / keep).glob("*")):
                shutil.rmtree(run.path, ignore_errors=True)


@contextmanager
def existing_run(path: Path | str, choice: CarChoice, hooks: RunHooks) -> Iterator[RunDirectory]:
    """Open the folder of a resumed run, and lock it until the end of the run; the program's log is appended.

    Raises:
        ConfigError: another process writes the run, or a child process executes the program's script again.
        DataError: the path is not a run's folder, or it cannot be written.
    """
    from carlab.recording.run_folder import RunDirectory

    _refuse_second_execution()
    run = RunDirectory.open_existing(path)
    with run.locked(), _logged(run, choice, hooks):
        yield run


@contextmanager
def learning_run(path: Path) -> Iterator[None]:
    """Context that reads the folder of a run of ``carlab learn``.

    Raises:
        DataError: the path is no such folder, or it cannot be read; the message names another version that wrote it.
    """
    check_learning_run(path)
    try:
        yield
    except DataError as error:
        try:
            version = str(read_json(path / "environment.json").get("carlab", VERSION))
        except (OSError, ValueError):
            raise error from None
        if version == VERSION:
            raise
        raise DataError(
            f"{path} was written by carlab {version}, and carlab {VERSION} cannot read it; use that version."
        ) from error


def check_learning_run(path: Path) -> None:
    """Raise DataError if a path is not the folder of a run of ``carlab learn``."""
    from carlab.experiment.campaign.campaign import CAMPAIGN_FILE

    if not (path / CAMPAIGN_FILE).is_file():
        raise DataError(
            f"{path} is not the folder of a run of carlab learn (it has no {CAMPAIGN_FILE}); name one such as "
            "runs/2026-11-24_120000_learn."
        )


def _refuse_second_execution() -> None:
    """Raise ConfigError in a child process that executes the program's script again: it would open the car twice."""
    if getattr(multiprocessing.current_process(), "_inheriting", False):
        raise ConfigError(
            "The processes of a run execute your script again; put its calls of carlab under "
            "'if __name__ == \"__main__\":'."
        )


@contextmanager
def _logged(run: RunDirectory, choice: CarChoice, hooks: RunHooks) -> Iterator[None]:
    choice.log_to(run.path)
    hooks.on_start(run.path, choice.car)
    handler = run.log_handler()
    logging.getLogger().addHandler(handler)
    try:
        yield
    finally:
        logging.getLogger().removeHandler(handler)
        handler.close()


def has_screen() -> bool:
    """Whether a window can be opened."""
    return sys.platform != "linux" or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def viewer_program(instead: str) -> Path:
    """The program of the rerun viewer.

    Args:
        instead: what a person can do on a computer without a screen.

    Raises:
        NotReadyError: the program is not installed, or the computer has no screen.
    """
    from carlab.recording.rerun.viewer import rerun_program

    program = rerun_program()
    if program is None:
        raise NotReadyError("The viewer", ["the program 'rerun' is not installed; install rerun-sdk with pip."])
    if not has_screen():
        raise NotReadyError("The viewer", [f"this computer has no screen; {instead}."])
    return program


def viewer_connection(live: bool, viewer: str | None) -> Callable[[RecordingStream], None] | None:
    """How a run reaches the viewer that shows it; None without a live view.

    Args:
        live: open a viewer on this computer.
        viewer: address of an open viewer, which is used instead.

    Raises:
        ConfigError: the address is invalid.
        NotReadyError: no viewer can be opened here, or none listens at the address.
    """
    if viewer is not None:
        from rerun import RecordingStream

        from carlab.recording.rerun.viewer import check_viewer

        check_viewer(viewer)
        return functools.partial(RecordingStream.connect_grpc, url=viewer)
    if not live:
        return None
    from carlab.recording.rerun.viewer import open_viewer

    program = viewer_program("name a viewer on another one with --viewer, or use carlab view RUN after the run")
    return functools.partial(open_viewer, program=program)


def followed_by(first: Callable[P, None], second: Callable[P, None]) -> Callable[P, None]:
    """A callback that calls two."""

    def both(*args: P.args, **kwargs: P.kwargs) -> None:
        first(*args, **kwargs)
        second(*args, **kwargs)

    return both


def collecting(hooks: RunHooks, run: RunDirectory, results: list[EpisodeResult]) -> RunHooks:
    """The hooks; each finished episode is also appended to ``results`` and to result.json."""

    def on_result(result: EpisodeResult) -> None:
        write_result(run, [*results, result])
        results.append(result)
        hooks.on_result(result)

    return replace(hooks, on_result=on_result)


def write_result(run: RunDirectory, results: Sequence[EpisodeResult]) -> None:
    """Write result.json: end reason and figures of each episode, also of the earlier episodes of a resumed run."""
    from carlab.recording.run_folder import RESULT_FILE

    now = {result.episode for result in results}
    episodes = [row for row in run.result_rows if row["episode"] not in now] + [
        {
            "episode": result.episode,
            "ticks": result.data.ticks,
            "return": result.total_reward,
            **{name: None if not math.isfinite(value) else value for name, value in result.summary.items()},
            "end_reason": result.reason.name,
            "end_detail": result.data.metadata["end_detail"],
        }
        for result in results
    ]
    episodes.sort(key=lambda row: int(row["episode"]))
    run.write_json(RESULT_FILE, {"end_reason": episodes[-1].get("end_reason"), "episodes": episodes})


def figure_names(results: Sequence[EpisodeResult]) -> list[str]:
    """Names of the figures in the summaries of episodes; an episode may lack some of them."""
    return list(dict.fromkeys(name for result in results for name in result.summary))


def html_table(columns: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """A table for a notebook; numbers with four digits."""

    def cell(value: object) -> str:
        return html.escape(f"{value:.4g}" if isinstance(value, float) else str(value))

    head = "".join(f"<th>{html.escape(column)}</th>" for column in columns)
    body = "".join("<tr>" + "".join(f"<td>{cell(value)}</td>" for value in row) + "</tr>" for row in rows)
    return f"<table><tr>{head}</tr>{body}</table>"


def html_picture(path: Path) -> str:
    """A PNG file for a notebook; empty if the file does not exist."""
    if not path.is_file():
        return ""
    data = base64.b64encode(path.read_bytes()).decode()
    return f'<img style="max-width:100%" src="data:image/png;base64,{data}">'
