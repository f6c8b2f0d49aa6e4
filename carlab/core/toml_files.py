"""Read TOML files that a person wrote."""

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
        return text, tomllib.loads(text)
    except OSError as error:
        raise ConfigError(f"Cannot read {path}: {error.strerror}; check the path and its permissions.") from error
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path} is not a text file in UTF-8; name {what} in TOML, or save it in UTF-8.") from error
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{path} is not valid TOML ({error}); correct it.") from error
    except (ValueError, RecursionError) as error:
        reason = "it is nested too deeply" if isinstance(error, RecursionError) else "it has too long an integer"
        raise ConfigError(f"{path} is not valid TOML ({reason}); correct it.") from error


__all__ = ["read_toml"]
