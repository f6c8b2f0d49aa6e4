"""Seal of the answers: a hash that is published before the first diagnosis and checked before scoring."""

from __future__ import annotations

import hashlib
import json
import secrets
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from carlab.core.errors import DataError


def digest(answers: Mapping[str, Any], nonce: str) -> str:
    """sha256 over the nonce and the answers as canonical JSON (sorted keys, no spaces), as hex."""
    text = json.dumps({"nonce": nonce, "answers": answers}, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


def file_digest(path: Path) -> str:
    """sha256 of a file, as hex."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def check(answers: Mapping[str, Any], nonce: str, seal: str) -> None:
    """Raise DataError if the answers differ from the sealed answers."""
    found = digest(answers, nonce)
    if not secrets.compare_digest(found, seal):
        raise DataError(
            f"The seal is broken: the answers hash to {found[:16]}... but {seal[:16]}... was sealed; the run is void."
        )
