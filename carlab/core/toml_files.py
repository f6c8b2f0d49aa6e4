"""Read TOML files that a person wrote, and TOML texts in other files."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

from carlab.core.errors import ConfigError


def read_toml(path: Path, what: str) -> tuple[str, dict[str, Any]]:
    """Read a TOML file; a byte order mark, as editors on Windows write it, is skipped.

    Args:
        path: the file.
        what: kind of the file for messages, for example ``a car file``.

    Returns:
        The text and its tables.

    Raises:
        ConfigError: it cannot be read, is not UTF-8 or not TOML, is nested too deeply, or has too long an integer.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
        return text, toml_tables(text)
    except OSError as error:
        raise ConfigError(f"Cannot read {path}: {error.strerror}; check the path and its permissions.") from error
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path} is not a text file in UTF-8; name {what} in TOML, or save it in UTF-8.") from error
    except ValueError as error:
        raise ConfigError(f"{path} is not valid TOML ({error}); correct it.") from error


def toml_tables(text: str) -> dict[str, Any]:
    """The tables of a TOML text.

    Raises:
        ValueError: it is not TOML, is nested too deeply, or has too long an integer.
    """
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError:
        raise
    except RecursionError as error:
        raise ValueError("it is nested too deeply") from error
    except ValueError as error:
        raise ValueError("it has too long an integer") from error
