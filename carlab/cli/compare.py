"""``carlab compare``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from carlab.api.comparison import compare
from carlab.cli.console import console, fail
from carlab.cli.exit_codes import EXIT_INCONCLUSIVE
from carlab.cli.options import ARGUMENT_DEFAULT, arguments_of, check_folder, options_of
from carlab.cli.runs import search_callbacks


@dataclass
@options_of(compare)
class Compare:
    """Find what changed between two groups of drives of one car: another day, battery, floor, tyre or set-up.

    Names the smallest set of effects and parameters that differ, each with a 90 % interval, and writes compare.json.
    Each group needs 50 s of driving. ^C ends the search; compare.json then has the changes found so far. A second ^C
    ends at once, without compare.json. Exit code 0 with a verdict, 5 if the recordings are not sufficient, or if the
    search ended before it found a change.
    """

    recordings: Positional[tuple[Path, ...]]
    """MCAP or CSV files of the first group, or run folders."""

    changed: Annotated[tuple[Path, ...], arg(name="with")] = ()
    """Recordings of the second group."""

    car: str = ARGUMENT_DEFAULT
    candidates: tuple[str, ...] = ARGUMENT_DEFAULT

    out: Path = Path("comparison")
    """Folder for compare.json; an earlier compare.json in it is replaced."""

    verbose: bool = False
    """Show the whole log."""

    def run(self) -> int:
        """Compare and print the changes."""
        check_folder(self.out, f"--out {self.out}")
        with search_callbacks("comparison") as callbacks:
            found = compare(**arguments_of(self, compare), **callbacks)
        for fault in found.data_faults:
            console.print(f"{fault.channel}: {fault.action}")
        if found.verdict == "inconclusive":
            fail(found.sentence)
            return EXIT_INCONCLUSIVE
        console.print(found.sentence)
        for change in found.changes:
            console.print(f"  {change.sentence}")
        console.print(f"Read {self.out / 'compare.json'}.")
        return 0
