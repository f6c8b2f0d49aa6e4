"""Child processes of a run: forks of one server process that imports the modules of training and check only once."""

from __future__ import annotations

import contextlib
import logging
import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from multiprocessing import forkserver, resource_tracker
from multiprocessing.connection import Connection, wait
from multiprocessing.context import ForkServerContext, ForkServerProcess
from pathlib import Path
from typing import Any

from carlab.core.errors import CarlabError

log = logging.getLogger(__name__)

POLL_S = 0.1
_IMPORTED_ONCE = (
    "carlab.diagnosis.quick.quick_check",
    "carlab.experiment.campaign.training",
    "carlab.recording.mcap.source",
    "learning.policy.sac_agent",
    "learning.world.drawn_cars",
    "learning.world.model_env",
    "torch._dynamo",  # torch imports it when the first optimiser is created
)


class ChildError(Exception):
    """A child process ``failed`` with an expected error, ``crashed`` with another one, or ``died`` (exit code)."""

    def __init__(self, end: str, text: str) -> None:
        super().__init__(text)
        self.end = end


def child_context() -> ForkServerContext:
    """Context of child processes that compute between two drives; each begins without the 3 s of these imports.

    Unlike a fork of this process, a fork of the server has none of its threads, ports and files. ^C reaches neither the
    server nor its forks, because a traceback of the imports would hide the message of this process.
    """
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(list(_IMPORTED_ONCE))
    resource_tracker.ensure_running()  # Its first start unblocks SIGINT, which the server would inherit.
    with interrupts_blocked():
        forkserver.ensure_running()
    return context


@contextlib.contextmanager
def interrupts_blocked() -> Iterator[None]:
    """Block SIGINT in processes that are started in this block; here it arrives after the block."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextlib.contextmanager
def _without_main_that_is_no_file() -> Iterator[None]:
    """Hide the name of a script from standard input (``<stdin>``), which a new process would try to execute."""
    main = vars(sys.modules["__main__"])
    name = main.get("__file__")
    if name is None or Path(name).is_file():
        yield
        return
    del main["__file__"]
    try:
        yield
    finally:
        main["__file__"] = name


def _start(child: ForkServerProcess, stop: Callable[[], bool]) -> bool:
    """Start a child; False if ``stop`` was true before the server had done its imports.

    A start waits for these imports. After a stop the server is killed; the next child has a new one.
    """
    errors: list[Exception] = []
    stopped = False

    def start() -> None:
        try:
            child.start()
        except Exception as error:
            errors.append(error)

    thread = threading.Thread(target=start, name=f"start of the {child.name}", daemon=True)
    thread.start()
    while thread.is_alive() and not (stopped := stop()):
        thread.join(POLL_S)
    if stopped:
        server = forkserver._forkserver._forkserver_pid  # type: ignore[attr-defined]
        os.kill(server, signal.SIGKILL)
        with contextlib.suppress(ChildProcessError):  # the other thread has seen its end
            os.waitid(os.P_PID, server, os.WEXITED | os.WNOWAIT)  # the next child would connect to a server that ends
        thread.join()
    elif errors:
        raise errors[0]
    return not errors


def run_in_child(
    name: str,
    function: Callable[..., Any],
    arguments: tuple[Any, ...],
    stop: Callable[[], bool],
    *,
    on_report: Callable[..., None] | None = None,
    expected: tuple[type[Exception], ...] = (CarlabError,),
) -> Any:
    """Call a function in another process, and wait for it.

    Args:
        name: of the process.
        function: a function of a module.
        arguments: of the function; with ``on_report`` it gets one more, which it calls to report.
        stop: polled; once true, the process is terminated.
        on_report: called with the arguments of each report.
        expected: errors with a complete message.

    Returns:
        The result; None if ``stop`` ended it.

    Raises:
        ChildError: the function raised an error, or the process died.
    """
    context = child_context()
    receiver, sender = context.Pipe(duplex=False)
    call = (sender, name, function, arguments, on_report is not None, expected)
    child = context.Process(target=_call, args=call, daemon=True, name=name)
    with _without_main_that_is_no_file():
        is_started = _start(child, stop)
    sender.close()
    if not is_started:
        receiver.close()
        return None
    try:
        while not stop():
            if receiver.poll(POLL_S):
                kind, content = receiver.recv()
                if kind == "done":
                    return content
                if kind != "report":
                    raise ChildError(kind, content)
                assert on_report is not None
                on_report(*content)
        return None
    except EOFError:
        child.join()
        raise ChildError("died", f"exit code {child.exitcode}") from None
    finally:
        if child.is_alive():
            child.terminate()
        child.join()
        receiver.close()


def _call(
    pipe: Connection,
    name: str,
    function: Callable[..., Any],
    arguments: tuple[Any, ...],
    reports: bool,
    expected: tuple[type[Exception], ...],
) -> None:
    import torch

    threading.Thread(target=_end_with_parent, name="end with the parent", daemon=True).start()
    torch.set_num_threads(1)
    if reports:
        arguments = (*arguments, lambda *what: pipe.send(("report", what)))
    try:
        pipe.send(("done", function(*arguments)))
    except BrokenPipeError:
        pass
    except expected as error:
        pipe.send(("failed", str(error)))
    except (Exception, SystemExit) as error:
        log.exception("The %s failed", name)
        pipe.send(("crashed", f"{type(error).__name__}: {error}"))
    finally:
        pipe.close()


def _end_with_parent() -> None:
    """End this process as soon as its parent has ended, also by SIGKILL: nothing else reads its result."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    wait([parent.sentinel])
    os._exit(1)
