"""Runs a command line of carlab in this process."""

import contextlib
import io
from collections.abc import Callable

from carlab.cli import run

Carlab = Callable[..., tuple[int, str]]
"""Type of the fixture ``carlab``: exit code and output of a command line."""


def run_command(*argv: object) -> tuple[int, str]:
    """Exit code of a valid command line, and its output on one line."""
    out = io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(out):
        code = run([str(a) for a in argv])
    return code, " ".join(out.getvalue().split())
