"""JSON: files that a person may have edited, and data for files."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

_INTEGER_LIMIT = 2**63


def read_json(path: Path, *, keep_infinite: bool = False) -> dict[str, Any]:
    """Read a JSON object. Infinite numbers become NaN, also those beyond the range of a float.

    Args:
        path: the file.
        keep_infinite: return infinite numbers as they are. The identity value of a limit is infinite.

    Raises:
        OSError: the file cannot be read.
        ValueError: it is not UTF-8 or not JSON, is no object, is nested too deeply, or has an integer beyond 64 bits.
    """
    number = float if keep_infinite else _finite
    try:
        content = json.loads(
            path.read_text(encoding="utf-8"), parse_int=_integer, parse_float=number, parse_constant=number
        )
    except RecursionError as error:
        raise ValueError("it is nested too deeply") from error
    if not isinstance(content, dict):
        raise ValueError("it is not a JSON object")
    return content


def _finite(text: str) -> float:
    value = float(text)
    return value if math.isfinite(value) else math.nan


def _integer(text: str) -> int:
    value = int(text)
    if abs(value) >= _INTEGER_LIMIT:
        raise ValueError("it has an integer beyond 64 bits")
    return value


def plain(value: Any, names: Mapping[str, str] | None = None) -> Any:
    """Data for a JSON file: tuples and arrays become lists, and numbers that are not finite become null.

    Args:
        value: mappings, lists, tuples and NumPy arrays of texts and numbers.
        names: names in the file of keys of ``value`` that differ.
    """
    if isinstance(value, Mapping):
        return {(names or {}).get(str(k), str(k)): plain(v, names) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(v, names) for v in value]
    if hasattr(value, "tolist"):
        return plain(value.tolist(), names)
    return None if isinstance(value, float) and not math.isfinite(value) else value
