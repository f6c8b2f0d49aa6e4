"""Fixture that runs a command line in this process."""

from collections.abc import Callable

import pytest

from carlab.cli import run


@pytest.fixture
def carlab(capfd: pytest.CaptureFixture[str]) -> Callable[..., tuple[int, str]]:
    """Call ``carlab``; returns its exit code and its output on one line."""

    def call(*argv: object) -> tuple[int, str]:
        try:
            code = run([str(a) for a in argv])
        except SystemExit as end:
            code = int(end.code or 0)
        out, err = capfd.readouterr()
        text = " ".join((out + err).split())
        assert "Traceback" not in text
        return code, text

    return call
