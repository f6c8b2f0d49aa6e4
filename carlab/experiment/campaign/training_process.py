"""Training in another process, so that it does not delay the control loop."""

from __future__ import annotations

import logging
import shutil
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Protocol

from carlab.core.errors import CarlabError, DataError
from carlab.core.safety import SafetyEnvelope
from carlab.experiment.campaign.child_process import child_context
from carlab.experiment.campaign.training import Progress, train
from carlab.experiment.campaign.training_plan import TrainingPlan

log = logging.getLogger(__name__)

POLL_S = 0.1


class TrainingDiedError(DataError):
    """The process of a training died."""


class Trainer(Protocol):
    """Trains like ``train_in_subprocess``, here or elsewhere; a car may be open meanwhile, and stays in neutral."""

    def __call__(
        self,
        plan: TrainingPlan,
        models: Path,
        recordings: list[Path],
        envelope: SafetyEnvelope,
        progress: Progress,
        stop: Callable[[], bool],
    ) -> dict[str, Any] | None:
        """Arguments, result and errors of ``train_in_subprocess``."""
        ...


def train_in_subprocess(
    plan: TrainingPlan,
    models: Path,
    recordings: list[Path],
    envelope: SafetyEnvelope,
    progress: Progress,
    stop: Callable[[], bool] = lambda: False,
) -> dict[str, Any] | None:
    """Run ``train`` in another process and wait for it.

    Args:
        plan: as for ``train``.
        models: as for ``train``.
        recordings: as for ``train``.
        envelope: as for ``train``.
        progress: as for ``train``.
        stop: polled; once true, the process is terminated and its partial result removed.

    Returns:
        The figures; None if ``stop`` ended it.

    Raises:
        DataError: ``train`` raised an error.
        TrainingDiedError: its process died.
    """
    context = child_context()
    receiver, sender = context.Pipe(duplex=False)
    child = context.Process(
        target=_child, args=(sender, plan, models, recordings, envelope), daemon=True, name="training"
    )
    child.start()
    sender.close()
    try:
        while True:
            if stop():
                return None
            if receiver.poll(POLL_S):
                try:
                    kind, content = receiver.recv()
                except EOFError:
                    child.join()
                    raise TrainingDiedError(
                        f"The training process died (exit code {child.exitcode}; -9 often means too little memory); "
                        "the recordings are kept. Resume the run with --resume."
                    ) from None
                if kind == "done":
                    figures: dict[str, Any] = content
                    return figures
                if kind == "failed":
                    raise DataError(str(content))
                progress(*content)
    finally:
        if child.is_alive():
            child.terminate()
        child.join()
        receiver.close()
        for unfinished in models.glob("*.partial"):
            shutil.rmtree(unfinished, ignore_errors=True)


def _child(
    pipe: Connection, plan: TrainingPlan, models: Path, recordings: list[Path], envelope: SafetyEnvelope
) -> None:
    import signal

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # The parent handles ^C and terminates this process.
    try:
        pipe.send(("done", train(plan, models, recordings, envelope, lambda *what: pipe.send(("at", what)))))
    except CarlabError as error:
        pipe.send(("failed", str(error)))
    except BrokenPipeError:
        pass
    except (Exception, SystemExit) as error:
        log.exception("Training failed")
        pipe.send(("failed", f"Training failed: {type(error).__name__}: {error}; the recordings are kept."))
    finally:
        pipe.close()


__all__ = ["Trainer", "TrainingDiedError", "train_in_subprocess"]
