"""``carlab VERB``: one file per verb; the help texts are the docstrings.

Exit codes: 0 done, 1 failed, 2 usage, 3 not ready, 4 safety stop, 5 recordings not sufficient (``diagnose``,
``bench realcars``), 130 interrupted, 141 the reader of a pipe ended.
"""

from __future__ import annotations

import importlib
import io
import keyword
import os
import sys
from collections.abc import Callable, Sequence
from typing import Any

from carlab.cli.exit_codes import EXIT_BROKEN_PIPE, EXIT_INTERRUPTED


def main(argv: Sequence[str] | None = None) -> None:
    """Entry point of the ``carlab`` command."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # A terminal in Latin-1 cannot show every file name.
            stream.reconfigure(errors="backslashreplace")
    _ignore_current_folder_in_children()
    try:
        try:
            code = run(sys.argv[1:] if argv is None else argv)
        finally:
            sys.stdout.flush()
    except KeyboardInterrupt:  # During the imports of a verb.
        print("carlab: Interrupted.", file=sys.stderr)
        code = EXIT_INTERRUPTED
    except BrokenPipeError:  # The reader of a pipe, such as ``head``, has ended.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        code = EXIT_BROKEN_PIPE
    sys.exit(code)


def _ignore_current_folder_in_children() -> None:
    """Let child processes ignore modules in the current folder, such as a random.py, if this process does."""
    try:
        ignored = os.getcwd() not in sys.path and "" not in sys.path
    except FileNotFoundError:  # The current folder was deleted.
        return
    if ignored:
        os.environ["PYTHONSAFEPATH"] = "1"


def _with_home_folder(argument: str) -> str:
    """Expand ``~`` in ``~/file`` and ``--option=~/file``; a shell does not expand it after ``=``."""
    option, equals, value = argument.partition("=") if argument.startswith("--") else ("", "", argument)
    return option + equals + os.path.expanduser(value)


def run(argv: Sequence[str]) -> int:
    """Run one command line and return its exit code."""
    # A limit on threads prevents competing thread pools from delaying the control loop.
    os.environ.setdefault("OMP_NUM_THREADS", "2")
    import tyro

    from carlab.cli.console import console, fail, log_to_console
    from carlab.cli.options import registry_without_none
    from carlab.core.errors import CarlabError
    from carlab.core.method_names import with_current_methods
    from carlab.core.version import VERSION

    if list(argv) == ["--version"]:
        console.print(f"carlab {VERSION}")
        return 0
    verbs = _verbs()
    if not {"-h", "--help"}.isdisjoint(argv):
        from carlab.cli.help_texts import improve_help
        from carlab.cli.options import CarOptions, TaskOptions

        improve_help((*(each for each in verbs.values() if isinstance(each, type)), CarOptions, TaskOptions))
    verb = tyro.extras.subcommand_cli_from_dict(
        verbs,
        args=with_current_methods([_with_home_folder(a) for a in argv]),
        prog="carlab",
        description=_DESCRIPTION,
        config=(tyro.conf.DisallowNone,),
        registry=registry_without_none(),
    )
    log_to_console(verbose=bool(getattr(verb, "verbose", False)))
    try:
        return int(verb.run())
    except CarlabError as error:
        fail(f"{error}{_where_options_belong(argv[0], error)}")
        return error.exit_code
    except KeyboardInterrupt as error:
        fail(" ".join(("Interrupted.", *getattr(error, "__notes__", ()))))
        return EXIT_INTERRUPTED
    except BrokenPipeError:
        raise
    except OSError as error:
        from carlab.recording.sink import DISK_FULL, describe_os_error

        if error.errno in DISK_FULL:
            fail(describe_os_error(error, error.filename or os.getcwd()))
            return 1
        prefix = f"{error.filename}: " if error.filename else ""
        causes = "the path, its permissions and the disk" if error.filename else "addresses, cables and permissions"
        fail(f"{prefix}{error.strerror or error}; check {causes}.")
        return 1


def _where_options_belong(verb: str, error: Exception) -> str:
    """A sentence for a refused CSV whose message names options that only ``carlab import`` has; else empty.

    It follows the message, or stands in its own line below a list of faults.
    """
    from carlab.recording.audit.report import RefusedError

    n_options = sum(bool(f.option) for f in error.findings) if isinstance(error, RefusedError) else 0
    if verb == "import" or not isinstance(error, RefusedError) or not n_options:
        return ""
    space = " " if len(error.findings) == 1 else "\n"
    what = "this option" if n_options == 1 else "these options"
    return f"{space}Convert the file with carlab import and {what} first, then {verb} the .mcap file."


_DESCRIPTION = (
    "Drive, learn and diagnose small race cars: real cars, cars with emulated hardware, and simulated cars. "
    "carlab --version prints the version."
)


VERBS = (
    *("drive", "replay", "view", "import", "export", "check", "emulate", "listen", "learn", "diagnose", "compare"),
    *("prove", "bench"),
)
"""Verbs in the order of the help; each is a class, in a module of its name."""


def _verbs() -> dict[str, Callable[..., Any]]:
    modules = {verb: f"carlab.cli.{verb}{'_' * keyword.iskeyword(verb)}" for verb in VERBS}
    return {verb: getattr(importlib.import_module(module), verb.title()) for verb, module in modules.items()}
