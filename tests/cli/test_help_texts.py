"""Test that help texts are wrapped at the width of the terminal, and that they print no empty defaults."""

import inspect
import itertools
import os
import subprocess
import sys

import pytest

from carlab.cli import _verbs, run

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


@pytest.mark.parametrize("verb", _verbs())
def test_no_line_of_a_description_begins_with_a_hyphen(verb: str) -> None:
    """tyro joins the lines of a paragraph, but it begins a new line at a hyphen, as at an item of a list."""
    description = inspect.getdoc(_verbs()[verb]) or ""
    assert description
    assert [line for line in description.split("\n") if line.startswith("-")] == []


def test_help_names_the_option_that_prints_the_version(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="0"):
        run(["--help"])
    assert "carlab --version" in capsys.readouterr().out


@pytest.mark.parametrize("verb", _verbs())
def test_option_without_default_has_the_type_of_its_value_only(verb: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="0"):
        run([verb, "--help"])
    printed = " ".join(capsys.readouterr().out.replace("│", " ").split())
    assert "None" not in printed
    assert "BOOL, --no-" not in printed, "a flag has no value"
    assert "default: )" not in printed
    assert "default: '')" not in printed
    assert printed.count("(default: ") >= 1
    with pytest.raises(SystemExit, match="2"):
        run([verb, "--no-such-option"])


@pytest.mark.parametrize(
    ("arguments", "choices"),
    [
        (("learn", "--resume", "missing", "--device", "None"), "Expected one of ('cpu', 'cuda')"),
        (("import", "drive.csv", "--clock", "None"), "Expected one of ('column', 'velocity', 'even')"),
        (("learn", "--resume", "missing", "--episodes", "None"), "invalid literal for int()"),
    ],
)
def test_none_is_no_value_of_an_option(
    arguments: tuple[str, ...], choices: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit, match="2"):
        run(arguments)
    printed = capsys.readouterr()
    assert choices in " ".join((printed.out + printed.err).replace("│", " ").split())


def test_options_that_an_import_proposes_need_no_value(capsys: pytest.CaptureFixture[str]) -> None:
    """The findings of an import propose ``--swap-xy`` and ``--repair-yaw-rate``."""
    assert run(["import", "missing.csv", "--swap-xy", "--repair-yaw-rate"]) == 2
    assert "missing.csv' does not exist" in capsys.readouterr().err
