"""Decimal commas, as spreadsheets of many European locales write them."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence

_NUMBER = re.compile(r"\s*[+-]?(\d+,\d*|,\d+)(e[+-]?\d+)?\s*", re.IGNORECASE)
_THOUSANDS = re.compile(r"\s*[+-]?[1-9]\d{0,2},\d{3}\s*")
"""A number that is 1000 times larger if the comma separates thousands: 1,234."""


def is_number(cell: str) -> bool:
    """Whether a cell is a number, if it has a fraction with a decimal point."""
    try:
        float(cell)
    except ValueError:
        return False
    return True


def has_decimal_comma(cell: str) -> bool:
    """Whether a cell is a number if its comma is the decimal separator."""
    return _NUMBER.fullmatch(cell) is not None


def with_decimal_points(texts: Mapping[str, Sequence[str]], numbers: Iterable[Sequence[str]]) -> dict[str, list[str]]:
    """The columns whose numbers have decimal commas, with points instead.

    Nothing is converted where the meaning of a comma is ambiguous: a number of the file has a decimal point, or every
    comma may separate thousands.

    Args:
        texts: cells of the columns that are not numbers with decimal points, by name.
        numbers: cells of the other columns.

    Returns:
        Cells by name; empty if the file has no decimal commas.
    """
    found = {name: cells for name, cells in texts.items() if all(map(_is_whole_or_has_comma, cells))}
    is_certain = any("," in cell and not _THOUSANDS.fullmatch(cell) for cells in found.values() for cell in cells)
    if not is_certain or any("." in cell for cells in numbers for cell in cells):
        return {}
    return {name: [cell.replace(",", ".") for cell in cells] for name, cells in found.items()}


def _is_whole_or_has_comma(cell: str) -> bool:
    return has_decimal_comma(cell) or (is_number(cell) and "." not in cell)
