"""TOML files of a person: damaged ones are refused in one sentence."""

from __future__ import annotations

from pathlib import Path

import pytest

from carlab.core.errors import ConfigError
from carlab.core.toml_files import read_toml


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"mass = " + b"9" * 5000, r"is not valid TOML \(it has too long an integer\); correct it\."),
        (b"a = " + b"[" * 3000, r"is not valid TOML \(it is nested too deeply\); correct it\."),
        (b"[vehicle\n", r"is not valid TOML \(Expected .* line 1, column 9\)\); correct it\."),
        (b"\xff\xfe[\x00", r"is not a text file in UTF-8; name a car file in TOML, or save it in UTF-8\."),
    ],
    ids=["long integer", "nested", "syntax", "UTF-16"],
)
def test_damaged_file_is_refused(tmp_path: Path, content: bytes, message: str) -> None:
    (tmp_path / "car.toml").write_bytes(content)
    with pytest.raises(ConfigError, match=message):
        read_toml(tmp_path / "car.toml", "a car file")


def test_missing_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"No such file or directory; check the path"):
        read_toml(tmp_path / "car.toml", "a car file")


def test_byte_order_mark_is_skipped(tmp_path: Path) -> None:
    (tmp_path / "car.toml").write_bytes(b"\xef\xbb\xbf[vehicle]\nmass = 1.6\n")
    assert read_toml(tmp_path / "car.toml", "a car file") == ("[vehicle]\nmass = 1.6\n", {"vehicle": {"mass": 1.6}})
