"""The console of the command line. No other package prints."""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Mapping, Sequence

from rich import box
from rich.console import Console
from rich.logging import RichHandler
from rich.measure import Measurement
from rich.panel import Panel
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table
from rich.text import Text

from carlab.cli.exit_codes import EXIT_BROKEN_PIPE
from carlab.core.quantities import Reality

FILE_WIDTH_CHARS = 140
MAX_TABLE_CHARS = 1000
PACKAGES = ("carlab", "drivers", "learning", "mocap", "sim_backends")
"""Packages of the program, whose logs ``--verbose`` shows."""
UNITS = {"v": "V", "ms": "ms", "s": "s", "hz": "Hz", "ppm": "ppm", "erpm": "eRPM", "count": "", "flag": ""}
"""Last parts of the names of readings, and their symbols."""


class _Console(Console):
    """A console that ends the program with exit code 141 if the reader of its pipe has ended."""

    def on_broken_pipe(self) -> None:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise SystemExit(EXIT_BROKEN_PIPE)


def _console(*, stderr: bool) -> Console:
    terminal = (sys.stderr if stderr else sys.stdout).isatty()
    # Without markup: a file name such as drive[v2].mcap would lose its brackets.
    return _Console(stderr=stderr, highlight=False, markup=False, width=None if terminal else FILE_WIDTH_CHARS)


console = _console(stderr=False)
error_console = _console(stderr=True)

STYLES = {Reality.SIMULATED: "cyan", Reality.EMULATED: "green", Reality.DRY_RUN: "yellow", Reality.REAL: "bold red"}
SENTENCES = {
    Reality.SIMULATED: "physics in this process; nothing can move",
    Reality.EMULATED: "real protocols, emulated firmware and motion capture; nothing can move",
    Reality.DRY_RUN: "real inputs; the car gets neutral only, which centres its servo",
    Reality.REAL: "A REAL CAR WILL MOVE. Keep clear, a hand on the power switch; ^C stops it",
}

CHECK_SENTENCE = "opened for a check; it gets neutral only, which centres its servo"
"""Sentence for a real car that a verb does not drive."""


def banner(reality: Reality, car: str, *, moves: bool = True) -> None:
    """Print the kind and name of the car; ``moves`` is False for a verb that does not move the car."""
    word = "LIVE" if reality is Reality.REAL else reality.value.upper()
    sentence = SENTENCES[reality] if moves or reality is not Reality.REAL else CHECK_SENTENCE
    text = Text.assemble((word, "bold"), f"  {car}: {sentence}")
    console.print(Panel(text, style=STYLES[reality], expand=False))


def fail(message: str) -> None:
    """Print an error message."""
    error_console.print(Text("carlab:", "bold red"), Text(message), soft_wrap=True)


def warn(message: str) -> None:
    """Print a warning."""
    error_console.print(Text("Warning:", "bold yellow"), Text(message), soft_wrap=True)


def table(title: str, columns: Sequence[str], rows: Sequence[Sequence[str]], *, numeric: bool = True) -> None:
    """Print a table; with ``numeric``, the columns after the first are right-aligned.

    A terminal that is too narrow for the table's words and numbers gets one paragraph for each row. A file or a pipe
    gets one line for each row of a numeric table.
    """
    # Text instead of str: rich would interpret the unit "[m]" as mark-up.
    rich_table = Table(
        title=Text(title, "bold") if title else None,
        title_justify="left",
        header_style="bold",
        box=box.SIMPLE_HEAD,
        show_edge=False,
        pad_edge=False,
    )
    for index, column in enumerate(columns):
        rich_table.add_column(Text(column), justify="left" if index == 0 or not numeric else "right", overflow="fold")
    for row in rows:
        rich_table.add_row(*(Text(cell) for cell in row))
    if title:
        console.print()
    needed = Measurement.get(console, console.options.update(max_width=MAX_TABLE_CHARS), rich_table)
    is_in_full = numeric and not console.is_terminal
    if is_in_full:
        rich_table.width = needed.maximum
    if is_in_full or needed.minimum <= console.width:
        console.print(rich_table, crop=not is_in_full)
        return
    if title:
        console.print(Text(title, "bold"))
    for row in rows:
        cells = ", ".join(" ".join((*column.split(), cell)) for column, cell in zip(columns[1:], row[1:], strict=True))
        console.print(Text(f"{columns[0]} {row[0]}: {cells}"))


def readings_table(title: str, readings: Mapping[str, float]) -> None:
    """Print readings, whose names end in their unit, in a table."""
    rows = []
    for name, value in readings.items():
        stem, _, unit = name.rpartition("_")
        label, symbol = (stem, UNITS[unit]) if stem and unit in UNITS else (name, "")
        rows.append([label.replace("_", " "), f"{value:.4g}", symbol])
    table(title, ["reading", "value", "unit"], rows)


def progress(speed_estimate_period_s: float = 30.0) -> Progress:
    """A progress bar on a terminal; it is disabled if the output is a file.

    The remaining time is estimated from the steps of the last ``speed_estimate_period_s``.
    """
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[note]}"),
        console=console,
        transient=True,
        disable=not sys.stdout.isatty(),
        speed_estimate_period=speed_estimate_period_s,
    )


def log_to_console(*, verbose: bool) -> None:
    """Show warnings on the console; with ``verbose``, the whole log of the program, of libraries from INFO on."""
    handler = RichHandler(console=error_console, show_path=False, show_time=verbose, rich_tracebacks=False)
    handler.setLevel(logging.DEBUG if verbose else logging.WARNING)
    logging.basicConfig(level=logging.INFO, handlers=[handler], format="%(message)s")
    for package in PACKAGES if verbose else ():
        logging.getLogger(package).setLevel(logging.DEBUG)
