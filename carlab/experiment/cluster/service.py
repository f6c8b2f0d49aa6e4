"""Training on a machine of the cluster: receives files, trains in a child process, and hands out the result."""

from __future__ import annotations

import hashlib
import logging
import os
import platform
import tempfile
import threading
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from carlab.core.clock import MonotonicClock
from carlab.core.errors import CarlabError, ConfigError
from carlab.experiment.campaign.training_process import TrainingDiedError, train_in_subprocess
from carlab.experiment.cluster.order import TrainingOrder
from carlab.jobs.child_jobs import write_files
from carlab.jobs.ray_executor import require_same_version
from learning.devices import available

log = logging.getLogger(__name__)

IDLE_POLL_S = 5.0


def sha256(content: bytes) -> str:
    """Name of a content."""
    return hashlib.sha256(content).hexdigest()


@dataclass
class _Training:
    """One training.

    Attributes:
        manifest: contents of the order's files (SHA-256) by name.
        state: ``training``, ``done``, ``failed`` (as it would fail anywhere) or ``lost`` (by a fault of this machine).
    """

    manifest: dict[str, str]
    stopped: threading.Event = field(default_factory=threading.Event)
    state: str = "training"
    message: str = ""
    activity: tuple[str, int, int] = ("starting", 0, 1)
    result: dict[str, bytes] = field(default_factory=dict)
    thread: threading.Thread | None = None


class TrainingService:
    """Trains one order at a time. All arguments and results are texts, numbers and bytes of files.

    Args:
        version: version of carlab of the sender.
        device: of the trainings.
        idle_s: time without a question after which this process ends, even if it trains [s]; None: it does not end.

    Raises:
        ConfigError: this machine has another version, or not the device.
    """

    def __init__(self, version: str, device: str = "cpu", idle_s: float | None = None) -> None:
        require_same_version(version)
        try:
            available(device)
        except ConfigError as error:
            raise ConfigError(f"On the machine {platform.node()} of the cluster: {error}") from error
        self._contents: dict[str, bytes] = {}
        self._training: _Training | None = None
        self._lock = threading.Lock()
        self._clock = MonotonicClock()
        self._asked_s = self._clock.now_s()
        if idle_s is not None:
            threading.Thread(target=self._end_when_idle, args=(idle_s,), name="idle", daemon=True).start()

    def missing(self, manifest: Mapping[str, str]) -> list[str]:
        """The files of an order that have not arrived, by name. Contents that it does not need are dropped."""
        self._asked_s = self._clock.now_s()
        needed = set(manifest.values())
        self._contents = {k: v for k, v in self._contents.items() if k in needed}
        return [name for name, content in manifest.items() if content not in self._contents]

    def receive(self, content: bytes) -> None:
        """Keep the content of a file."""
        self._asked_s = self._clock.now_s()
        self._contents[sha256(content)] = content

    def begin(self, manifest: Mapping[str, str]) -> None:
        """Start a training, unless the same one runs or has ended; another one is stopped."""
        self._asked_s = self._clock.now_s()
        with self._lock:
            running = self._training
            if running is not None and running.manifest == manifest and running.state != "lost":
                return
            self.stop()
            files = {name: self._contents[content] for name, content in manifest.items()}
            training = _Training(dict(manifest))
            training.thread = threading.Thread(target=self._train, args=(training, files), name="training", daemon=True)
            self._training = training
            training.thread.start()

    def state(self) -> dict[str, Any]:
        """State of the training: ``state``, ``message``, ``activity`` (name, done, total).

        If it is done also ``files``: contents of the result (SHA-256) by name.
        """
        self._asked_s = self._clock.now_s()
        training = self._training
        if training is None:
            return {"state": "lost", "message": "there is no training", "activity": ("", 0, 1), "files": {}}
        return {
            "state": training.state,
            "message": training.message,
            "activity": training.activity,
            "files": {k: sha256(v) for k, v in training.result.items()} if training.state == "done" else {},
        }

    def fetch(self, name: str) -> bytes:
        """Content of a file of the result."""
        self._asked_s = self._clock.now_s()
        assert self._training is not None
        return self._training.result[name]

    def stop(self) -> None:
        """Stop the training and wait for the end of its process."""
        if self._training is not None and self._training.thread is not None:
            self._training.stopped.set()
            self._training.thread.join()

    def _end_when_idle(self, idle_s: float) -> None:
        while self._clock.now_s() - self._asked_s < idle_s:
            self._clock.sleep_until(self._clock.now_s() + min(IDLE_POLL_S, idle_s))
        self.stop()
        os._exit(0)

    def _train(self, training: _Training, files: Mapping[str, bytes]) -> None:
        def on_progress(activity: str, done: int, total: int) -> None:
            training.activity = (activity, done, total)

        with tempfile.TemporaryDirectory(prefix="training-") as fresh:
            try:
                write_files(Path(fresh), files)
                order = TrainingOrder.read(Path(fresh))
                train_in_subprocess(order, on_progress, training.stopped.is_set)
                if not training.stopped.is_set():
                    training.result = order.result()
                    training.state = "done"
            except TrainingDiedError as error:
                training.message, training.state = str(error), "lost"
            except CarlabError as error:
                training.message, training.state = str(error), "failed"
            except Exception as error:
                log.exception("Training failed")
                training.message, training.state = f"{type(error).__name__}: {error}", "lost"
