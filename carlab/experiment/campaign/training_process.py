"""Training in another process, so that it does not delay the control loop."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from typing import Any

from carlab.core.errors import DataError
from carlab.experiment.campaign.child_process import ChildError, run_in_child
from carlab.experiment.campaign.training import Progress, TrainingRequest, train


class TrainingDiedError(DataError):
    """The process of a training died."""


Trainer = Callable[[TrainingRequest, Progress, Callable[[], bool]], dict[str, Any] | None]
"""Trains like ``train_in_subprocess``, here or elsewhere; a car may be open meanwhile, and stays in neutral."""


def train_in_subprocess(
    request: TrainingRequest, progress: Progress, stop: Callable[[], bool] = lambda: False
) -> dict[str, Any] | None:
    """Run ``train`` in another process and wait for it.

    Args:
        request: as for ``train``.
        progress: as for ``train``.
        stop: polled; once true, the process is terminated and its partial result removed.

    Returns:
        The figures; None if ``stop`` ended it.

    Raises:
        DataError: ``train`` raised an error.
        TrainingDiedError: its process died.
    """
    try:
        figures: dict[str, Any] | None = run_in_child("training", train, (request,), stop, on_report=progress)
    except ChildError as error:
        recorded = "; the recordings remain" if request.recordings else ""
        if error.end == "died":
            remedy = "Resume the run with --resume." if request.recordings else "Start the run again."
            raise TrainingDiedError(
                f"The training process died ({error}; -9 often means too little memory){recorded}. {remedy}"
            ) from None
        crash = f"Training failed: {error}{recorded}."
        raise DataError(str(error) if error.end == "failed" else crash) from None
    finally:
        for unfinished in request.models.glob("*.partial"):
            shutil.rmtree(unfinished, ignore_errors=True)
    return figures
