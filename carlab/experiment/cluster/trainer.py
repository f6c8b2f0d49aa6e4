"""Trains on a cluster; waits if the link is lost, and then trains on this computer."""

from __future__ import annotations

import logging
import shutil
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from carlab.core.clock import Clock, MonotonicClock
from carlab.core.errors import ConfigError, DataError
from carlab.experiment.campaign.training import Progress, TrainingRequest
from carlab.experiment.campaign.training_plan import TrainingPlan
from carlab.experiment.campaign.training_process import Trainer, train_in_subprocess
from carlab.experiment.cluster.link_process import LinkProcess
from carlab.experiment.cluster.link_protocol import LinkEvent, LinkRequest
from carlab.experiment.cluster.order import TrainingOrder
from carlab.experiment.cluster.settings import LinkSettings
from carlab.jobs.child_jobs import write_files
from carlab.recording.sink import describe_os_error
from learning.devices import available

log = logging.getLogger(__name__)

POLL_S = 0.1


class _RunHereError(Exception):
    """The cluster cannot train; the text says why."""


@dataclass
class ClusterTrainer:
    """A ``Trainer`` that trains on a cluster. Use it as a context manager.

    If the cluster does not answer for ``settings.wait_s``, the training runs on this computer. The next training tries
    the cluster again. This process reads no message and no file of the cluster with pickle.

    Attributes:
        address: of the cluster, for messages.
        link: link to it.
        say: receives sentences about the link.
        settings: times of the link.
        train_here: trains on this computer.
        clock: measures the times.
        is_lost: whether the last training ran on this computer.
    """

    address: str
    link: LinkProcess
    say: Callable[[str], None]
    settings: LinkSettings = field(default_factory=LinkSettings)
    train_here: Trainer = train_in_subprocess
    clock: Clock = field(default_factory=MonotonicClock)
    is_lost: bool = False

    def __enter__(self) -> ClusterTrainer:
        """Open the link, with a second attempt. Raises ConfigError if the cluster does not answer or cannot be used."""
        try:
            if not self._connects(is_last=False):
                self._connects(is_last=True)
        except BaseException:
            self.link.close()
            raise
        return self

    def _connects(self, *, is_last: bool) -> bool:
        """Whether the link connects to the cluster; the last attempt raises ConfigError in place of False."""
        self.link.send(None)
        began_s = self.clock.now_s()
        while (event := self.link.poll(POLL_S)) is None or event.kind != "connected":
            if event is not None and event.kind == "unreachable" and not is_last:
                self.link.cut()
                return False
            if event is not None:
                raise ConfigError(event.message)
            if self.clock.now_s() - began_s > self.settings.connect_s:
                raise ConfigError(
                    f"--ray {self.address}: the cluster has not answered for {self.settings.connect_s:g} s; check that "
                    "it has a free core (or GPU), or leave out --ray."
                )
        return True

    def __exit__(self, *exc_info: object) -> None:
        """End the service on the cluster, and close the link."""
        self.link.close()

    def __call__(
        self, request: TrainingRequest, progress: Progress, stop: Callable[[], bool] = lambda: False
    ) -> dict[str, Any] | None:
        """Train on the cluster, or on this computer if the cluster does not answer; as ``train_in_subprocess``.

        Raises:
            ConfigError: the task is an object of a Python program, which cannot be sent as data.
            DataError: the training failed, or its files cannot be read or written.
        """
        order = TrainingOrder(request.plan, request.models, request.recordings, request.envelope)
        arrived = order.folder.with_name(f"{order.folder.name}.partial")
        shutil.rmtree(arrived, ignore_errors=True)
        try:
            with tempfile.TemporaryDirectory(prefix="order-") as folder:
                write_files(Path(folder), _files_of(order))
                waiting = _Waiting(self, LinkRequest(folder, str(arrived)), order.number, progress)
                return self._published(order, arrived) if waiting.until_done(stop) else None
        except OSError as error:
            raise DataError(describe_os_error(error, request.models)) from error
        except _RunHereError as error:
            reason = str(error)
        finally:
            shutil.rmtree(arrived, ignore_errors=True)
        self.link.cut()
        self.is_lost = True
        self.say(f"{reason}; the training before episode {order.number} runs on this computer.")
        return self.train_here(replace(request, plan=_plan_here(request.plan)), progress, stop)

    def _published(self, order: TrainingOrder, arrived: Path) -> dict[str, Any]:
        try:
            return order.publish(arrived)
        except DataError as error:
            log.warning("The model from the cluster is discarded: %s", error)
            reason = str(error).partition(";")[0]
            raise _RunHereError(f"The model from the cluster {self.address} cannot be used ({reason})") from error


class _Waiting:
    """One training on the cluster, before the episode ``number``."""

    def __init__(self, trainer: ClusterTrainer, request: LinkRequest, number: int, progress: Progress) -> None:
        self._trainer = trainer
        self._request = request
        self._number = number
        self._progress = progress
        self._settings = trainer.settings
        self._wait_s = self._settings.wait_s
        if trainer.is_lost:
            self._wait_s = min(self._wait_s, self._settings.lost_wait_s)
        self._answered_s = trainer.clock.now_s()
        self._sent_s = self._answered_s
        self._is_connecting = trainer.is_lost
        self._retry_s: float | None = None
        self._is_announced = False
        self._n_lost_workers = 0

    def until_done(self, stop: Callable[[], bool]) -> bool:
        """Wait for the result; False if ``stop`` ended it.

        Raises:
            _RunHereError: the cluster does not answer, or cannot train.
            DataError: the training failed.
        """
        link = self._trainer.link
        link.send(self._request)
        while True:
            if stop():
                link.close()
                return False
            event = link.poll(POLL_S)
            if event is not None and event.kind == "done":
                return True
            if event is not None:
                self._on_event(event)
            self._watch()

    def _on_event(self, event: LinkEvent) -> None:
        now_s = self._trainer.clock.now_s()
        if event.kind == "connected":
            self._sent_s, self._is_connecting = now_s, False
        elif event.kind == "answer":
            self._on_answer(event)
        elif event.kind == "failed":
            raise DataError(event.message)
        elif event.kind == "refused":
            raise _RunHereError(event.message.rstrip("."))
        elif event.kind == "lost worker":
            self._n_lost_workers += 1
            log.warning("The cluster lost the worker of a training: %s", event.message)
            if self._n_lost_workers >= self._settings.max_lost_workers:
                raise _RunHereError(f"The cluster {self._trainer.address} lost {self._n_lost_workers} workers")
            self._trainer.link.cut()
            self._retry_s = now_s
        elif event.kind == "unreachable":
            log.warning("The cluster cannot be reached: %s", event.message)
            self._trainer.link.cut()
            self._retry_s = now_s + self._settings.pause_s

    def _on_answer(self, event: LinkEvent) -> None:
        self._answered_s = self._sent_s = self._trainer.clock.now_s()
        if self._is_announced or self._trainer.is_lost:
            self._trainer.say(
                f"The cluster {self._trainer.address} answers again; the training before episode {self._number} runs "
                "there."
            )
        self._is_announced = self._trainer.is_lost = False
        self._wait_s = self._settings.wait_s
        if event.activity is not None:
            self._progress(*event.activity)

    def _watch(self) -> None:
        """Announce a wait, open the link again, or give up, by the time without an answer."""
        now_s = self._trainer.clock.now_s()
        silent_s = now_s - self._answered_s
        if silent_s > self._wait_s:
            raise _RunHereError(f"The cluster {self._trainer.address} has not answered for {self._wait_s:.0f} s")
        if silent_s > self._settings.message_s and not self._is_announced and not self._trainer.is_lost:
            self._is_announced = True
            self._trainer.say(
                f"The cluster {self._trainer.address} has not answered for {self._settings.message_s:.0f} s. The car "
                f"stays in neutral; the run waits up to {self._wait_s:.0f} s, then it trains on this computer."
            )
        limit_s = self._settings.connect_s if self._is_connecting else self._settings.reconnect_s
        is_dead = now_s - self._sent_s > limit_s
        if is_dead or (self._retry_s is not None and now_s >= self._retry_s):
            self._trainer.link.cut()
            self._trainer.link.send(self._request)
            self._sent_s, self._retry_s, self._is_connecting = now_s, None, True


def _files_of(order: TrainingOrder) -> dict[str, bytes]:
    try:
        return order.files()
    except OSError as error:
        raise DataError(
            f"{error.filename} cannot be read ({error.strerror}); the training before episode {order.number} needs it."
        ) from error


def _plan_here(plan: TrainingPlan) -> TrainingPlan:
    """The plan on a device that this computer has."""
    try:
        available(plan.device)
    except ConfigError:
        return replace(plan, device="cpu")
    return plan
