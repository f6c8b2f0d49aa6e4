"""Unusual names and contents of files that a new user may have."""

from __future__ import annotations

import re
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from carlab.cli.console import console, table
from tests.cli.test_bad_input import canonical_csv, write
from tests.helpers.command_line import Carlab


@pytest.mark.parametrize("name", ["drive[v2].csv", "[red]drive.csv", "Über die Straße 1.csv", "a[/b].csv"])
def test_name_of_a_file_is_printed_as_it_is(carlab: Carlab, tmp_path: Path, name: str) -> None:
    """The console library reads brackets as styles; a[/b].csv is a file b].csv in a folder."""
    path, data = canonical_csv(tmp_path, rows=60)
    named = tmp_path / name
    named.parent.mkdir(exist_ok=True)
    write(path, data).rename(named)
    code, text = carlab("import", named)
    assert code == 0, text
    assert f"{named.with_suffix('.mcap')}: 59 commands" in text
    code, text = carlab("export", named.with_suffix(".mcap"), "--out", named.with_suffix(".parquet"))
    assert code == 0, text
    assert f"{named.with_suffix('.parquet')}: 60 rows" in text


@pytest.mark.parametrize(
    ("column", "message"),
    [
        (4, "Column 'vx' has no number in any row; remove it from the file."),
        (1, "Column 'x' has no number in any row; repair the file."),
    ],
)
def test_column_without_any_number_has_another_remedy_than_dropping_all_rows(
    carlab: Carlab, tmp_path: Path, column: int, message: str
) -> None:
    path, data = canonical_csv(tmp_path, rows=60)
    data[:, column] = np.nan
    for options in ((), ("--missing", "drop")):
        code, text = carlab("import", write(path, data), *options)
        assert code == 1
        assert message in text
        assert "--missing drop" not in text


def test_binary_like_table_names_the_remedy(carlab: Carlab, tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("t,x\n" + "0" * 200_000, encoding="utf-8")
    code, text = carlab("import", tmp_path / "a.csv")
    assert code == 1
    assert "export it as CSV with one header line." in text


@pytest.mark.parametrize(("width", "is_whole"), [(60, True), (100, False)])
def test_findings_are_paragraphs_in_a_narrow_terminal(
    carlab: Carlab, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, width: int, is_whole: bool
) -> None:
    """A table of five columns leaves 14 characters for the sentence, whose words stand between those of other cells."""
    monkeypatch.setattr(console, "_width", width)
    monkeypatch.setattr(console, "_force_terminal", True)
    path, data = canonical_csv(tmp_path, rows=60)
    data[:, 8] = 0.3
    code, text = carlab("import", write(path, data))
    assert code == 0, text
    paragraph = "warning: constant_command of throttle, 59 rows Column 'throttle' (throttle) is 0.3 throughout:"
    assert (paragraph in text) is is_whole, text


@pytest.mark.parametrize("content", [b'{"plan": 3}', b"[1", b"\xff"])
def test_damaged_settings_of_a_run_name_the_remedy(carlab: Carlab, tmp_path: Path, content: bytes) -> None:
    run = tmp_path / "run"
    run.mkdir()
    (run / "campaign.json").write_bytes(content)
    code, text = carlab("drive", "--policy", run, "--out", tmp_path / "runs")
    assert code == 1
    assert "campaign.json: " in text
    assert text.endswith("restore the file, or name the folder of another run.")
    assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize("width", [30, 60, 80])
def test_narrow_terminal_splits_no_number(
    width: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(console, "_width", width)
    monkeypatch.setattr(console, "_force_terminal", True)
    columns = ["model", "position [m]", "yaw [rad]", "vx [m/s]", "vy [m/s]", "score"]
    table("Errors", columns, [["noise floor", "1.0551", "0.8250", "0.4844", "0.3147", "132.48"]])
    text = capsys.readouterr().out
    assert re.findall(r"[\d.]+", text) == ["1.0551", "0.8250", "0.4844", "0.3147", "132.48"]
    assert max(map(len, text.splitlines())) <= width


@pytest.mark.parametrize("length", [60, 200])
def test_table_in_a_pipe_has_one_line_for_each_row(length: int, capsys: pytest.CaptureFixture[str]) -> None:
    """A terminal of 140 characters folds the words of the first length, and cannot show the word of the second."""
    name = "n" * length
    columns = ["held out", "model", "after [s]", "position rms [m]", "median [m]", "yaw rms [rad]", "windows"]
    model = "diagnosed, physics outside the catalogue"
    table("Errors", columns, [[name, model, "0.3", "0.014", "0.011", "0.022", "1200"]])
    lines = [line.rstrip() for line in capsys.readouterr().out.splitlines()]
    assert [re.split(r" {3,}", line) for line in (lines[2], lines[-1])] == [
        columns,
        [name, model, "0.3", "0.014", "0.011", "0.022", "1200"],
    ]


@pytest.mark.parametrize("verb", ["diagnose", "compare"])
def test_second_interrupt_ends_a_search_at_once(
    carlab: Carlab, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, verb: str
) -> None:
    def interrupted_twice(*_: object, **options: Any) -> None:
        signal.raise_signal(signal.SIGINT)
        assert options["stop"]()
        signal.raise_signal(signal.SIGINT)
        pytest.fail("the search continued after the second ^C")

    monkeypatch.setattr(f"carlab.cli.{verb}.{verb}", interrupted_twice)
    other = ("--with", "b.csv") if verb == "compare" else ()
    assert carlab(verb, "a.csv", *other, "--out", tmp_path / "out") == (130, "carlab: Interrupted.")


@pytest.mark.parametrize(("verb", "option"), [("diagnose", "--held-out"), ("compare", "--with")])
def test_recording_behind_an_option_that_takes_it_is_asked_for_before_the_option(
    carlab: Carlab, verb: str, option: str
) -> None:
    code, text = carlab(verb, option, "a.csv", "b.csv")
    assert code == 2
    assert f"before {option}, which takes all names after it" in text
