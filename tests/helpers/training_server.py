"""A training service in a process of its own, and its link, without Ray: ``training_server.py serve PORT | link ...``.

The service is what runs on a cluster; only the transport differs.
"""

from __future__ import annotations

import sys
from multiprocessing.managers import BaseManager
from typing import Any

from carlab.core.version import VERSION
from carlab.experiment.cluster import link
from carlab.experiment.cluster.service import TrainingService
from carlab.experiment.cluster.settings import LinkSettings

KEY = b"test"
_services: list[TrainingService] = []


class Manager(BaseManager):
    """Server and client of the service."""


def service() -> TrainingService:
    """The service of the server's process."""
    if not _services:
        _services.append(TrainingService(VERSION))
    return _services[0]


Manager.register("service", callable=service, exposed=["missing", "receive", "begin", "state", "fetch", "stop"])


class RemoteService:
    """The service of another process; a broken connection is a ConnectionError, as with Ray."""

    def __init__(self, address: str, name: str, device: str, settings: LinkSettings) -> None:
        manager = Manager(("127.0.0.1", int(address)), KEY)
        manager.connect()
        self._service: Any = manager.service()  # type: ignore[attr-defined]

    def call(self, method: str, *arguments: Any) -> Any:
        try:
            return getattr(self._service, method)(*arguments)
        except EOFError as error:
            raise ConnectionError("the connection is closed") from error

    def end(self) -> None:
        self.call("stop")


if __name__ == "__main__":
    what = sys.argv.pop(1)
    if what == "serve":
        Manager(("127.0.0.1", int(sys.argv[1])), KEY).get_server().serve_forever()
    sys.exit(link.main(RemoteService))
