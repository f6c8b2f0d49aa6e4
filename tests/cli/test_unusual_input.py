"""Unusual names and contents of files that a new user may have."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from tests.cli.test_bad_input import canonical_csv, write

Carlab = Callable[..., tuple[int, str]]


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
