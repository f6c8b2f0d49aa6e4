"""The one console. Only this package prints."""

from __future__ import annotations

import logging
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from rich.console import Console
from rich.logging import RichHandler
from rich.panel import Panel
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from carlab.core.quantities import Reality

console = Console(highlight=False, soft_wrap=True)
error_console = Console(stderr=True, highlight=False, soft_wrap=True)

STYLES = {Reality.SIMULATED: "cyan", Reality.EMULATED: "green", Reality.DRY_RUN: "yellow", Reality.REAL: "bold red"}
SENTENCES = {
    Reality.SIMULATED: "physics in this process; nothing can move",
    Reality.EMULATED: "real wire protocols, fake firmware and fake motion capture; nothing can move",
    Reality.DRY_RUN: "real inputs, no command is sent",
    Reality.REAL: "A REAL CAR WILL MOVE. Keep clear, a hand on the power switch; ^C stops it",
}


def banner(reality: Reality, car: str) -> None:
    """Say in capitals what is about to be driven."""
    word = "LIVE" if reality is Reality.REAL else reality.value.upper()
    console.print(Panel(f"[bold]{word}[/bold]  {car}: {SENTENCES[reality]}", style=STYLES[reality], expand=False))


def fail(message: str) -> None:
    """Print one error, alone."""
    error_console.print(f"[bold red]carlab:[/bold red] {message}")


def table(title: str, columns: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Print a table; columns after the first are right-aligned."""
    made = Table(title=title, title_justify="left", header_style="bold")
    for index, column in enumerate(columns):
        made.add_column(column, justify="left" if index == 0 else "right")
    for row in rows:
        made.add_row(*row)
    console.print(made)


@contextmanager
def progress() -> Iterator[Progress]:
    """A progress bar on a terminal; nothing where the output is a file."""
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[note]}"),
    )
    with Progress(*columns, console=console, transient=True, disable=not sys.stdout.isatty()) as bar:
        yield bar


def log_to_console(*, verbose: bool) -> None:
    """Show warnings (all with ``verbose``) of the program's log on the console."""
    handler = RichHandler(console=error_console, show_path=False, show_time=verbose, rich_tracebacks=False)
    handler.setLevel(logging.DEBUG if verbose else logging.WARNING)
    logging.basicConfig(level=logging.DEBUG if verbose else logging.INFO, handlers=[handler], format="%(message)s")
