"""Test that help texts are wrapped at the width of the terminal, not at the line breaks of the source code."""

import itertools
import os
import subprocess
import sys

import pytest

WIDTH = 90


@pytest.mark.parametrize("verb", ["diagnose", "learn"])
def test_each_line_of_a_help_text_is_full(verb: str) -> None:
    printed = subprocess.run(
        [sys.executable, "-m", "carlab", verb, "--help"],
        env=os.environ | {"COLUMNS": str(WIDTH)},
        capture_output=True,
        text=True,
        check=True,
    ).stdout
    rows = [line[2:-2] for line in printed.split("\n") if line.startswith("│")]
    indent = min(len(row) - len(row.lstrip()) for row in rows if row.startswith(" " * 10))
    continued = [
        (row, following.split()[0])
        for row, following in itertools.pairwise(rows)
        if row[indent - 1] == " " and row[indent] != " " and following.startswith(" " * indent) and following.strip()
    ]
    assert len(continued) > 20
    assert [row for row, word in continued if len(f"{row.rstrip()} {word}") <= WIDTH - 4] == []
