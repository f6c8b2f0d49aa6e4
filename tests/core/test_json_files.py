"""Edited JSON files raise OSError or ValueError only; numbers beyond a float become NaN."""

import math
from pathlib import Path

import pytest

from carlab.core.json_files import read_json


@pytest.mark.parametrize(
    "content",
    [b"", b"{", b"[]", b"1", b"null", b"\xff\xfe", b'{"a":' + b"[" * 100_000, b'{"a": 1' + b"0" * 30 + b"}"],
    ids=["empty", "cut", "list", "number", "null", "not UTF-8", "nested", "long integer"],
)
def test_content_that_is_no_plausible_object_raises_value_error(content: bytes, tmp_path: Path) -> None:
    path = tmp_path / "some.json"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"."):
        read_json(path)


def test_numbers_that_are_not_finite_become_nan(tmp_path: Path) -> None:
    path = tmp_path / "some.json"
    path.write_text('{"a": [NaN, Infinity, -Infinity, 1e999, 1.5, 3]}', encoding="utf-8")
    values = read_json(path)["a"]
    assert all(math.isnan(v) for v in values[:4])
    assert values[4:] == [1.5, 3]


def test_infinite_numbers_are_kept_on_request(tmp_path):
    path = tmp_path / "limits.json"
    path.write_text('{"force": Infinity, "other": -1e999}')
    assert read_json(path, keep_infinite=True) == {"force": math.inf, "other": -math.inf}
