"""CSV files with decimal commas are read; where the meaning of a comma is ambiguous they are refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from carlab.core.errors import DataError
from carlab.recording.csv.foreign import import_csv
from carlab.recording.csv.table import read_csv

HEADER = "t,x,y,yaw,vx,vy,yaw_rate,steering,throttle"


def table(rows: int = 60) -> np.ndarray:
    """A circle at 1 m/s, shape (rows, 9)."""
    t = np.arange(rows) / 30.0
    yaw = 0.8 * t
    one = np.ones(rows)
    columns = [t, np.sin(yaw) / 0.8, (1 - np.cos(yaw)) / 0.8, yaw, one, 0 * one, 0.8 * one, 0.4 * one, 0.3 * one]
    return np.stack(columns, axis=1)


def write(path: Path, rows: list[list[str]], separator: str = ";", header: str = HEADER) -> Path:
    lines = [header.replace(",", separator), *(separator.join(row) for row in rows)]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def cells(data: np.ndarray, decimals: str = "%.17g") -> list[list[str]]:
    return [[(decimals % value).replace(".", ",") for value in row] for row in data]


@pytest.mark.parametrize("separator", [";", "\t"])
def test_decimal_commas_give_the_same_recording_as_points(tmp_path: Path, separator: str) -> None:
    data = table()
    with_commas = import_csv(write(tmp_path / "commas.csv", cells(data), separator))
    np.savetxt(tmp_path / "points.csv", data, fmt="%.17g", delimiter=",", header=HEADER, comments="")
    with_points = import_csv(tmp_path / "points.csv")
    np.testing.assert_array_equal(with_commas.episode.states, with_points.episode.states)
    np.testing.assert_array_equal(with_commas.episode.times_s, with_points.episode.times_s)
    assert "numbers with decimal commas" in with_commas.announcement
    assert "decimal commas" not in with_points.announcement


def test_first_line_of_excel_and_quoted_numbers_are_read(tmp_path: Path) -> None:
    rows = [[f'"{cell}"' for cell in row] for row in cells(table())]
    path = write(tmp_path / "a.csv", rows, ",")
    path.write_text("sep=,\n" + path.read_text(encoding="utf-8"), encoding="utf-8")
    np.testing.assert_array_equal(read_csv(path).column("yaw"), table()[:, 3])


def test_whole_numbers_missing_cells_and_three_decimals_are_read(tmp_path: Path) -> None:
    rows = [["1,234", "5", "-0,500"], ["1,267", "", "1,250"], ["1,300", "-7", "1e-3"]]
    read = read_csv(write(tmp_path / "a.csv", rows, header="a,b,c"))
    np.testing.assert_array_equal(read.column("a"), [1.234, 1.267, 1.3])
    np.testing.assert_array_equal(read.column("b"), [5.0, np.nan, -7.0])
    np.testing.assert_array_equal(read.column("c"), [-0.5, 1.25, 0.001])


@pytest.mark.parametrize(
    ("first", "second"),
    [("1,234", "5,678"), ("0,5", "1.5"), ("1.234,5", "0"), ("1,234,567", "0"), ("1,234.5", "0")],
    ids=["thousands", "commas and points", "points of thousands", "commas of thousands", "English thousands"],
)
def test_ambiguous_commas_are_refused(tmp_path: Path, first: str, second: str) -> None:
    read = read_csv(write(tmp_path / "a.csv", [[first, second]] * 3, header="a,b"))
    with pytest.raises(DataError, match=r"write all numbers with a decimal point and without separators of thousands"):
        read.column("a")


def test_text_with_commas_leaves_decimal_points_alone(tmp_path: Path) -> None:
    read = read_csv(write(tmp_path / "a.csv", [["0.5", "3,4"]] * 3, header="a,b"))
    np.testing.assert_array_equal(read.column("a"), [0.5] * 3)
    assert not read.note
    assert set(read.texts) == {"b"}


def test_decimal_commas_between_commas_need_semicolons(tmp_path: Path) -> None:
    path = write(tmp_path / "a.csv", cells(table(), "%.3f"), ",")
    with pytest.raises(DataError, match="if its numbers have decimal commas, separate the columns by semicolons"):
        read_csv(path)
