"""The readings that ``carlab check`` and ``carlab listen`` print."""

import re
from pathlib import Path

import pytest

from carlab.cli import run

PAGE = Path(__file__).parents[2] / "docs" / "reference" / "readings.md"


@pytest.mark.realtime
def test_page_of_readings_lists_each_printed_reading(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["check", "--car", "emulated", "--seconds", "0.3"]) == 0
    table = capsys.readouterr().out.partition("Readings")[2].partition("\n\n")[0]
    printed = {re.split(r"\s{3,}", line.strip())[0] for line in table.splitlines()[3:] if line.strip()}
    cells = [line.split("|")[1].strip() for line in PAGE.read_text(encoding="utf-8").splitlines() if line[:1] == "|"]
    listed = {name for cell in cells for name in re.sub(r" \[.*\]", "", cell).split(", ")} - {"reading", "---"}
    assert printed == listed
