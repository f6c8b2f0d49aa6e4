"""Tables of named columns, and the reading of .csv and .csv.gz files; errors name the row and the column."""

from __future__ import annotations

import csv
import gzip
import io
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from carlab.core.errors import DataError
from carlab.core.quantities import FloatArray
from carlab.recording.csv.decimal_commas import has_decimal_comma, is_number, with_decimal_points

_MISSING = frozenset({"", "none", "null", "na", "n/a"})


@dataclass(frozen=True, slots=True)
class ColumnTable:
    """Numeric columns by name, each (N,), with NaN for empty cells. Row k of the arrays is data row k + 1.

    ``texts`` holds row and content of the first cell that is not a number, for each column with such a cell.
    ``note`` states how the numbers were read, for messages.
    """

    path: Path
    header: tuple[str, ...]
    columns: dict[str, FloatArray]
    texts: dict[str, tuple[int, str]]
    note: str = ""

    @property
    def rows(self) -> int:
        """Number of data rows N."""
        return len(next(iter(self.columns.values()))) if self.columns else 0

    def column(self, name: str) -> FloatArray:
        """Return a numeric column (N,). Raises DataError if it holds text."""
        if name in self.texts:
            row, cell = self.texts[name]
            is_ambiguous = "," in cell and is_number(cell.replace(".", "").replace(",", ""))
            remedy = "write the column as numbers (a date as seconds)" if row == 1 else "correct or empty that cell"
            if is_ambiguous:
                remedy = "write all numbers with a decimal point and without separators of thousands"
            raise DataError(
                f"Row {row} of column '{name}' in {self.path.name} holds {cell!r}, which is not a number; {remedy}."
            )
        return self.columns[name]


def read_csv(path: Path | str) -> ColumnTable:
    """Read a file with one header line, separated by commas, semicolons or tabs; ``.gz`` is decompressed.

    Empty lines, and lines before the header that begin with ``#``, are skipped. The header may begin with ``#``, as
    numpy.savetxt writes. Empty cells, ``nan``, ``none``, ``null`` and ``na`` become NaN. Numbers have a decimal point,
    or all have a decimal comma; where that is ambiguous, their columns are texts. Raises DataError if the file is
    missing, empty, truncated or not text, if it has a single column, or if a row has another number of cells than the
    header.
    """
    path = Path(path)
    text = _without_comments(_read_text(path))
    if text.startswith("Format Version,"):
        raise DataError(
            f"{path.name} is an export of Motive, which has poses and no commands; join it with the log of the "
            "commands, as examples/join_logs.py does."
        )
    first = text.split("\n", 1)[0]
    delimiter = max(",;\t", key=first.count)
    try:
        lines = [row for row in csv.reader(io.StringIO(text, newline=""), delimiter=delimiter) if row]
    except csv.Error as error:
        raise DataError(f"{path.name} is not a CSV file ({error}); export it as CSV with one header line.") from error
    if not lines:
        raise DataError(f"{path.name} is empty; a recording has a header and at least three rows.")
    header = tuple(name.strip().lstrip("\ufeff") for name in lines[0])
    if all(is_number(cell) or has_decimal_comma(cell) for cell in header):
        raise DataError(f"{path.name} begins with numbers; add a header line with the column names.")
    if len(header) == 1:
        raise DataError(
            f"{path.name} has a single column, {_shortened(header[0])!r}; separate the columns by commas, semicolons "
            "or tabs."
        )
    duplicates = sorted({name for name in header if header.count(name) > 1})
    if duplicates:
        raise DataError(f"{path.name} has two columns named '{duplicates[0]}'; rename one in the header.")
    for number, row in enumerate(lines[1:], start=1):
        if len(row) != len(header):
            cause = "the file may be truncated there; "
            if len(row) > len(header) and delimiter == ",":
                cause = "if its numbers have decimal commas, separate the columns by semicolons; else "
            raise DataError(
                f"Row {number} of {path.name} has {len(row)} cells where the header has {len(header)}; {cause}"
                "correct or remove that row."
            )
    if len(lines) < 4:
        raise DataError(f"{path.name} has too few rows ({len(lines) - 1}); a recording needs at least three.")
    cells = {
        name: ["nan" if row[index].strip().lower() in _MISSING else row[index] for row in lines[1:]]
        for index, name in enumerate(header)
    }
    columns = {name: numbers for name, column in cells.items() if (numbers := _numbers(column)) is not None}
    texts = {name: column for name, column in cells.items() if name not in columns}
    converted = with_decimal_points(texts, (cells[name] for name in columns)) if texts else {}
    columns |= {name: np.array(column, dtype=np.float64) for name, column in converted.items()}
    first_texts = {name: _first_text(column) for name, column in texts.items() if name not in converted}
    return ColumnTable(path, header, columns, first_texts, "numbers with decimal commas" if converted else "")


def _shortened(text: str) -> str:
    """A text of at most 80 characters."""
    return text if len(text) <= 80 else f"{text[:77]}..."


def _numbers(cells: list[str]) -> FloatArray | None:
    """The numbers of a column (N,); None if a cell is not a number."""
    try:
        return np.array(cells, dtype=np.float64)
    except ValueError:
        return None


def _first_text(cells: list[str]) -> tuple[int, str]:
    """Row and content of the first cell that is not a number."""
    index = next(k for k, cell in enumerate(cells) if not is_number(cell))
    return index + 1, cells[index]


def _without_comments(text: str) -> str:
    """The text from its header on; a header after ``#`` has as many cells as the next line."""
    if text[:4].lower() == "sep=":  # Excel
        text = text.partition("\n")[2]
    while text:
        line, _, rest = text.partition("\n")
        if line.strip() and not line.startswith("#"):
            break
        delimiter = max(",;\t", key=line.count)
        if 0 < line.count(delimiter) == rest.partition("\n")[0].count(delimiter):
            return text.lstrip("# ")
        text = rest
    return text


def _read_text(path: Path) -> str:
    try:
        content = path.read_bytes()
        if content[:2] == b"\x1f\x8b":  # The name does not matter: a browser may unpack a .gz file and keep its name.
            content = gzip.decompress(content)
        return content.decode("utf-8-sig")
    except (EOFError, zlib.error, gzip.BadGzipFile) as error:
        raise DataError(f"{path.name} is not a complete gzip file ({error}); copy it again.") from error
    except UnicodeDecodeError as error:
        if path.suffix == ".gz":
            raise DataError(f"{path.name} is neither a gzip file nor text in UTF-8; copy it again.") from error
        raise DataError(
            f"{path.name} is not a text file: byte {error.start} is not UTF-8; save it as CSV in UTF-8."
        ) from error
    except OSError as error:
        raise DataError(f"Cannot read {path}: {error.strerror}; check the path.") from error
