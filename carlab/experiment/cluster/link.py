"""Process of the link to the cluster: ``python -m carlab.experiment.cluster.link ADDRESS NAME DEVICE``.

It alone talks to Ray. Ray ends a process whose cluster is gone, so it must not be the process of the car. The
training service on the cluster has a name and outlives the link: a new link finds the running training again.
"""

from __future__ import annotations

import os
import queue
import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, TextIO

from carlab.core.clock import MonotonicClock
from carlab.core.errors import ConfigError, first_line
from carlab.core.version import VERSION
from carlab.experiment.cluster.link_protocol import LinkEvent, LinkRequest
from carlab.experiment.cluster.order import RESULT_FILES
from carlab.experiment.cluster.service import TrainingService, sha256
from carlab.experiment.cluster.settings import LinkSettings
from carlab.jobs.child_jobs import read_files, write_files
from carlab.jobs.ray_executor import connect

NAMESPACE = "carlab"
GOODBYE_S = 2.0
Emit = Callable[[LinkEvent], None]
Call = Callable[..., Any]
"""Calls a method of ``TrainingService``, here or on the cluster: its name and arguments."""


class RayService:
    """The training service as a Ray actor with a name, which is created unless it exists; ``cuda`` reserves one GPU.

    Raises:
        ConfigError: no cluster answers, or no machine of it has a GPU.
    """

    def __init__(self, address: str, name: str, device: str, settings: LinkSettings) -> None:
        self._ray = connect(address)
        n_gpus = int(device == "cuda")
        if n_gpus and self._ray.cluster_resources().get("GPU", 0) < 1:
            raise _Refused(f"--ray {address}: the cluster has no GPU; add a machine that has one, or use --device cpu.")
        self._actor = (
            self._ray.remote(TrainingService)
            .options(
                name=name, namespace=NAMESPACE, lifetime="detached", get_if_exists=True, num_cpus=1, num_gpus=n_gpus,
                max_restarts=0, max_concurrency=4,
            )
            .remote(VERSION, device, settings.idle_s)
        )  # fmt: skip

    def call(self, method: str, *arguments: Any) -> Any:
        """The result of a method of the actor. Raises _LostWorkerError, _Refused or ConnectionError."""
        try:
            return self._ray.get(getattr(self._actor, method).remote(*arguments))
        except self._ray.exceptions.ActorUnavailableError as error:
            raise ConnectionError(first_line(error)) from error
        except self._ray.exceptions.RayActorError as error:
            if sentence := str(error).partition("ConfigError: ")[2]:
                raise _Refused(first_line(ConfigError(sentence))) from error
            raise _LostWorkerError(first_line(error)) from error
        except self._ray.exceptions.RayError as error:
            raise ConnectionError(first_line(error)) from error

    def end(self) -> None:
        """End the service on the cluster."""
        self._ray.kill(self._actor, no_restart=True)


class _Refused(Exception):
    """The cluster cannot be used as it is."""


class _LostWorkerError(Exception):
    """The process of the training service died."""


def run_order(
    call: Call, request: LinkRequest, emit: Emit, settings: LinkSettings, pause: Callable[[float], None]
) -> None:
    """Send the files of an order, wait for its training, and write the result.

    ``emit`` receives what happens; the last event is ``done``, ``failed`` or ``lost worker``. ``pause`` waits for a
    number of seconds.
    """
    files = read_files(Path(request.order), ".")
    manifest = {name: sha256(content) for name, content in files.items()}
    for name in call("missing", manifest):
        call("receive", files[name])
        emit(LinkEvent("answer"))
    call("begin", manifest)
    while (state := call("state"))["state"] == "training":
        name, done, total = state["activity"]
        emit(LinkEvent("answer", activity=(name, done, total)))
        pause(settings.poll_s)
    if state["state"] != "done":
        emit(LinkEvent("failed" if state["state"] == "failed" else "lost worker", state["message"]))
        return
    there = {name: sha256(content) for name, content in read_files(Path(request.to), ".").items()}
    for name in RESULT_FILES:
        if there.get(name) != state["files"][name]:
            write_files(Path(request.to), {name: call("fetch", name)})
            emit(LinkEvent("answer"))
    emit(LinkEvent("done"))


def serve(open_service: Callable[[], RayService], requests: Iterable[str], emit: Emit, settings: LinkSettings) -> None:
    """Connect, and run one order (a line of ``LinkRequest``) after the other; every error is an event."""
    clock = MonotonicClock()
    try:
        service = open_service()
        emit(LinkEvent("connected"))
        for line in requests:
            run_order(
                service.call, LinkRequest.from_line(line), emit, settings,
                lambda seconds: clock.sleep_until(clock.now_s() + seconds),
            )  # fmt: skip
    except _Refused as error:
        emit(LinkEvent("refused", str(error)))
    except _LostWorkerError as error:
        emit(LinkEvent("lost worker", str(error)))
    except (ConfigError, OSError, RuntimeError) as error:
        emit(LinkEvent("unreachable", first_line(error)))


def main(service_of: Callable[[str, str, str, LinkSettings], RayService] = RayService) -> int:
    """Serve the requests on standard input; events go to standard output.

    Args:
        service_of: connects to the service, from address, name, device and settings.
    """
    address, name, device, *_ = sys.argv[1:]
    settings = LinkSettings()
    events = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)  # Whatever Ray prints must not mix with the events.
    services: list[RayService] = []

    def open_service() -> RayService:
        services.append(service_of(address, name, device, settings))
        services[0].call("state")
        return services[0]

    def emit(event: LinkEvent) -> None:
        events.write(event.to_line())
        events.flush()

    def end() -> None:
        """End service and process, even if the cluster does not answer."""
        threading.Timer(GOODBYE_S, os._exit, (0,)).start()
        for service in services:
            service.end()
        os._exit(0)

    serve(open_service, _lines_until(sys.stdin, end), emit, settings)
    return 0


def _lines_until(stream: TextIO, end: Callable[[], None]) -> Iterator[str]:
    """Lines of a stream as they arrive; its end calls ``end`` at once, also while a line is being worked on."""
    lines: queue.Queue[str] = queue.Queue()

    def read() -> None:
        for line in stream:
            lines.put(line)
        end()

    threading.Thread(target=read, name="requests", daemon=True).start()
    while True:
        yield lines.get()


if __name__ == "__main__":
    sys.exit(main())
